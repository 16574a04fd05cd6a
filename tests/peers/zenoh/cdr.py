"""Plain CDR (XCDR1, little endian) of messages whose fields are known by name and spelling.

Spellings are those of rclpy's `get_fields_and_field_types`: `int32`, `sequence<string, 3>`, `double[4]`, `geometry_msgs/Point`.
A message is a dict, a sequence a list, and a sequence of bytes is `bytes`. A `wstring` is as rosidl_typesupport_fastrtps writes it,
which rmw_zenoh also uses: each unit of UTF-16 takes four bytes.
"""

from __future__ import annotations

import re
import struct

HEADER = b"\x00\x01\x00\x00"
PRIMITIVES = {
    "boolean": "?", "octet": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float": "f", "double": "d",
}  # fmt: skip
BYTES = ("octet", "char", "uint8")
# Padding may fill the last word, with any content.
PADDING_MAX = 3
# The field that a type without fields has in C.
EMPTY = {"structure_needs_at_least_one_member": "uint8"}

Definitions = dict[str, dict[str, str]]


class CdrError(ValueError):
    """Bytes that are no message of their type."""


def of_collection(spelling: str) -> tuple[str, int | None] | None:
    """Returns the item's spelling, and the length of an array, or `None` if the type is no collection."""
    if sequence := re.fullmatch(r"sequence<(.*?)(?:, \d+)?>", spelling):
        return sequence[1], None
    if array := re.fullmatch(r"(.*)\[(\d+)\]", spelling):
        return array[1], int(array[2])
    return None


class Codec:
    def __init__(self, definitions: Definitions) -> None:
        self.definitions = definitions

    def encode(self, kind: str, message: dict) -> bytes:
        writer = Writer(self)
        writer.put(kind, message)
        return HEADER + bytes(writer.data)

    def decode(self, kind: str, data: bytes) -> dict:
        message, length = self.decode_first(kind, data)
        if len(data) - length > PADDING_MAX:
            raise CdrError(f"{len(data) - length} bytes after the message")
        return message

    def decode_first(self, kind: str, data: bytes) -> tuple[dict, int]:
        """Returns the message, and its length without that which follows."""
        if data[:2] != HEADER[:2]:
            raise CdrError(f"{data[:4].hex()} is no header of plain CDR")
        reader = Reader(self, memoryview(data)[4:])
        return reader.take(kind), reader.at + 4


class Writer:
    def __init__(self, codec: Codec) -> None:
        self.definitions, self.data = codec.definitions, bytearray()

    def number(self, form: str, value: object) -> None:
        self.data += b"\0" * (-len(self.data) % struct.calcsize(form))
        self.data += struct.pack(f"<{form}", value)

    def put(self, spelling: str, value: object) -> None:
        if form := PRIMITIVES.get(spelling):
            self.number(form, value)
        elif collection := of_collection(spelling):
            item, length = collection
            if length is None:
                self.number("I", len(value))
            elif len(value) != length:
                raise CdrError(f"{len(value)} items for {spelling}")
            if item in BYTES:
                self.data += bytes(value)
            else:
                for one in value:
                    self.put(item, one)
        elif spelling.startswith("string"):
            encoded = value.encode() + b"\0"
            self.number("I", len(encoded))
            self.data += encoded
        elif spelling.startswith("wstring"):
            units = memoryview(value.encode("utf-16-le")).cast("H")
            for number in (len(units), *units):
                self.number("I", number)
        else:
            for name, field in (self.definitions[spelling] or EMPTY).items():
                self.put(field, value.get(name, 0))


class Reader:
    def __init__(self, codec: Codec, data: memoryview) -> None:
        self.definitions, self.data, self.at = codec.definitions, data, 0

    def bytes(self, count: int) -> bytes:
        if count > len(self.data) - self.at:
            raise CdrError(f"{count} bytes at {self.at} of {len(self.data)}")
        self.at += count
        return bytes(self.data[self.at - count : self.at])

    def number(self, form: str):
        size = struct.calcsize(form)
        self.at += -self.at % size
        return struct.unpack(f"<{form}", self.bytes(size))[0]

    def take(self, spelling: str):
        if form := PRIMITIVES.get(spelling):
            return self.number(form)
        if collection := of_collection(spelling):
            item, length = collection
            count = self.number("I") if length is None else length
            if item in BYTES:
                return self.bytes(count)
            if count > len(self.data):
                raise CdrError(f"{count} items in {len(self.data)} bytes")
            return [self.take(item) for _ in range(count)]
        if spelling.startswith("string"):
            encoded = self.bytes(self.number("I"))
            if encoded[-1:] != b"\0":
                raise CdrError("a string without its end")
            return encoded[:-1].decode()
        if spelling.startswith("wstring"):
            units = memoryview(self.bytes(4 * self.number("I"))).cast("I")
            try:
                return struct.pack(f"<{len(units)}H", *units).decode("utf-16-le")
            except (struct.error, UnicodeDecodeError) as error:
                raise CdrError(f"no text: {error}") from error
        fields = self.definitions[spelling]
        taken = {name: self.take(field) for name, field in (fields or EMPTY).items()}
        return taken if fields else {}
