#!/usr/bin/env python3
"""Writes the golden messages of `ros_discovery_info` for crates/sgc-ros/tests/vectors, in a CDR encoder that is not ours:
PyPI's `rosbags` (`pip install rosbags`), from the message definitions of rmw_dds_common with ids of both lengths."""

import pathlib
import sys
import textwrap

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore


def participant(n: int, entity: int) -> np.ndarray:
    return np.array([n] * 12 + [0, 0, entity, 3], dtype=np.uint8)


def message(gid_bytes: int) -> bytes:
    store = get_typestore(Stores.EMPTY)
    types = {}
    types.update(get_types_from_msg(f"uint8[{gid_bytes}] data", "rmw_dds_common/msg/Gid"))
    types.update(
        get_types_from_msg(
            "string<=256 node_namespace\nstring<=256 node_name\n"
            "rmw_dds_common/Gid[] reader_gid_seq\nrmw_dds_common/Gid[] writer_gid_seq",
            "rmw_dds_common/msg/NodeEntitiesInfo",
        )
    )
    types.update(
        get_types_from_msg(
            "rmw_dds_common/Gid gid\nrmw_dds_common/NodeEntitiesInfo[] node_entities_info_seq",
            "rmw_dds_common/msg/ParticipantEntitiesInfo",
        )
    )
    store.register(types)
    gid, node, info = (
        store.types[f"rmw_dds_common/msg/{name}"] for name in ("Gid", "NodeEntitiesInfo", "ParticipantEntitiesInfo")
    )

    def of(entity: int):
        return gid(np.concatenate([participant(7, entity), np.zeros(gid_bytes - 16, dtype=np.uint8)]))

    nodes = [node("/robot", "talker", [of(1)], [of(2), of(3)]), node("/", "x", [], [])]
    return bytes(store.serialize_cdr(info(of(0xC1), nodes), "rmw_dds_common/msg/ParticipantEntitiesInfo"))


def main() -> None:
    folder = pathlib.Path(__file__).parent.parent / "crates/sgc-ros/tests/vectors"
    for gid_bytes in (16, 24):
        text = "\n".join(textwrap.wrap(message(gid_bytes).hex(), 64)) + "\n"
        (folder / f"graph-{gid_bytes}.hex").write_text(text)
    sys.stdout.write(f"written to {folder}\n")


if __name__ == "__main__":
    main()
