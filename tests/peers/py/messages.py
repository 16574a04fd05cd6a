"""The three message types of the peers and what each message must hold.

Types carry the names that ROS 2 gives them on the wire. The content of a message follows from its sequence number, the
time it was sent and a size alone, so a receiver rebuilds what it should have got and compares all of it. The C++ peer
does the same (`../fastdds/messages.hpp`); `../README.md` is what the two agree on.
"""

import struct
import zlib
from dataclasses import dataclass

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import cdrv0, final
from cyclonedds.idl.types import array, float32, float64, int16, int32, sequence, uint8, uint16, uint32, uint64

MASK64 = (1 << 64) - 1
BLOCK_BYTES = 1 << 16
IMAGE_BYTES_MIN = 20


@dataclass
@final
@cdrv0
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


@dataclass
@final
@cdrv0
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
@final
@cdrv0
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
@final
@cdrv0
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
@cdrv0
class Inner(IdlStruct, typename="sgc_test_msgs::msg::dds_::Inner_"):
    offset: int16
    weight: float64
    label: str


@dataclass
@final
@cdrv0
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
    fill = _cut_of_block(seq, size - IMAGE_BYTES_MIN)
    head = struct.pack("<QQ", seq, stamp_ns)
    data = b"".join((head, struct.pack("<I", zlib.crc32(fill, zlib.crc32(head))), fill))
    stamp = Time(stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    return Image(Header(stamp, f"sgc/{seq}"), 1, size, "mono8", 0, size, data)


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


KINDS = {
    "string": (String, make_string, read_string),
    "image": (Image, make_image, read_image),
    "custom": (Odd, make_custom, read_custom),
}
