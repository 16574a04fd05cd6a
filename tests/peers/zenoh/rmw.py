"""A node of rmw_zenoh on eclipse-zenoh: its keys, liveliness tokens, ids, attachments and the Zenoh entities behind endpoints.

Written from docs/spec/zenoh.md and the source of rmw_zenoh_cpp (Kilted); no code of SGC has a part in it. Payloads are bytes:
`cdr.py` makes them. Callbacks run on threads of eclipse-zenoh, one after the other for each endpoint.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from dataclasses import dataclass
from typing import Callable

import xxhash
import zenoh

ADMIN_SPACE = "@ros2_lv"
NODE, PUBLISHER, SUBSCRIPTION, SERVER, CLIENT = KINDS = ("NN", "MP", "MS", "SS", "SC")
NODE_CHUNKS, ENDPOINT_CHUNKS = 9, 13
GID_BYTES = 16
ATTACHMENT = struct.Struct("<qqB16s")
HEARTBEAT_S = 0.5
# rmw_zenoh waits for replies for ever.
CALL_TIMEOUT_S = 10.0 * 365 * 24 * 3600
DEFAULT_DEPTH = 42
INFINITE = (9_223_372_036, 854_775_807)
# Endpoints of Lyrical and Rolling on types with an unbounded `uint8[]` add this to their tokens.
BACKENDS_CPU = "backends:cpu:"


def base_config(mode: str) -> dict:
    """Returns the settings that rmw_zenoh's sessions and its router share (DEFAULT_RMW_ZENOH_*_CONFIG.json5)."""
    to_peer = "always" if mode == "router" else "greater-zid"
    targets = {"router": ["router", "peer"], "peer": ["router"]}
    return {
        "mode": mode,
        "connect": {
            "timeout_ms": {"router": -1, "peer": -1, "client": 0},
            "exit_on_failure": {"router": False, "peer": False, "client": True},
            "retry": {"period_init_ms": 1000, "period_max_ms": 4000, "period_increase_factor": 2},
        },
        "scouting": {
            "multicast": {"enabled": False},
            "gossip": {
                "enabled": True,
                "multihop": False,
                "target": targets,
                "autoconnect": {"router": [], "peer": ["router", "peer"]},
                "autoconnect_strategy": {mode: {"to_router": "always", "to_peer": to_peer}} if mode != "client" else {},
            },
        },
        "timestamping": {
            "enabled": {"router": True, "peer": True, "client": True},
            "drop_future_timestamp": False,
        },
        "queries_default_timeout": 600_000,
        "transport": {
            "unicast": {
                "open_timeout": 60_000,
                "accept_timeout": 60_000,
                "accept_pending": 10_000,
                "max_sessions": 10_000,
                "max_links": 1,
            },
            "link": {
                "tx": {
                    "lease": 60_000,
                    "keep_alive": 2,
                    "queue": {"congestion_control": {"block": {"wait_before_close": 60_000_000}}},
                },
            },
            "shared_memory": {"enabled": False},
        },
    }


def session_config(connect: list[str], mode: str = "peer", zid: str | None = None, lease_s: float = 60) -> dict:
    """Returns the settings of a session of rmw_zenoh, with other routers."""
    config = base_config(mode)
    config["connect"]["endpoints"] = connect
    if mode == "peer":
        config["listen"] = {"endpoints": ["tcp/localhost:0"]}
    if zid:
        config["id"] = zid
    config["transport"]["link"]["tx"]["lease"] = int(lease_s * 1000)
    return config


def with_tls(config: dict, ca: str | None, cert: str | None, key: str | None, mutual: bool, verify_name: bool) -> dict:
    """Adds certificates: of a listener in a router, else of the connecting side."""
    side = "listen" if config["mode"] == "router" else "connect"
    tls = {"root_ca_certificate": ca, "enable_mtls": mutual, "verify_name_on_connect": verify_name}
    tls |= {f"{side}_certificate": cert, f"{side}_private_key": key}
    if side == "listen":
        # A router dials others with the same certificate.
        tls |= {"connect_certificate": cert, "connect_private_key": key}
    config["transport"]["link"]["tls"] = {name: value for name, value in tls.items() if value is not None}
    return config


def open_session(config: dict) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


