"""Reads and writes messages in CBOR (RFC 8949): maps, arrays, numbers, texts, bytes and typed arrays (RFC 8746)."""

from __future__ import annotations

import struct
import sys
from array import array
from typing import Any, Callable, List, Mapping, Tuple

from ._message import Message

# Tags of little-endian typed arrays, and the type codes of Python's arrays.
_TYPED = {69: "H", 70: "I", 71: "Q", 72: "b", 77: "h", 78: "i", 79: "q", 85: "f", 86: "d"}
_TAGS = {code: tag for tag, code in _TYPED.items()}
_DEPTH_MAX = 64
_IS_LITTLE = sys.byteorder == "little"


class CborError(ValueError):
    """Data that is not the CBOR of a message, or a value that has none."""


def loads(data: bytes) -> Any:
    """Returns the value that ``data`` encodes."""
    value, end = _read(data, 0, 0)
    if end != len(data):
        raise CborError(f"{len(data) - end} bytes too many")
    return value


def dumps(value: Any) -> bytes:
    """Returns ``value`` in CBOR."""
    out: List[bytes] = []
    _write(value, out.append, 0)
    return b"".join(out)


def _head(data: bytes, at: int) -> Tuple[int, int, int, int]:
    """Returns the major type, the five low bits, the argument, and the position behind the head."""
    if at >= len(data):
        raise CborError("it ends too early")
    first = data[at]
    kind, small = first >> 5, first & 31
    at += 1
    if small < 24:
        return kind, small, small, at
    if small > 27:
        raise CborError("lengths that are not said in advance")
    size = 1 << (small - 24)
    if at + size > len(data):
        raise CborError("it ends too early")
    return kind, small, int.from_bytes(data[at : at + size], "big"), at + size


def _read(data: bytes, at: int, depth: int) -> Tuple[Any, int]:
    if depth > _DEPTH_MAX:
        raise CborError("too deep")
    kind, small, number, at = _head(data, at)
    if kind == 0:
        return number, at
    if kind == 1:
        return -1 - number, at
    if kind in (2, 3):
        end = at + number
        if end > len(data):
            raise CborError("it ends too early")
        part = data[at:end]
        return (part if kind == 2 else part.decode("utf-8")), end
    if kind == 4:
        items = []
        for _ in range(number):
            item, at = _read(data, at, depth + 1)
            items.append(item)
        return items, at
    if kind == 5:
        members = Message()
        for _ in range(number):
            name, at = _read(data, at, depth + 1)
            value, at = _read(data, at, depth + 1)
            dict.__setitem__(members, name, value)
        return members, at
    if kind == 6:
        value, at = _read(data, at, depth + 1)
        code = _TYPED.get(number)
        if code is None or not isinstance(value, bytes):
            return value, at
        numbers = array(code)
        numbers.frombytes(value)
        if not _IS_LITTLE:
            numbers.byteswap()
        return numbers, at
    if small in (20, 21):
        return small == 21, at
    if small in (22, 23):
        return None, at
    if small in (25, 26, 27):
        form = {25: ">e", 26: ">f", 27: ">d"}[small]
        size = 1 << (small - 24)
        return struct.unpack(form, data[at - size : at])[0], at
    raise CborError(f"simple value {number}")


def _number(kind: int, number: int) -> bytes:
    if number < 24:
        return bytes(((kind << 5) | number,))
    for small, size in ((24, 1), (25, 2), (26, 4), (27, 8)):
        if number < 1 << (8 * size):
            return bytes(((kind << 5) | small,)) + number.to_bytes(size, "big")
    raise CborError(f"{number} is no number of ROS 2")


def _write(value: Any, put: Callable[[bytes], None], depth: int) -> None:
    if depth > _DEPTH_MAX:
        raise CborError("too deep")
    if value is None:
        put(b"\xf6")
    elif value is True or value is False:
        put(b"\xf5" if value else b"\xf4")
    elif isinstance(value, int):
        put(_number(0, value) if value >= 0 else _number(1, -1 - value))
    elif isinstance(value, float):
        put(b"\xfb" + struct.pack(">d", value))
    elif isinstance(value, str):
        data = value.encode("utf-8")
        put(_number(3, len(data)))
        put(data)
    elif isinstance(value, (bytes, bytearray)):
        put(_number(2, len(value)))
        put(bytes(value))
    elif isinstance(value, Mapping):
        items = list(dict.items(value)) if isinstance(value, dict) else [(name, value[name]) for name in value]
        put(_number(5, len(items)))
        for name, member in items:
            _write(name, put, depth + 1)
            _write(member, put, depth + 1)
    elif isinstance(value, (list, tuple)):
        put(_number(4, len(value)))
        for item in value:
            _write(item, put, depth + 1)
    else:
        _write_other(value, put, depth)


def _write_other(value: Any, put: Callable[[bytes], None], depth: int) -> None:
    """Writes arrays of numbers, of the standard library and of numpy, and single numbers of numpy."""
    try:
        view = memoryview(value)
    except TypeError:
        view = None
    if view is None or view.ndim == 0:
        item = getattr(value, "item", None)
        if not callable(item):
            raise CborError(f"{type(value).__name__} is no part of a message")
        return _write(item(), put, depth)
    # Images are arrays of rows; a message has all rows in one array.
    code, size = view.format.lstrip("<=@"), view.itemsize
    if size == 1 and code in ("B", "c"):
        data = view.tobytes()
        put(_number(2, len(data)))
        return put(data)
    kind = "f" if code in ("f", "d") else ("i" if code.islower() else "u")
    numbers = {("u", 2): "H", ("u", 4): "I", ("u", 8): "Q", ("i", 1): "b", ("i", 2): "h", ("i", 4): "i"}
    numbers.update({("i", 8): "q", ("f", 4): "f", ("f", 8): "d"})
    tag = _TAGS.get(numbers.get((kind, size), ""))
    if tag is None or code == "?" or not _IS_LITTLE or view.format.startswith(">"):
        return _write(value.tolist(), put, depth)
    data = view.tobytes()
    put(_number(6, tag))
    put(_number(2, len(data)))
    put(data)
