"""A client of the gateway: topics, services, actions and the graph.

Threads are those of grpc, and for each served service one that reads and a pool that runs the handler.
"""

from __future__ import annotations

import concurrent.futures
import logging
import os
import queue
import threading
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Callable, Dict, Generic, Iterator, List, Mapping, Optional, Set, Tuple, Type, TypeVar, Union
from urllib.parse import urlsplit

import grpc

from . import _cbor, _pin, _proto
from ._message import Info, Message

_log = logging.getLogger("sgc")

MESSAGE_BYTES_MAX = 64 << 20
"""The longest message in both directions, in bytes."""
_PORT = 50051
_CDR, _CBOR = 1, 3
_OPTIONS = [
    ("grpc.max_receive_message_length", MESSAGE_BYTES_MAX),
    ("grpc.max_send_message_length", MESSAGE_BYTES_MAX),
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 20_000),
    # Each client has a connection of its own, so unread messages of one never hold up another.
    ("grpc.use_local_subchannel_pool", 1),
]

Pem = Union[str, "os.PathLike[str]", bytes]
"""Certificates or a key in PEM: the name of a file, or its content."""
Content = Mapping[str, Any]
"""A message. Missing members have their defaults."""
T = TypeVar("T")
Handler = TypeVar("Handler", bound=Callable[..., Any])