@dataclass(frozen=True)
class Qos:
    """The QoS of an endpoint. Durations are nanoseconds, `None` for infinite ones; depth 0 keeps all."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = 10
    deadline: int | None = None
    lifespan: int | None = None
    manual_by_topic: bool = False
    lease: int | None = None

    def text(self) -> str:
        def duration(ns: int | None) -> str:
            pair = INFINITE if ns is None else divmod(ns, 10**9)
            return ",".join("" if part == default else str(part) for part, default in zip(pair, INFINITE))

        depth = "" if self.depth in (0, DEFAULT_DEPTH) else self.depth
        return ":".join(
            [
                "" if self.reliable else "2",
                "1" if self.transient_local else "",
                f"{'' if self.depth else 2},{depth}",
                duration(self.deadline),
                duration(self.lifespan),
                f"{3 if self.manual_by_topic else ''},{duration(self.lease)}",
            ]
        )

    @classmethod
    def parse(cls, text: str) -> "Qos":
        def duration(seconds: str, ns: str) -> int | None:
            pair = (int(seconds or INFINITE[0]), int(ns or INFINITE[1]))
            return None if pair in (INFINITE, (0, 0)) else pair[0] * 10**9 + pair[1]

        reliability, durability, history, deadline, lifespan, liveliness = text.split(":")
        keeps, depth = history.split(",")
        manual, lease = liveliness.split(",", 1)
        return cls(
            reliable=reliability != "2",
            transient_local=durability == "1",
            depth=0 if keeps == "2" else int(depth or 0) or DEFAULT_DEPTH,
            deadline=duration(*deadline.split(",")),
            lifespan=duration(*lifespan.split(",")),
            manual_by_topic=manual == "3",
            lease=duration(*lease.split(",")),
        )


PARAMETERS = Qos(depth=1000)


def mangled(name: str) -> str:
    return name.replace("/", "%")


@dataclass(frozen=True)
class Entity:
    """A node or an endpoint, as its token describes it."""

    domain: int
    session: str
    node_id: int
    id: int
    kind: str
    enclave: str
    namespace: str
    name: str
    topic: str = ""
    type: str = ""
    hash: str = ""
    qos: str = ""
    backends: str = ""

    def token(self) -> str:
        ids = [ADMIN_SPACE, str(self.domain), self.session, str(self.node_id), str(self.id), self.kind]
        node = [mangled(self.enclave), mangled(self.namespace), self.name]
        endpoint = [mangled(self.topic), mangled(self.type), self.hash, self.qos] if self.kind != NODE else []
        return "/".join(ids + node + endpoint + ([self.backends] if self.backends else []))

    @classmethod
    def parse(cls, token: str) -> "Entity | None":
        """Returns `None` for other keys, as rmw_zenoh skips them."""
        chunks = token.split("/")
        kind = chunks[5] if len(chunks) >= NODE_CHUNKS else ""
        if chunks[0] != ADMIN_SPACE or kind not in KINDS or (kind != NODE and len(chunks) < ENDPOINT_CHUNKS):
            return None
        _, domain, session, node_id, ident, _, enclave, namespace, name, *rest = chunks
        enclave, namespace = (part.replace("%", "/") for part in (enclave, namespace))
        try:
            entity = (int(domain), session, int(node_id), int(ident), kind, enclave, namespace, name)
        except ValueError:
            return None
        if kind == NODE:
            return cls(*entity)
        topic, type_name, type_hash, qos, *backends = rest
        topic, type_name = topic.replace("%", "/"), type_name.replace("%", "/")
        return cls(*entity, topic, type_name, type_hash, qos, backends[0] if backends else "")

    def key(self) -> str:
        return f"{self.domain}/{self.topic.strip('/')}/{self.type}/{self.hash}"

    def node(self) -> str:
        return f"{self.namespace.rstrip('/')}/{self.name}"


def gid_of(token: str) -> bytes:
    digest = xxhash.xxh3_128_intdigest(token.encode())
    return digest.to_bytes(GID_BYTES, "little")


@dataclass(frozen=True)
class Attachment:
    number: int
    stamp_ns: int
    gid: bytes

    def encode(self) -> bytes:
        return ATTACHMENT.pack(self.number, self.stamp_ns, GID_BYTES, self.gid)

    @classmethod
    def decode(cls, data: zenoh.ZBytes | None) -> "Attachment":
        data = bytes(data) if data is not None else b""
        if len(data) != ATTACHMENT.size or data[16] != GID_BYTES:
            raise ValueError(f"no attachment of rmw_zenoh: {data.hex()}")
        number, stamp_ns, _, gid = ATTACHMENT.unpack(data)
        return cls(number, stamp_ns, gid)


class Graph:
    """The nodes and endpoints of a domain, from their tokens."""

    def __init__(self, session: zenoh.Session, domain: int) -> None:
        self.lock = threading.Lock()
        self.entities: dict[str, Entity] = {}
        # Programs look at each change, and a domain may have thousands of endpoints.
        self.by_key: dict[tuple[str, str], dict[str, Entity]] = {}
        # Endpoints that have ended stay, for messages that are still on their way.
        self.gids: dict[bytes, Entity] = {}
        self.listeners: list[Callable[[], None]] = []
        self.subscriber = session.liveliness().declare_subscriber(f"{ADMIN_SPACE}/{domain}/**", self._note, history=True)

    def _note(self, sample: zenoh.Sample) -> None:
        token = str(sample.key_expr)
        entity = Entity.parse(token)
        if entity is None:
            return
        with self.lock:
            alike = self.by_key.setdefault((entity.kind, entity.key()), {})
            if sample.kind == zenoh.SampleKind.PUT:
                self.entities[token] = alike[token] = entity
                self.gids[gid_of(token)] = entity
            else:
                self.entities.pop(token, None)
                alike.pop(token, None)
        for listener in self.listeners:
            listener()

    def endpoints(self, kind: str, key: str) -> list[Entity]:
        with self.lock:
            return list(self.by_key.get((kind, key), {}).values())

    def describe(self) -> dict:
        with self.lock:
            entities = list(self.entities.values())
        endpoints = [
            {
                "topic": entity.topic,
                "kind": {"MP": "publisher", "MS": "subscription", "SS": "server", "SC": "client"}[entity.kind],
                "type": entity.type,
                "hash": entity.hash,
                "node": entity.node(),
                "session": entity.session,
                "qos": entity.qos,
                "backends": entity.backends,
            }
            for entity in entities
            if entity.kind != NODE
        ]
        endpoints.sort(key=lambda one: (one["topic"], one["kind"], one["node"], one["session"]))
        return {"nodes": sorted(entity.node() for entity in entities if entity.kind == NODE), "endpoints": endpoints}


class Context:
    """A session, its graph, and the count that numbers its nodes and endpoints."""

    def __init__(self, config: dict, domain: int = 0, enclave: str = "/") -> None:
        self.session = open_session(config)
        self.domain, self.enclave = domain, enclave
        self.zid = str(self.session.zid())
        self.graph = Graph(self.session, domain)
        self.next_id = 0
        self.lock = threading.Lock()

    def take_id(self) -> int:
        with self.lock:
            self.next_id += 1
            return self.next_id - 1

    def wait_for_router(self, deadline: float) -> bool:
        """Waits as rmw_zenoh does at the start of a node."""
        while not self.session.info.routers_zid():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.02)
        return True

    def close(self) -> None:
        """Closes the session. Without this, the process does not end."""
        self.session.close()

    def __enter__(self) -> "Context":
        return self

    def __exit__(self, *_exc: object) -> None:
        self.close()


class Node:
    def __init__(self, context: Context, full_name: str) -> None:
        namespace, self.name = full_name.rsplit("/", 1)
        self.context, self.namespace = context, namespace or "/"
        self.id = context.take_id()
        ids = (context.domain, context.zid, self.id, self.id)
        self.entity = Entity(*ids, NODE, context.enclave, self.namespace, self.name)
        self.token = context.session.liveliness().declare_token(self.entity.token())

    def endpoint(self, kind: str, topic: str, type_name: str, type_hash: str, qos: Qos, backends: str = "") -> Entity:
        context = self.context
        ids = (context.domain, context.zid, self.id, context.take_id())
        node = (context.enclave, self.namespace, self.name)
        return Entity(*ids, kind, *node, topic, type_name, type_hash, qos.text(), backends)

    def destroy(self) -> None:
        self.token.undeclare()


class Endpoint:
    """The parts of all endpoints: the entity, its Zenoh declaration, and its token, which is declared last."""

    def __init__(self, node: Node, entity: Entity) -> None:
        self.node, self.entity, self.key = node, entity, entity.key()
        self.gid = gid_of(entity.token())
        self.declared: list = []

    def announce(self) -> None:
        self.token = self.node.context.session.liveliness().declare_token(self.entity.token())

    def others(self, kind: str) -> int:
        """Returns the number of endpoints of a kind that it matches."""
        return len(self.node.context.graph.endpoints(kind, self.key))

    def destroy(self) -> None:
        self.token.undeclare()
        for one in self.declared:
            one.undeclare()


class Publisher(Endpoint):
    """A publisher. With `buffers` it is one of Lyrical that writes to the keys of buffers alone."""

    def __init__(
        self, node: Node, topic: str, type_name: str, type_hash: str, qos: Qos = Qos(), buffers: bool = False
    ) -> None:
        self.buffers = buffers and not qos.transient_local
        backends = BACKENDS_CPU if self.buffers else ""
        super().__init__(node, node.endpoint(PUBLISHER, topic, type_name, type_hash, qos, backends))
        self.number = 0
        self.lock = threading.Lock()
        blocks = qos.reliable and qos.depth == 0
        self.congestion = zenoh.CongestionControl.BLOCK if blocks else zenoh.CongestionControl.DROP
        common = {
            "congestion_control": self.congestion,
            "reliability": zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT,
        }
        session = node.context.session
        if qos.transient_local:
            misses = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S)
            self.publisher = zenoh.ext.declare_advanced_publisher(
                session,
                self.key,
                cache=zenoh.ext.CacheConfig(qos.depth or DEFAULT_DEPTH),
                sample_miss_detection=misses if qos.reliable else None,
                publisher_detection=True,
                **common,
            )
        else:
            self.publisher = session.declare_publisher(self.key, **common)
        self.declared.append(self.publisher)
        self.announce()

    def publish(self, payload: bytes) -> None:
        with self.lock:
            self.number += 1
            attachment = Attachment(self.number, time.time_ns(), self.gid).encode()
            if not self.buffers:
                self.publisher.put(payload, attachment=attachment)
                return
            for key in self.buffer_keys():
                session = self.node.context.session
                session.put(key, payload, attachment=attachment, congestion_control=self.congestion)

    def buffer_keys(self) -> set[str]:
        """Returns the keys of the matched subscriptions. One without backends does not listen on its key, and so gets nothing."""
        subscriptions = self.node.context.graph.endpoints(SUBSCRIPTION, self.key)
        return {
            f"{self.key}/_buf_cpu" if one.backends == BACKENDS_CPU else f"{self.key}/_buf/{gid_of(one.token()).hex()}"
            for one in subscriptions
        }

    def matched(self) -> int:
        return self.others(SUBSCRIPTION)


class Subscription(Endpoint):
    """Passes each payload with its attachment to `take`, and each sample without one to `refuse`.

    With `buffers` it is one of Lyrical, which also listens on the key of buffers.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        type_name: str,
        type_hash: str,
        take: Callable[[bytes, Attachment], None],
        qos: Qos = Qos(),
        refuse: Callable[[str], None] = print,
        buffers: bool = False,
    ) -> None:
        buffers = buffers and not qos.transient_local
        backends = BACKENDS_CPU if buffers else ""
        super().__init__(node, node.endpoint(SUBSCRIPTION, topic, type_name, type_hash, qos, backends))

        def received(sample: zenoh.Sample) -> None:
            try:
                attachment = Attachment.decode(sample.attachment)
            except ValueError as error:
                refuse(str(error))
                return
            take(bytes(sample.payload), attachment)

        session = node.context.session
        if qos.transient_local:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth or DEFAULT_DEPTH)
            recovery = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
            subscriber = zenoh.ext.declare_advanced_subscriber(
                session,
                self.key,
                received,
                history=history,
                recovery=recovery if qos.reliable else None,
                subscriber_detection=True,
            )
        else:
            subscriber = session.declare_subscriber(self.key, received)
        self.declared.append(subscriber)
        if buffers:
            self.declared.append(session.declare_subscriber(f"{self.key}/_buf_cpu", received))
        self.announce()

    def matched(self) -> int:
        return self.others(PUBLISHER)


