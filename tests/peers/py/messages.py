"""The message types of the peers and the content of each message.

Types carry the names that ROS 2 gives them on the wire. The content of a message follows from its sequence number, the
time it was sent and a size alone, so a receiver rebuilds what it should have got and compares all of it. The C++ peer
does the same (`../fastdds/messages.hpp`); `../README.md` is what the two agree on.
"""

import struct
import sys
import zlib
from dataclasses import dataclass

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import cdrv0, final, key, xcdrv2
from cyclonedds.idl.types import array, float32, float64, int16, int32, sequence, uint8, uint16, uint32, uint64

MASK64 = (1 << 64) - 1
BLOCK_BYTES = 1 << 16
IMAGE_BYTES_MIN = 20
POINT_BYTES = 16
POINTCLOUD_BYTES = 6_000_000
FLOAT32 = 7
# One, two and three bytes of UTF-8 a character, and one that takes two units of UTF-16.
WIDE = "a\u00e9\u0416\u6f22\u3042\U0001f916\u20acz"

# The binding wants to know it when a type is made, so before there is a command line to parse.
represented = xcdrv2 if "--xcdr2" in sys.argv else cdrv0


@dataclass
@final
@represented
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


@dataclass
@final
@represented
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
@final
@represented
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
@final
@represented
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


@dataclass
@final
@represented
class Inner(IdlStruct, typename="sgc_test_msgs::msg::dds_::Inner_"):
    offset: int16
    weight: float64
    label: str


@dataclass
@final
@represented
class Odd(IdlStruct, typename="sgc_test_msgs::msg::dds_::Odd_"):
    """A type that no ROS distribution has: nested, bounded, mixed alignment, and a tail of odd length."""

    flag: bool
    seq: uint64
    stamp_ns: uint64
    crc: uint32
    inner: Inner
    parts: sequence[Inner, 4]
    codes: sequence[uint16, 32]
    fixed: array[float32, 3]
    tail: sequence[uint8, 64]


@dataclass
@final
@represented
class WString(IdlStruct, typename="std_msgs::msg::dds_::WString_"):
    """A `wstring` as it is on the wire: the count of UTF-16 code units, and the units. The binding has no `wstring`."""

    data: sequence[uint16]


@dataclass
@final
@represented
class PointField(IdlStruct, typename="sensor_msgs::msg::dds_::PointField_"):
    name: str
    offset: uint32
    datatype: uint8
    count: uint32


@dataclass
@final
@represented
class PointCloud2(IdlStruct, typename="sensor_msgs::msg::dds_::PointCloud2_"):
    header: Header
    height: uint32
    width: uint32
    fields: sequence[PointField]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool


@dataclass
@final
@represented
class Keyed(IdlStruct, typename="sgc_test_msgs::msg::dds_::Keyed_"):
    """Five instances, each with a history of its own."""

    sensor: uint32
    key("sensor")
    seq: uint64
    stamp_ns: uint64
    crc: uint32
    data: sequence[uint8, 64]


class Noise:
    """splitmix64: the same bytes on both sides from one seed."""

    def __init__(self, seed: int) -> None:
        self.state = seed & MASK64

    def next(self) -> int:
        self.state = (self.state + 0x9E3779B97F4A7C15) & MASK64
        z = self.state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK64
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK64
        return z ^ (z >> 31)

    def take(self, count: int) -> bytes:
        words = (count + 7) // 8
        return b"".join(struct.pack("<Q", self.next()) for _ in range(words))[:count]


_BLOCK = Noise(0x5347435F50454552).take(BLOCK_BYTES)


def _cut_of_block(seq: int, count: int) -> bytes:
    """`count` bytes of the repeated noise block, starting at a place that depends on the sequence number."""
    start = (seq * 7919) % BLOCK_BYTES
    repeats = (start + count) // BLOCK_BYTES + 1
    return memoryview(_BLOCK * repeats)[start : start + count].tobytes()


def make_string(seq: int, stamp_ns: int, size: int) -> String:
    """`size` is the length of the filler; 0 lets it follow from the sequence number (so lengths mod 4 vary)."""
    filler = Noise(seq).take(size or seq % 23).hex()[: size or seq % 23]
    body = f"seq={seq} t={stamp_ns} fill={filler}"
    return String(f"{body} crc={zlib.crc32(body.encode()):08x}")


def read_string(message: String) -> tuple[int, int, bool]:
    fields = dict(part.split("=", 1) for part in message.data.split(" "))
    seq, stamp_ns = int(fields["seq"]), int(fields["t"])
    size = 0 if len(fields["fill"]) == seq % 23 else len(fields["fill"])
    return seq, stamp_ns, message == make_string(seq, stamp_ns, size)


def make_image(seq: int, stamp_ns: int, size: int) -> Image:
    size = max(size, IMAGE_BYTES_MIN)
    return Image(_header(seq, stamp_ns), 1, size, "mono8", 0, size, _bulk(seq, stamp_ns, size))


def _header(seq: int, stamp_ns: int) -> Header:
    return Header(Time(stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000), f"sgc/{seq}")