class GatewayError(Exception):
    """A failure, with the message of the gateway."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code
        """The name of the gRPC status: ``PERMISSION_DENIED``, ``NOT_FOUND``, ``UNAVAILABLE`` …"""

    @classmethod
    def _of(cls, error: Any) -> "GatewayError":
        return cls(error.code().name, error.details() or error.code().name)


@dataclass(frozen=True)
class Qos:
    """Quality of service. The defaults are those of ROS 2."""

    reliable: bool = True
    latched: bool = False
    """Whether late subscribers get earlier messages (``transient_local``)."""
    depth: int = 10
    keep_all: bool = False

    def _proto(self) -> Any:
        return _proto.message("Qos")(
            reliability=2 if self.reliable else 1,
            durability=2 if self.latched else 1,
            depth=0 if self.keep_all else self.depth,
            keep_all=self.keep_all,
        )

    @classmethod
    def _of(cls, said: Any) -> "Qos":
        return cls(said.reliability != 1, said.durability == 2, said.depth, said.keep_all)


@dataclass(frozen=True)
class Endpoint:
    """A publisher or a subscriber."""

    node: str
    type: str
    qos: Qos


@dataclass(frozen=True)
class Topic:
    """A topic."""

    name: str
    type: str
    publishers: Tuple[Endpoint, ...]
    subscribers: Tuple[Endpoint, ...]


@dataclass(frozen=True)
class Service:
    """A service or an action."""

    name: str
    type: str
    servers: Tuple[str, ...]
    clients: Tuple[str, ...]


@dataclass(frozen=True)
class Node:
    """A node, with the names of its topics and services."""

    name: str
    publishes: Tuple[str, ...]
    subscribes: Tuple[str, ...]
    serves: Tuple[str, ...]
    calls: Tuple[str, ...]


@dataclass(frozen=True)
class Graph:
    """The topics, services, actions and nodes of the network, by name."""

    topics: Dict[str, Topic] = field(default_factory=dict)
    services: Dict[str, Service] = field(default_factory=dict)
    actions: Dict[str, Service] = field(default_factory=dict)
    nodes: Dict[str, Node] = field(default_factory=dict)

    def _with(self, changed: Any, gone: Any) -> "Graph":
        def merged(old: Dict[str, T], new: Any, lost: Any, read: Callable[[Any], T]) -> Dict[str, T]:
            kept = {name: one for name, one in old.items() if name not in set(lost)}
            kept.update({one.name: read(one) for one in new})
            return dict(sorted(kept.items()))

        return Graph(
            merged(self.topics, changed.topics, gone.topics, _topic),
            merged(self.services, changed.services, gone.services, _service),
            merged(self.actions, changed.actions, gone.actions, _service),
            merged(self.nodes, changed.nodes, gone.nodes, _node),
        )


def _topic(said: Any) -> Topic:
    def ends(of: Any) -> Tuple[Endpoint, ...]:
        return tuple(Endpoint(one.node, one.type, Qos._of(one.qos)) for one in of)

    return Topic(said.name, said.type, ends(said.publishers), ends(said.subscribers))


def _service(said: Any) -> Service:
    return Service(said.name, said.type, tuple(said.servers), tuple(said.clients))


def _node(said: Any) -> Node:
    lists = (said.publishes, said.subscribes, said.serves, said.calls)
    return Node(said.name, *(tuple(one) for one in lists))


@dataclass(frozen=True)
class TypeDefinition:
    """The definition of a type."""

    hash: str
    """The hash of a message type, ``RIHS01_…``."""
    texts: Dict[str, str]
    """The texts of its file and of the files of all types that it needs, by type."""


def _pem(said: Optional[Pem]) -> Optional[bytes]:
    if said is None or isinstance(said, bytes):
        return said
    with open(said, "rb") as file:
        return file.read()


def connect(
    address: str,
    *,
    token: Optional[str] = None,
    token_file: Optional[str] = None,
    ca: Optional[Pem] = None,
    certificate: Optional[Pem] = None,
    key: Optional[Pem] = None,
    server_name: Optional[str] = None,
    pin: Optional[str] = None,
    timeout: float = 10.0,
) -> "Client":
    """Connects to a gateway.

    ``address`` is ``grpc://HOST[:PORT]``, or ``grpcs://HOST[:PORT]`` over TLS. A gateway admits a program by ``token``
    (``sgc token access create --out FILE`` makes one), by a client certificate (``certificate`` and its ``key``), or because
    it runs on the gateway's host. ``token_file=FILE`` reads the token from a file, which keeps it out of programs and
    command lines. ``ca`` has the certificates that verify the gateway, by default those that the system trusts.
    ``server_name`` is the name in the gateway's certificate, if it is not HOST. Files are in PEM. ``pin`` verifies the
    gateway without any CA: ``sha256/…``, as ``sgc gateway certificate`` shows it. The call waits for the connection up to
    ``timeout`` seconds.
    """
    if token_file is not None:
        if token is not None:
            raise ValueError("give either token or token_file")
        with open(token_file, encoding="ascii") as file:
            token = file.read().strip()
    parts = urlsplit(address if "//" in address else f"grpc://{address}")
    if parts.scheme not in ("grpc", "grpcs") or not parts.hostname:
        raise ValueError(f"{address!r} is no address of a gateway: write grpc://HOST:PORT or grpcs://HOST:PORT")
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    target = f"{host}:{parts.port or _PORT}"
    options: List[Tuple[str, Any]] = list(_OPTIONS)
    if parts.scheme == "grpc":
        if ca or certificate or key or server_name or pin:
            raise ValueError("certificates and pins are for grpcs://")
        channel = grpc.insecure_channel(target, options)
    else:
        if server_name:
            options.append(("grpc.ssl_target_name_override", server_name))
        if pin is not None:
            if ca is not None:
                raise ValueError("give either ca or pin")
            try:
                ca = _pin.certificate(parts.hostname, parts.port or _PORT, pin, server_name, timeout)
            except _pin.PinMismatch as error:
                raise GatewayError("UNAVAILABLE", f"the gateway at {address} is another one: {error}") from None
            except OSError as error:
                raise GatewayError("UNAVAILABLE", f"no gateway at {address}: {error}") from None
        credentials = grpc.ssl_channel_credentials(_pem(ca), _pem(key), _pem(certificate))
        channel = grpc.secure_channel(target, credentials, options)
    try:
        grpc.channel_ready_future(channel).result(timeout)
    except grpc.FutureTimeoutError:
        channel.close()
        raise GatewayError("UNAVAILABLE", f"no gateway at {address} within {timeout:g} s") from None
    return Client(channel, token)


class Client:
    """A program's connection to a gateway.

    Threads may share it. It ends with :meth:`close`, or with the ``with`` block of which it is the context.
    """

    def __init__(self, channel: Any, token: Optional[str] = None) -> None:
        self._channel = channel
        self._calls = _proto.stub(channel)
        self._metadata = [("authorization", f"Bearer {token}")] if token else []
        self._open: Set[Any] = set()

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, kind: Optional[Type[BaseException]], _e: Any, _t: Optional[TracebackType]) -> None:
        try:
            self.close()
        except GatewayError as error:
            if kind is None:
                raise
            # The exception that ended the block matters more.
            _log.error("%s", error)

    def close(self) -> None:
        """Ends the publishers and services that it opened, and the connection.

        Raises the first failure of a publisher.
        """
        wrong: Optional[GatewayError] = None
        for one in list(self._open):
            try:
                one.close()
            except GatewayError as error:
                if wrong is not None:
                    _log.error("%s", error)
                wrong = wrong or error
        self._channel.close()
        if wrong is not None:
            raise wrong

    def _unary(self, name: str, request: Any, timeout: Optional[float]) -> Any:
        try:
            return self._calls[name](request, timeout=timeout, metadata=self._metadata)
        except grpc.RpcError as error:
            raise GatewayError._of(error) from None

    def _stream(self, name: str, request: Any) -> Any:
        return self._calls[name](request, metadata=self._metadata)

    def graph(self, *, hidden: bool = False, timeout: Optional[float] = 10.0) -> Graph:
        """Returns the graph of the network. ``hidden`` includes the topics and services that make up actions."""
        request = _proto.message("GetGraphRequest")(include_hidden=hidden)
        said = self._unary("GetGraph", request, timeout)
        return Graph()._with(said.graph, _proto.message("WatchGraphResponse.Gone")())

    def watch_graph(self, *, hidden: bool = False) -> Iterator[Graph]:
        """Yields the graph of the network, and the new graph after each change."""
        call = self._stream("WatchGraph", _proto.message("WatchGraphRequest")(include_hidden=hidden))
        graph = Graph()
        try:
            for change in call:
                graph = graph._with(change.changed, change.gone)
                yield graph
        except grpc.RpcError as error:
            raise GatewayError._of(error) from None
        finally:
            call.cancel()

    def type(self, name: str, *, timeout: Optional[float] = 10.0) -> TypeDefinition:
        """Returns the definition of a type, such as ``geometry_msgs/msg/Twist``."""
        said = self._unary("GetType", _proto.message("GetTypeRequest")(type=name), timeout)
        return TypeDefinition(said.type_hash, {one.type: one.text for one in said.definitions})

    def subscribe(
        self,
        topic: str,
        type: str = "",
        *,
        qos: Optional[Qos] = None,
        depth: int = 10,
        rate: float = 0.0,
        waits: bool = False,
    ) -> "Subscription[Message]":
        """Subscribes to a topic. The subscription is active once this returns.

        ``type`` may be left out if the topic exists on the network. At most ``rate`` messages a second arrive; 0 is no
        limit. Of messages that come faster than the program reads, the newest ``depth`` are kept. With ``waits``, up to
        64 MiB or 16384 messages of reliable publishers wait at the gateway before any is dropped. Without ``qos``, the
        subscription adapts to each publisher, and includes latched messages.
        """
        return Subscription(self, _subscribe_request(topic, type, _CBOR, qos, depth, rate, waits), _decode)

    def subscribe_raw(
        self,
        topic: str,
        type: str = "",
        *,
        qos: Optional[Qos] = None,
        depth: int = 10,
        rate: float = 0.0,
        waits: bool = False,
    ) -> "Subscription[Tuple[bytes, Info]]":
        """Subscribes like :meth:`subscribe`, and yields messages as serialised by ROS 2 (CDR)."""
        return Subscription(self, _subscribe_request(topic, type, _CDR, qos, depth, rate, waits), _raw)

    def publisher(self, topic: str, type: str = "", *, qos: Optional[Qos] = None, raw: bool = False) -> "Publisher":
        """Opens a publisher of a topic.

        ``type`` may be left out if the topic exists on the network. With ``raw``, messages are ``bytes`` as serialised
        by ROS 2 (CDR).
        """
        publisher = Publisher(self, topic, type, qos, raw)
        self._open.add(publisher)
        return publisher

    def call(
        self, service: str, request: Optional[Content] = None, type: str = "", *, timeout: Optional[float] = 10.0
    ) -> Message:
        """Calls a service and returns its reply, for which it waits up to ``timeout`` seconds."""
        payload = _cbor.dumps(request or {})
        said = _proto.message("CallRequest")(service=service, type=type, encoding=_CBOR, payload=payload)
        return _message(self._unary("Call", said, timeout).payload)

    def serve(
        self, service: str, handler: Callable[[Message], Content], type: str = "", *, workers: int = 4
    ) -> "Serving":
        """Serves a service until it is closed. The service is available once this returns.

        ``handler`` takes a request and returns the reply. It runs in up to ``workers`` threads. An exception in it is
        logged, and the caller gets no reply.
        """
        serving = Serving(self, service, type, handler, workers)
        self._open.add(serving)
        return serving

    def service(self, name: str, type: str = "", *, workers: int = 4) -> Callable[[Handler], Handler]:
        """Serves a service by the decorated function, like :meth:`serve`::

            @robot.service("/switch", "std_srvs/srv/SetBool")
            def switch(request):
                return {"success": True}
        """

        def decorate(handler: Handler) -> Handler:
            self.serve(name, handler, type, workers=workers)
            return handler

        return decorate

    def send_goal(self, action: str, goal: Optional[Content] = None, type: str = "") -> "Goal":
        """Sends a goal. A server has accepted it once this returns."""
        return Goal(self, action, goal or {}, type)

    def serve_action(
        self, action: str, handler: Callable[["ActionGoal"], Optional[Content]], type: str = "", *, workers: int = 4
    ) -> "Serving":
        """Serves an action until it is closed.

        ``handler`` works on a goal and returns the result. It runs in up to ``workers`` threads. An exception in it
        aborts the goal.
        """
        serving = _ServingAction(self, action, type, handler, workers)
        self._open.add(serving)
        return serving

    def action(self, name: str, type: str = "", *, workers: int = 4) -> Callable[[Handler], Handler]:
        """Serves an action by the decorated function, like :meth:`serve_action`."""

        def decorate(handler: Handler) -> Handler:
            self.serve_action(name, handler, type, workers=workers)
            return handler

        return decorate


def _subscribe_request(
    topic: str, type: str, encoding: int, qos: Optional[Qos], depth: int, rate: float, waits: bool
) -> Any:
    request = _proto.message("SubscribeRequest")(
        topic=topic, type=type, encoding=encoding, depth=depth, max_rate_hz=rate, waits=waits
    )
    if qos is not None:
        request.qos.CopyFrom(qos._proto())
    return request


def _message(payload: bytes) -> Message:
    message = _cbor.loads(payload)
    if not isinstance(message, Message):
        raise GatewayError("INTERNAL", "the gateway sent something else than a message")
    return message


def _info(said: Any) -> Info:
    return Info(said.source_time_ns, said.received_time_ns, said.node, said.dropped)


def _decode(said: Any) -> Message:
    message = _message(said.payload)
    message._sgc_info = _info(said)
    return message


def _raw(said: Any) -> Tuple[bytes, Info]:
    return said.payload, _info(said)


class Subscription(Generic[T]):
    """An iterator over the messages of a topic, which ends when it is closed."""

    def __init__(self, client: Client, request: Any, read: Callable[[Any], T]) -> None:
        self.topic: str = request.topic
        self._read = read
        self._is_closed = False
        self._call = client._stream("Subscribe", request)
        try:
            first = next(self._call).subscribed
        except grpc.RpcError as error:
            raise GatewayError._of(error) from None
        self.type: str = first.type
        self.type_hash: str = first.type_hash

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        while True:
            try:
                said = next(self._call)
            except grpc.RpcError as error:
                if self._is_closed:
                    raise StopIteration from None
                raise GatewayError._of(error) from None
            if said.WhichOneof("kind") == "message":
                return self._read(said.message)
            _log.warning("%s: a message of %s: %s", self.topic, said.unreadable.node, said.unreadable.reason)

    def __enter__(self) -> "Subscription[T]":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def close(self) -> None:
        """Ends the subscription. A thread that waits for a message stops waiting."""
        self._is_closed = True
        self._call.cancel()


class _Requests:
    """A queue of requests on a stream, which the gateway takes at its own pace."""

    def __init__(self, waiting_max: int) -> None:
        self._waiting: "queue.Queue[Any]" = queue.Queue(waiting_max)

    def __iter__(self) -> Iterator[Any]:
        return iter(self._waiting.get, None)

    def put(self, request: Any, call: Any) -> None:
        """Queues a request. Waits for room, and raises if the call has ended."""
        while not call.done():
            try:
                return self._waiting.put(request, timeout=0.1)
            except queue.Full:
                pass
        raise GatewayError._of(call)

    def end(self) -> None:
        """Ends the stream and the thread that sends on it. Drops requests that wait."""
        while True:
            try:
                return self._waiting.put_nowait(None)
            except queue.Full:
                try:
                    self._waiting.get_nowait()
                except queue.Empty:
                    pass


class Publisher:
    """A publisher of a topic, until it is closed."""

    def __init__(self, client: Client, topic: str, type: str, qos: Optional[Qos], raw: bool) -> None:
        self.topic = topic
        self._client = client
        self._is_raw = raw
        self._requests = _Requests(8)
        first = _proto.message("PublishRequest.Publisher")(topic=topic, type=type, encoding=_CDR if raw else _CBOR)
        if qos is not None:
            first.qos.CopyFrom(qos._proto())
        self._request = _proto.message("PublishRequest")
        self._requests._waiting.put(self._request(publisher=first))
        self._call = client._calls["Publish"].future(iter(self._requests), metadata=client._metadata)
        self._published: Optional[int] = None

    def publish(self, message: Optional[Union[Content, bytes]] = None, **members: Any) -> None:
        """Publishes a message: ``publish({"data": "left"})`` or ``publish(data="left")``.

        Waits while the gateway does not accept more. Raises the failure of an earlier message, if there was one.
        """
        if self._is_raw:
            payload = message if isinstance(message, bytes) else b""
        else:
            payload = _cbor.dumps(members if message is None else message)
        self._requests.put(self._request(payload=payload), self._call)

    def close(self, timeout: float = 10.0) -> int:
        """Ends the publisher and returns the number of published messages. Raises the failure of a message."""
        self._client._open.discard(self)
        if self._published is None:
            try:
                self._requests.put(None, self._call)
                self._published = int(self._call.result(timeout).published)
            except grpc.RpcError as error:
                raise GatewayError._of(error) from None
            except grpc.FutureTimeoutError:
                self._call.cancel()
                raise GatewayError("DEADLINE_EXCEEDED", f"{self.topic} does not take what waits") from None
            finally:
                self._requests.end()
        return self._published

    def __enter__(self) -> "Publisher":
        return self

    def __exit__(self, kind: Optional[Type[BaseException]], _e: Any, _t: Any) -> None:
        if kind is None:
            self.close()
        else:
            self._client._open.discard(self)
            self._call.cancel()
            self._requests.end()


class Serving:
    """A service or an action that this program serves, until it is closed."""

    _call_name, _request_name = "Serve", "ServeRequest"

    def __init__(
        self, client: Client, name: str, type: str, handler: Callable[..., Any], workers: int
    ) -> None:
        self.name = name
        self._client = client
        self._handler = handler
        self._requests = _Requests(64)
        self._request = _proto.message(self._request_name)
        self._requests._waiting.put(self._request(server=self._server(name, type)))
        self._call = client._stream(self._call_name, iter(self._requests))
        self._error: Optional[GatewayError] = None
        self._is_closed = False
        try:
            self.type: str = next(self._call).served.type
        except grpc.RpcError as error:
            self._requests.end()
            raise GatewayError._of(error) from None
        self._pool = concurrent.futures.ThreadPoolExecutor(workers, thread_name_prefix=f"sgc {name}")
        self._thread = threading.Thread(target=self._run, name=f"sgc {name}", daemon=True)
        self._thread.start()

    def _server(self, name: str, type: str) -> Any:
        return _proto.message("ServeRequest.Server")(service=name, type=type, encoding=_CBOR)

    def _run(self) -> None:
        try:
            for said in self._call:
                self._hear(said)
        except grpc.RpcError as error:
            if not self._is_closed:
                self._error = GatewayError._of(error)
                _log.error("%s is not served any more: %s", self.name, self._error)
        finally:
            self._pool.shutdown(wait=False)
            self._requests.end()
            self._client._open.discard(self)

    def _hear(self, said: Any) -> None:
        kind = said.WhichOneof("kind")
        if kind == "request":
            self._pool.submit(self._answer, said.request)
        elif kind == "refused":
            _log.error("%s: a reply was refused: %s", self.name, said.refused.reason)

    def _answer(self, asked: Any) -> None:
        try:
            payload = _cbor.dumps(self._handler(_message(asked.payload)))
            reply = _proto.message("ServeRequest.Reply")(id=asked.id, payload=payload)
            self._say(reply=reply)
        except Exception:
            _log.exception("%s: a request is not answered", self.name)

    def _say(self, **kind: Any) -> None:
        self._requests.put(self._request(**kind), self._call)

    def wait(self) -> None:
        """Waits until it is closed. Raises the reason if the gateway ended it."""
        self._thread.join()
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Ends it. Requests that are still open get no reply."""
        self._is_closed = True
        self._call.cancel()

    def __enter__(self) -> "Serving":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


