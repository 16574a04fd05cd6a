"""The content of messages, from sequence number, time and size alone (../README.md): texts as all peers of this folder send them,
and bytes as the load generator of ROS 2 does (../ros2/load.c). A receiver compares the whole message."""

from __future__ import annotations

import struct
import time
import zlib

from interfaces import Message

MASK64 = (1 << 64) - 1
HEAD = struct.Struct("<QQQ")
FNV_OFFSET, FNV_PRIME = 0xCBF29CE484222325, 0x100000001B3


def noise(seed: int, count: int) -> bytes:
    """Returns the first bytes of splitmix64."""
    state, words = seed & MASK64, []
    for _ in range((count + 7) // 8):
        state = (state + 0x9E3779B97F4A7C15) & MASK64
        z = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & MASK64
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK64
        words.append(struct.pack("<Q", z ^ (z >> 31)))
    return b"".join(words)[:count]


class Text:
    """`std_msgs/msg/String`. The size is the length of the filler; 0 lets it follow from the sequence number."""

    message = Message("std_msgs/msg/String")

    def make(self, seq: int, size: int) -> bytes:
        return self.message.encode({"data": self._text(seq, time.time_ns(), size)})

    def _text(self, seq: int, stamp_ns: int, size: int) -> str:
        size = size or seq % 23
        body = f"seq={seq} t={stamp_ns} fill={noise(seq, size).hex()[:size]}"
        return f"{body} crc={zlib.crc32(body.encode()):08x}"

    def read(self, payload: bytes) -> tuple[int, int, bool]:
        """Returns sequence number and time, and whether the message is unaltered."""
        text = self.message.decode(payload)["data"]
        fields = dict(part.split("=", 1) for part in text.split(" "))
        seq, stamp_ns = int(fields["seq"]), int(fields["t"])
        size = 0 if len(fields["fill"]) == seq % 23 else len(fields["fill"])
        return seq, stamp_ns, text == self._text(seq, stamp_ns, size)


class Bulk:
    """`std_msgs/msg/UInt8MultiArray`: sequence number, time, and the sum of the rest, a pattern with the number in three places."""

    message = Message("std_msgs/msg/UInt8MultiArray")

    def __init__(self) -> None:
        self.patterns: dict[int, bytes] = {}

    def _rest(self, seq: int, size: int) -> bytes:
        if size not in self.patterns:
            period = bytes((i * 167 + (i >> 8)) & 0xFF for i in range(1 << 16))
            self.patterns[size] = (period * (size // len(period) + 1))[:size]
        data = bytearray(self.patterns[size])
        if size > HEAD.size + 24:
            for at in (HEAD.size, size // 2, size - 8):
                struct.pack_into("<Q", data, at, seq)
        return bytes(data[HEAD.size :])

    def make(self, seq: int, size: int) -> bytes:
        """Takes the time last, because adding up 13 MB takes some tenths of a second."""
        rest = self._rest(seq, max(size, HEAD.size))
        whole = len(rest) & ~7
        total = FNV_OFFSET
        for word in struct.unpack(f"<{whole // 8}Q", rest[:whole]) + tuple(rest[whole:]):
            total = ((total ^ word) * FNV_PRIME) & MASK64
        data = HEAD.pack(seq, time.time_ns(), total ^ seq) + rest
        return self.message.encode({"layout": {"dim": [], "data_offset": 0}, "data": data})

    def read(self, payload: bytes) -> tuple[int, int, bool]:
        """Does not add up: it compares each byte behind the head."""
        message = self.message.decode(payload)
        seq, stamp_ns, _ = HEAD.unpack_from(message["data"])
        same = message["layout"] == {"dim": [], "data_offset": 0}
        return seq, stamp_ns, same and message["data"][HEAD.size :] == self._rest(seq, len(message["data"]))


class Tally:
    """The record of received messages."""

    def __init__(self) -> None:
        self.seen: set[int] = set()
        self.duplicated = self.altered = self.reordered = 0
        self.last_seq = -1
        self.latency_us: list[int] = []

    def add(self, seq: int, latency_ns: int, intact: bool) -> None:
        self.latency_us.append(latency_ns // 1000)
        if not intact:
            self.altered += 1
        elif seq in self.seen:
            self.duplicated += 1
        else:
            self.seen.add(seq)
            self.reordered += seq < self.last_seq
            self.last_seq = max(self.last_seq, seq)

    def summary(self) -> dict:
        first, last = (min(self.seen), max(self.seen)) if self.seen else (None, None)
        ordered = sorted(self.latency_us)

        def share(part: float) -> int | None:
            return ordered[min(len(ordered) - 1, int(len(ordered) * part))] if ordered else None

        return {
            "received": len(self.seen), "first": first, "last": last,
            "lost": last - first + 1 - len(self.seen) if self.seen else 0,
            "duplicated": self.duplicated, "altered": self.altered, "reordered": self.reordered,
            "latency_us": {"p50": share(0.5), "p99": share(0.99), "max": share(1.0)},
        }  # fmt: skip
