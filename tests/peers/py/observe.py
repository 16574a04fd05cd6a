"""Lists DDS endpoints as a participant of the domain that does not know SGC.

For each line on standard input it prints one of JSON: `{"event": "endpoints", "endpoints": [{"kind": "writer", "topic": …,
"type": …, "qos": …}, …]}`. The end of the input, or SIGTERM, ends it.
"""

from __future__ import annotations

import json
import os
import sys

from peer import LOCALHOST_XML, emit

ENDPOINTS_MAX = 100_000


def main() -> None:
    domain = int(sys.argv[1])
    os.environ.setdefault("CYCLONEDDS_URI", f'<CycloneDDS><Domain Id="any">{LOCALHOST_XML}</Domain></CycloneDDS>')
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
    from cyclonedds.domain import DomainParticipant

    participant = DomainParticipant(domain)
    readers = [
        (kind, BuiltinDataReader(participant, topic))
        for kind, topic in (("writer", BuiltinTopicDcpsPublication), ("reader", BuiltinTopicDcpsSubscription))
    ]
    alive = ViewState.Any | SampleState.Any | InstanceState.Alive
    conditions = [(kind, reader, ReadCondition(reader, alive)) for kind, reader in readers]
    emit("ready")
    for _line in sys.stdin:
        found = [
            {"kind": kind, "topic": s.topic_name, "type": s.type_name, "qos": str(s.qos)}
            for kind, reader, condition in conditions
            for s in reader.read(ENDPOINTS_MAX, condition)
            if s.topic_name and s.participant_key != participant.guid
        ]
        print(json.dumps({"event": "endpoints", "endpoints": found}), flush=True)


if __name__ == "__main__":
    main()