class ActionGoal:
    """A goal that this program works on."""

    def __init__(self, serving: "_ServingAction", goal_id: bytes, request: Message) -> None:
        self.id = goal_id
        self.request = request
        """The content of the goal."""
        self._serving = serving
        self._is_to_end = threading.Event()

    @property
    def is_canceled(self) -> bool:
        """Whether the goal is to be canceled. The handler then returns the result that it has."""
        return self._is_to_end.is_set()

    def wait(self, seconds: float) -> bool:
        """Waits for the time, or until the goal is to be canceled. Returns whether it is."""
        return self._is_to_end.wait(seconds)

    def feedback(self, message: Content) -> None:
        """Sends feedback to the client."""
        said = _proto.message("ServeActionRequest.Feedback")(goal_id=self.id, payload=_cbor.dumps(message))
        self._serving._say(feedback=said)


class _ServingAction(Serving):
    _call_name, _request_name = "ServeAction", "ServeActionRequest"

    def __init__(self, *args: Any) -> None:
        self._goals: Dict[bytes, ActionGoal] = {}
        super().__init__(*args)

    def _server(self, name: str, type: str) -> Any:
        return _proto.message("ServeActionRequest.Server")(action=name, type=type, encoding=_CBOR)

    def _hear(self, said: Any) -> None:
        kind = said.WhichOneof("kind")
        if kind == "goal":
            goal = ActionGoal(self, said.goal.goal_id, _message(said.goal.payload))
            self._goals[goal.id] = goal
            self._say(answer=_proto.message("ServeActionRequest.Answer")(goal_id=goal.id, is_taken=True))
            self._pool.submit(self._work, goal)
        elif kind == "cancel":
            goal_to_end = self._goals.get(said.cancel.goal_id)
            if goal_to_end is not None:
                goal_to_end._is_to_end.set()
        elif kind == "refused":
            _log.error("%s: refused: %s", self.name, said.refused.reason)

    def _work(self, goal: ActionGoal) -> None:
        finish = _proto.message("ServeActionRequest.Finish")(goal_id=goal.id)
        try:
            finish.payload = _cbor.dumps(self._handler(goal) or {})
            finish.status = 5 if goal.is_canceled else 4
        except Exception:
            _log.exception("%s: a goal is aborted", self.name)
            finish.status, finish.payload = 6, _cbor.dumps({})
        self._goals.pop(goal.id, None)
        try:
            self._say(finish=finish)
        except GatewayError as error:
            _log.error("%s: a goal is not finished: %s", self.name, error)