class Server(Endpoint):
    """Passes each request to `answer`, with a function that sends the reply, now or later."""

    def __init__(
        self,
        node: Node,
        name: str,
        type_name: str,
        type_hash: str,
        answer: Callable[[bytes, Callable[[bytes], None]], None],
        qos: Qos = Qos(),
    ) -> None:
        super().__init__(node, node.endpoint(SERVER, name, type_name, type_hash, qos))

        def asked(query: zenoh.Query) -> None:
            request = Attachment.decode(query.attachment)

            def reply(payload: bytes) -> None:
                # Number and id are those of the request, the time is the server's.
                attachment = Attachment(request.number, time.time_ns(), request.gid)
                query.reply(self.key, payload, attachment=attachment.encode())
                # The client's query lasts until then.
                query.drop()

            answer(bytes(query.payload or b""), reply)

        self.declared.append(node.context.session.declare_queryable(self.key, asked, complete=True))
        self.announce()


class Client(Endpoint):
    def __init__(self, node: Node, name: str, type_name: str, type_hash: str, qos: Qos = Qos()) -> None:
        super().__init__(node, node.endpoint(CLIENT, name, type_name, type_hash, qos))
        self.number = 0
        # Replies that were not those to the request.
        self.foreign = 0
        self.lock = threading.Lock()
        self.announce()

    def call(self, payload: bytes, then: Callable[[bytes], None]) -> int:
        """Calls each matching server. Each reply goes to `then`."""
        with self.lock:
            self.number += 1
            number = self.number

        def replied(reply: zenoh.Reply) -> None:
            if reply.ok is None:
                return
            attachment = Attachment.decode(reply.ok.attachment)
            if attachment.number != number or attachment.gid != self.gid:
                self.foreign += 1
                return
            then(bytes(reply.ok.payload))

        self.node.context.session.get(
            self.key,
            replied,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=CALL_TIMEOUT_S,
            payload=payload,
            attachment=Attachment(number, time.time_ns(), self.gid).encode(),
        )
        return number

    def servers(self) -> int:
        return self.others(SERVER)