def _bulk(seq: int, stamp_ns: int, size: int) -> bytes:
    """Sequence number, time, checksum, and a cut of the repeated noise block."""
    fill = _cut_of_block(seq, size - IMAGE_BYTES_MIN)
    head = struct.pack("<QQ", seq, stamp_ns)
    return b"".join((head, struct.pack("<I", zlib.crc32(fill, zlib.crc32(head))), fill))


def read_image(message: Image) -> tuple[int, int, bool]:
    data = bytes(message.data)
    seq, stamp_ns = struct.unpack_from("<QQ", data)
    good = make_image(seq, stamp_ns, len(data))
    return seq, stamp_ns, bytes(good.data) == data and _without_data(good) == _without_data(message)


def _without_data(image: Image) -> tuple:
    return (image.header, image.height, image.width, image.encoding, image.is_bigendian, image.step)


def make_custom(seq: int, stamp_ns: int, size: int) -> Odd:
    """`size` is ignored: the lengths inside follow from the sequence number. The tail makes the total no multiple of 4."""
    del size
    noise = Noise(seq)
    # Small integers, which float32 and float64 hold exactly, so both sides print and compare them alike.
    inners = [
        Inner(noise.next() % 2000 - 1000, float(noise.next() % 100_000) / 8.0, f"part-{i}-{seq % 1000}")
        for i in range(1 + seq % 5)
    ]
    codes = [noise.next() % 65536 for _ in range(seq % 33)]
    fixed = [float(noise.next() % 4096) / 4.0 for _ in range(3)]
    tail = noise.take(1 + 2 * (seq % 31))
    covered = struct.pack("<QQ", seq, stamp_ns) + struct.pack(f"<{len(codes)}H", *codes) + tail
    return Odd(seq % 2 == 1, seq, stamp_ns, zlib.crc32(covered), inners[0], inners[1:], codes, fixed, tail)


def read_custom(message: Odd) -> tuple[int, int, bool]:
    good = make_custom(message.seq, message.stamp_ns, 0)
    same = _flat(good) == _flat(message)
    return message.seq, message.stamp_ns, same


def _flat(odd: Odd) -> tuple:
    return (
        bool(odd.flag), odd.seq, odd.stamp_ns, odd.crc, odd.inner, list(odd.parts), list(odd.codes), list(odd.fixed),
        bytes(odd.tail),
    )  # fmt: skip


def make_wstring(seq: int, stamp_ns: int, size: int) -> WString:
    filler = "".join(WIDE[byte & 7] for byte in Noise(seq).take(size or seq % 23))
    body = f"seq={seq} t={stamp_ns} fill={filler}"
    units = f"{body} crc={zlib.crc32(body.encode('utf-16-le')):08x}".encode("utf-16-le")
    return WString(list(struct.unpack(f"<{len(units) // 2}H", units)))


def read_wstring(message: WString) -> tuple[int, int, bool]:
    units = list(message.data)
    text = struct.pack(f"<{len(units)}H", *units).decode("utf-16-le")
    fields = dict(part.split("=", 1) for part in text.split(" "))
    seq, stamp_ns = int(fields["seq"]), int(fields["t"])
    size = 0 if len(fields["fill"]) == seq % 23 else len(fields["fill"])
    return seq, stamp_ns, units == make_wstring(seq, stamp_ns, size).data


def make_pointcloud(seq: int, stamp_ns: int, size: int) -> PointCloud2:
    points = max(-(-(size or POINTCLOUD_BYTES) // POINT_BYTES), 2)
    fields = [PointField(name, 4 * i, FLOAT32, 1) for i, name in enumerate(("x", "y", "z", "intensity"))]
    size = points * POINT_BYTES
    data = _bulk(seq, stamp_ns, size)
    return PointCloud2(_header(seq, stamp_ns), 1, points, fields, False, POINT_BYTES, size, data, True)


def read_pointcloud(message: PointCloud2) -> tuple[int, int, bool]:
    data = bytes(message.data)
    seq, stamp_ns = struct.unpack_from("<QQ", data)
    good = make_pointcloud(seq, stamp_ns, len(data))
    same = [
        (c.header, c.height, c.width, list(c.fields), bool(c.is_bigendian), c.point_step, c.row_step, bool(c.is_dense))
        for c in (good, message)
    ]
    return seq, stamp_ns, good.data == data and same[0] == same[1]


def make_keyed(seq: int, stamp_ns: int, size: int) -> Keyed:
    del size
    data = Noise(seq).take(1 + seq % 31)
    return Keyed(seq % 5, seq, stamp_ns, zlib.crc32(struct.pack("<QQ", seq, stamp_ns) + data), data)


def read_keyed(message: Keyed) -> tuple[int, int, bool]:
    good = make_keyed(message.seq, message.stamp_ns, 0)
    same = [(k.sensor, k.seq, k.stamp_ns, k.crc, bytes(k.data)) for k in (good, message)]
    return message.seq, message.stamp_ns, same[0] == same[1]


KINDS = {
    "string": (String, make_string, read_string),
    "image": (Image, make_image, read_image),
    "custom": (Odd, make_custom, read_custom),
    "wstring": (WString, make_wstring, read_wstring),
    "pointcloud": (PointCloud2, make_pointcloud, read_pointcloud),
    "keyed": (Keyed, make_keyed, read_keyed),
}
