"""A publisher or a subscriber with a deadline, a liveliness lease that it renews by writing, and a partition, which says when
they are missed.

    policies.py DOMAIN pub|sub /TOPIC DEADLINE_MS LEASE_MS PARTITION

The publisher writes ten times a second until a line comes on standard input, stays silent until another, and so on. The
subscriber reports `{"event": "received"}`, `{"event": "deadline_missed"}` and `{"event": "liveliness", "alive": N}`.
"""

from __future__ import annotations

import os
import sys
import threading
import time

from messages import KINDS
from peer import LOCALHOST_XML, emit


def main() -> None:
    domain, role, topic_name, deadline_ms, lease_ms, partition = sys.argv[1:7]
    os.environ.setdefault("CYCLONEDDS_URI", f'<CycloneDDS><Domain Id="any">{LOCALHOST_XML}</Domain></CycloneDDS>')
    from cyclonedds.core import Listener, Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter, Publisher
    from cyclonedds.sub import DataReader, Subscriber
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    kind, make, _ = KINDS["string"]
    participant = DomainParticipant(int(domain))
    topic = Topic(participant, "rt" + topic_name, kind)
    group = Qos(Policy.Partition([partition]))
    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(10),
        Policy.Deadline(duration(milliseconds=int(deadline_ms))),
        Policy.Liveliness.ManualByTopic(duration(milliseconds=int(lease_ms))),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    listener = Listener()
    if role == "sub":
        listener.set_on_requested_deadline_missed(lambda _r, status: emit("deadline_missed", total=status.total_count))
        listener.set_on_liveliness_changed(lambda _r, status: emit("liveliness", alive=status.alive_count))
        listener.set_on_data_available(lambda reader: [emit("received") for _ in reader.take(64)])
        _reader = DataReader(Subscriber(participant, group), topic, qos=qos, listener=listener)
        emit("ready")
        sys.stdin.read()
        return
    writer = DataWriter(Publisher(participant, group), topic, qos=qos)
    emit("ready")
    toggled = threading.Event()
    threading.Thread(target=lambda: [toggled.set() for _ in sys.stdin], daemon=True).start()
    seq, writes = 0, True
    while True:
        if writes:
            writer.write(make(seq, time.time_ns(), 0))
            seq += 1
        if toggled.wait(0.1):
            toggled.clear()
            writes = not writes


if __name__ == "__main__":
    main()
