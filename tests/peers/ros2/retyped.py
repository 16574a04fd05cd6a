"""A message type with another name or definition: of its base it has the layout, and messages are given and taken as CDR (`raw=True`).

Packages that the wheels of ROS 2 lack, and two versions of one package, are made from those that are there.
"""

import ctypes

from rclpy.type_support import check_for_type_support

Handle = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)
Hash = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
HASH_BYTES = 32
FASTRTPS = b"rosidl_typesupport_fastrtps_c"


class TypeHash(ctypes.Structure):
    """rosidl_type_hash_t."""

    _fields_ = [("version", ctypes.c_uint8), ("value", ctypes.c_uint8 * HASH_BYTES)]


class TypeSupport(ctypes.Structure):
    """rosidl_message_type_support_t."""

    _fields_ = [
        ("identifier", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("handle", Handle),
        ("hash", Hash),
        ("description", ctypes.c_void_p),
        ("sources", ctypes.c_void_p),
    ]


class Callbacks(ctypes.Structure):
    """message_type_support_callbacks_t of rosidl_typesupport_fastrtps."""

    _fields_ = [("namespace", ctypes.c_char_p), ("name", ctypes.c_char_p), ("rest", ctypes.c_void_p * 5)]


_python = ctypes.pythonapi
_python.PyCapsule_GetName.restype = ctypes.c_char_p
_python.PyCapsule_GetName.argtypes = [ctypes.py_object]
_python.PyCapsule_GetPointer.restype = ctypes.c_void_p
_python.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
_python.PyCapsule_New.restype = ctypes.py_object
_python.PyCapsule_New.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
# The client library points into all of these.
_kept = []


def retyped(base: type, package: str | None = None, name: str | None = None, other_hash: bool = False) -> type:
    """Returns a type like `base`, of another package and name, or with another hash of its definition."""
    check_for_type_support(base)
    capsule_name = _python.PyCapsule_GetName(base.__class__._TYPE_SUPPORT)
    pointer = _python.PyCapsule_GetPointer(base.__class__._TYPE_SUPPORT, capsule_name)
    generic = ctypes.cast(pointer, ctypes.POINTER(TypeSupport)).contents
    found = generic.handle(pointer, FASTRTPS)
    specific = TypeSupport.from_buffer_copy(ctypes.cast(found, ctypes.POINTER(TypeSupport)).contents)
    callbacks = Callbacks.from_buffer_copy(ctypes.cast(specific.data, ctypes.POINTER(Callbacks)).contents)
    if package:
        callbacks.namespace = f"{package}::msg".encode()
    if name:
        callbacks.name = name.encode()
    type_hash = TypeHash.from_buffer_copy(ctypes.cast(generic.hash(pointer), ctypes.POINTER(TypeHash)).contents)
    if other_hash:
        type_hash.value[0] ^= 0xFF
    specific.data = ctypes.addressof(callbacks)
    specific.hash = Hash(lambda _: ctypes.addressof(type_hash))
    support = TypeSupport.from_buffer_copy(generic)
    support.hash = specific.hash
    # The description that introspection gives is that of the base.
    support.handle = Handle(
        lambda _, identifier: ctypes.addressof(specific) if identifier == FASTRTPS else generic.handle(pointer, identifier)
    )

    class Meta(type(base)):
        _TYPE_SUPPORT = _python.PyCapsule_New(ctypes.addressof(support), capsule_name, None)

    _kept.extend([support, specific, callbacks, type_hash, capsule_name])
    return Meta(base.__name__, (base,), {"__slots__": []})
