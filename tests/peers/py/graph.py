"""The ROS graph, as every rmw tells and computes it, on Cyclone DDS: `ros_discovery_info` with ids of 16 or 24 bytes,
participants that name their enclave, and endpoints by GUID (rmw_dds_common's graph cache)."""

from dataclasses import dataclass
from typing import Callable

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import cdrv0, final
from cyclonedds.idl.types import array, bounded_str, sequence, uint8
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

TAKE_MAX = 64
UNKNOWN = "_NODE_NAME_UNKNOWN_"
ENCLAVE = b"enclave=/;"


@dataclass
@final
@cdrv0
class Gid16(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
    data: array[uint8, 16]


@dataclass
@final
@cdrv0
class Gid24(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
    data: array[uint8, 24]


@dataclass
@final
@cdrv0
class Node16(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
    node_namespace: bounded_str[256]
    node_name: bounded_str[256]
    reader_gid_seq: sequence[Gid16]
    writer_gid_seq: sequence[Gid16]


@dataclass
@final
@cdrv0
class Node24(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
    node_namespace: bounded_str[256]
    node_name: bounded_str[256]
    reader_gid_seq: sequence[Gid24]
    writer_gid_seq: sequence[Gid24]


@dataclass
@final
@cdrv0
class Info16(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    gid: Gid16
    node_entities_info_seq: sequence[Node16]


@dataclass
@final
@cdrv0
class Info24(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    gid: Gid24
    node_entities_info_seq: sequence[Node24]


TYPES = {16: (Gid16, Node16, Info16), 24: (Gid24, Node24, Info24)}


def participant(domain: int, node: str | None) -> DomainParticipant:
    """Makes a participant that every rmw takes for one of ROS 2, if it has a node."""
    return DomainParticipant(domain, qos=Qos(Policy.Userdata(ENCLAVE)) if node else None)


def _qos(history: Policy.History) -> Qos:
    return Qos(
        history,
        Policy.Reliability.Reliable(duration(seconds=10)),
        Policy.Durability.TransientLocal,
        Policy.DurabilityService(0, history, -1, -1, -1),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


def announce(owner: DomainParticipant, node: str, gid_bytes: int, readers: list, writers: list) -> DataWriter:
    """Announces that these endpoints belong to a node with this full name. The writer has to be kept."""
    gid, node_type, info = TYPES[gid_bytes]
    namespace, name = node.rsplit("/", 1)

    def gids(entities: list) -> list:
        return [gid(list(entity.guid.bytes) + [0] * (gid_bytes - 16)) for entity in entities]

    writer = DataWriter(owner, Topic(owner, "ros_discovery_info", info), qos=_qos(Policy.History.KeepLast(1)))
    nodes = [node_type(namespace or "/", name, gids(readers), gids(writers))]
    writer.write(info(gids([owner])[0], nodes))
    return writer


class Graph:
    """The graph as a ROS 2 process of this network sees it: nodes, and endpoints of topics."""

    def __init__(self, owner: DomainParticipant, gid_bytes: int) -> None:
        info = TYPES[gid_bytes][2]
        topic = Topic(owner, "ros_discovery_info", info)
        self.info = DataReader(owner, topic, qos=_qos(Policy.History.KeepAll))
        self.builtin = [
            BuiltinDataReader(owner, topic)
            for topic in (BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription)
        ]
        self.participants: set[bytes] = set()
        self.nodes: dict[bytes, list] = {}
        self.endpoints: dict[bytes, tuple] = {}

    def attach(self, waiting: WaitSet) -> None:
        for reader in (self.info, *self.builtin):
            waiting.attach(ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead))

    def take(self) -> None:
        for sample in _all(self.builtin[0].take):
            if sample.sample_info.instance_state != InstanceState.Alive:
                self.participants.discard(sample.key.bytes)
                self.nodes.pop(sample.key.bytes, None)
            elif Policy.Userdata in sample.qos and b"enclave=" in sample.qos[Policy.Userdata].data:
                self.participants.add(sample.key.bytes)
        for kind, reader in (("writer", self.builtin[1]), ("reader", self.builtin[2])):
            for sample in _all(reader.take):
                if sample.sample_info.instance_state != InstanceState.Alive:
                    self.endpoints.pop(sample.key.bytes, None)
                else:
                    self.endpoints[sample.key.bytes] = (kind, sample)
        for sample in _all(self.info.take):
            if not isinstance(sample, InvalidSample):
                self.nodes[bytes(sample.gid.data[:16])] = sample.node_entities_info_seq

    def describe(self) -> dict:
        """Returns all nodes, and all endpoints of ROS topics with their nodes."""
        owners = {}
        nodes = []
        for participant, infos in self.nodes.items():
            if participant not in self.participants:
                continue
            for info in infos:
                name = f"{info.node_namespace.rstrip('/')}/{info.node_name}"
                nodes.append(name)
                for gid in (*info.reader_gid_seq, *info.writer_gid_seq):
                    owners[bytes(gid.data[:16])] = name
        endpoints = []
        for guid, (kind, sample) in self.endpoints.items():
            if sample.topic_name.startswith("rt/"):
                endpoints.append(
                    {
                        "topic": sample.topic_name[2:],
                        "kind": kind,
                        "type": sample.type_name,
                        "node": owners.get(guid, UNKNOWN),
                        "qos": _describe(sample.qos),
                    }
                )
        endpoints.sort(key=lambda e: (e["topic"], e["kind"], e["node"]))
        return {"nodes": sorted(nodes), "endpoints": endpoints}


def _all(take: Callable) -> list:
    samples = []
    while taken := take(TAKE_MAX):
        samples.extend(taken)
    return samples


def _describe(qos: Qos) -> dict:
    def seconds(value: int) -> float | None:
        return None if value >= 1 << 62 else value / 1e9

    described = {
        "reliable": qos[Policy.Reliability] != Policy.Reliability.BestEffort,
        "transient_local": qos[Policy.Durability] == Policy.Durability.TransientLocal,
    }
    if Policy.Deadline in qos:
        described["deadline"] = seconds(qos[Policy.Deadline].deadline)
    if Policy.Userdata in qos:
        described["user_data"] = qos[Policy.Userdata].data.decode(errors="replace")
    return described
