"""A program that publishes and subscribes to many topics at a low rate for hours, and costs little (`../README.md`).

It looks at its readers and publishes once in each period, so that it wakes up seldom. Memory is bounded: of the sequence
numbers of a topic it keeps the last ones.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from collections import deque

from messages import KINDS
from peer import LOCALHOST_XML, emit, leave

TAKE_MAX = 256
DEPTH = 200
# More messages of a publisher than a node keeps (`RECOVERY_MESSAGES_MAX`).
FILL = 4200
# Sequence numbers of a topic that a duplicate is told by.
RECENT = 1000


class Heard:
    """The record of a topic's messages."""

    def __init__(self) -> None:
        self.recent: deque[int] = deque(maxlen=RECENT)
        self.received = self.lost = self.doubled = self.late = self.altered = 0
        self.last = -1

    def add(self, seq: int, intact: bool) -> None:
        if not intact:
            self.altered += 1
        elif seq in self.recent:
            self.doubled += 1
        elif seq < self.last:
            # It was counted as lost.
            self.late += 1
            self.lost -= 1
        else:
            self.lost += seq - self.last - 1 if self.last >= 0 else 0
            self.last = seq
            self.received += 1
            self.recent.append(seq)

    def report(self) -> dict:
        return {
            "last": self.last, "received": self.received, "lost": self.lost, "doubled": self.doubled,
            "late": self.late, "altered": self.altered,
        }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--publish", default="", help="topics, separated by commas")
    parser.add_argument("--hear", default="", help="topics, separated by commas")
    parser.add_argument("--period", type=float, default=2.0, help="seconds between two messages of a topic")
    parser.add_argument("--fill", type=int, default=1, help=f"messages in each period until {FILL} of a topic were sent")
    parser.add_argument("--timeout", type=float, default=60.0, help="seconds, from the start")
    args = parser.parse_args()
    os.environ.setdefault("CYCLONEDDS_URI", f'<CycloneDDS><Domain Id="any">{LOCALHOST_XML}</Domain></CycloneDDS>')
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.internal import InvalidSample
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    kind, make, read = KINDS["string"]
    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(DEPTH),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    participant = DomainParticipant(args.domain)
    topics = lambda names: [(name, Topic(participant, "rt" + name, kind)) for name in names.split(",") if name]  # noqa: E731
    writers = [DataWriter(participant, topic, qos=qos) for _, topic in topics(args.publish)]
    readers = {name: DataReader(participant, topic, qos=qos) for name, topic in topics(args.hear)}
    heard = {name: Heard() for name in readers}
    asked, ended = threading.Event(), threading.Event()
    wake = threading.Event()

    def listen() -> None:
        for _ in sys.stdin:
            asked.set()
            wake.set()
        ended.set()
        wake.set()

    threading.Thread(target=listen, daemon=True).start()
    emit("ready")
    begun, periods, sent = time.monotonic(), 0, 0
    while not ended.is_set() and time.monotonic() - begun < args.timeout:
        if time.monotonic() >= begun + periods * args.period:
            for _ in range(args.fill if sent < FILL else 1):
                for writer in writers:
                    writer.write(make(sent, time.time_ns(), 0))
                sent += 1
            periods += 1
        for name, reader in readers.items():
            for sample in reader.take(TAKE_MAX):
                if not isinstance(sample, InvalidSample):
                    seq, _, intact = read(sample)
                    heard[name].add(seq, intact)
        wake.clear()
        if asked.is_set():
            asked.clear()
            emit("flows", sent=sent, heard={name: record.report() for name, record in heard.items()})
        wake.wait(max(0.0, begun + periods * args.period - time.monotonic()))
    emit("summary", sent=sent)
    leave(participant)


if __name__ == "__main__":
    main()
