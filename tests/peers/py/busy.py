"""Many nodes in one process, which announce themselves and publish nothing.

    busy.py DOMAIN NODES SHARED

Each node is a participant with five writers and five readers; the first SHARED writers are of `/shared/N`, all other
endpoints of topics of their own.
"""

from __future__ import annotations

import os
import sys

from messages import KINDS
from peer import LOCALHOST_XML, emit

ENDPOINTS_OF_A_KIND = 5


def main() -> None:
    domain, nodes, shared = (int(arg) for arg in sys.argv[1:4])
    os.environ.setdefault("CYCLONEDDS_URI", f'<CycloneDDS><Domain Id="any">{LOCALHOST_XML}</Domain></CycloneDDS>')
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    kind = KINDS["string"][0]
    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    kept = []
    for node in range(nodes):
        participant = DomainParticipant(domain)
        kept.append(participant)
        for n in range(ENDPOINTS_OF_A_KIND):
            number = node * ENDPOINTS_OF_A_KIND + n
            name = f"rt/shared/n{number}" if number < shared else f"rt/node_{node}/out_{n}"
            kept.append(DataWriter(participant, Topic(participant, name, kind), qos=qos))
            kept.append(DataReader(participant, Topic(participant, f"rt/node_{node}/in_{n}", kind), qos=qos))
    emit("ready", endpoints=2 * ENDPOINTS_OF_A_KIND * nodes)
    sys.stdin.read()


if __name__ == "__main__":
    main()