@dataclass(frozen=True)
class Outcome:
    """The end of a goal."""

    status: str
    """``succeeded``, ``canceled`` or ``aborted``."""
    result: Message


class Goal:
    """A goal that a server has accepted: iterate over its feedback, then ask for its outcome."""

    _STATUS = {4: "succeeded", 5: "canceled", 6: "aborted"}

    def __init__(self, client: Client, action: str, goal: Content, type: str) -> None:
        self.action = action
        self._requests = _Requests(4)
        self._request = _proto.message("SendGoalRequest")
        first = _proto.message("SendGoalRequest.Goal")(
            action=action, type=type, encoding=_CBOR, payload=_cbor.dumps(goal)
        )
        self._requests._waiting.put(self._request(goal=first))
        self._call = client._stream("SendGoal", iter(self._requests))
        self._outcome: Optional[Outcome] = None
        taken = self._next()
        if taken is None:
            raise GatewayError("INTERNAL", f"{action} said nothing of the goal")
        self.id: bytes = taken.taken.goal_id

    def _next(self) -> Any:
        try:
            return next(self._call, None)
        except grpc.RpcError as error:
            self._requests.end()
            raise GatewayError._of(error) from None

    def __iter__(self) -> Iterator[Message]:
        """Yields the feedback until the goal has ended."""
        while self._outcome is None:
            said = self._next()
            if said is None:
                raise GatewayError("UNAVAILABLE", f"{self.action} did not say how the goal ended")
            kind = said.WhichOneof("kind")
            if kind == "feedback":
                yield _message(said.feedback.payload)
            elif kind == "result":
                status = self._STATUS.get(said.result.status, "unknown")
                self._outcome = Outcome(status, _message(said.result.payload))
                self._requests.end()

    def outcome(self) -> Outcome:
        """Waits for the end of the goal and returns it. Discards feedback that was not read."""
        for _ in self:
            pass
        assert self._outcome is not None
        return self._outcome

    def cancel(self) -> None:
        """Asks the server to cancel the goal."""
        self._requests.put(self._request(cancel=_proto.message("SendGoalRequest.Cancel")()), self._call)
