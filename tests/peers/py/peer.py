"""A ROS 2-shaped talker and listener on Cyclone DDS that does not know SGC.

It speaks plain DDS with ROS 2's topic and type names and QoS, and reports in JSON lines. The command line and the lines
are those of `../README.md`, which the Fast DDS peer shares. Nothing here polls: discovery arrives by listener, data by
wait set, signals by `sigwait`.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import threading
import time

from messages import KINDS

EXIT_OK, EXIT_WRONG, EXIT_INCOMPLETE = 0, 1, 3
TAKE_MAX = 64

# Only `lo`: multicast there for those who announce by multicast (Fast DDS, ROS_LOCALHOST_ONLY), unicast to the first
# participant ports for those who do not (ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST).
LOCALHOST_XML = """<General><Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces>
<AllowMulticast>spdp</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>"""

# As shipped, Cyclone to Fast DDS needs many seconds for a message of several MB when socket buffers are small.
LARGE_XML = """<General><FragmentSize>14000B</FragmentSize></General>
<Internal><HeartbeatInterval>5 ms</HeartbeatInterval></Internal>"""

_print_lock = threading.Lock()


def emit(event: str, **fields: object) -> None:
    line = json.dumps({"event": event, **fields})
    with _print_lock:
        try:
            sys.stdout.write(line + "\n")
            sys.stdout.flush()
        except BrokenPipeError:
            # The reader of standard output is gone. An exception would end only this thread, and Cyclone's would keep the process.
            os._exit(EXIT_INCOMPLETE)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    roles = parser.add_subparsers(dest="role", required=True)
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--domain", type=int, default=0)
    common.add_argument("--topic", default="/chatter", help="ROS name; /chatter is rt/chatter on the wire")
    common.add_argument("--type", choices=sorted(KINDS), default="string")
    common.add_argument("--count", type=int, default=0, help="messages; 0: until --timeout or a signal")
    common.add_argument("--timeout", type=float, default=60.0, help="seconds, from the start")
    reliability = common.add_mutually_exclusive_group()
    reliability.add_argument("--reliable", dest="reliable", action="store_true", default=True)
    reliability.add_argument("--best-effort", dest="reliable", action="store_false")
    common.add_argument("--transient-local", action="store_true")
    common.add_argument("--depth", type=int, default=10, help="history depth; 0 keeps all")
    common.add_argument("--localhost", action="store_true", help="use the loopback interface only")
    common.add_argument("--udp-only", action="store_true", help="no shared memory (Cyclone has none here)")
    common.add_argument("--large", action="store_true", help="settings that large messages need (Cyclone only)")
    common.add_argument("--xcdr2", action="store_true", help="XCDR2 in the place of plain CDR (Cyclone only)")
    common.add_argument("--verbose", action="store_true", help="one line for each message")
    common.add_argument("--node", help="full name of the ROS node that its endpoint belongs to")
    common.add_argument("--gid-bytes", type=int, choices=(16, 24), default=16, help="length of ids in the ROS graph")
    common.add_argument("--deadline", type=float, help="deadline in seconds")
    pub = roles.add_parser("pub", parents=[common])
    pub.add_argument("--rate", type=float, default=10.0, help="messages a second; 0: as fast as it goes")
    pub.add_argument("--size", type=int, default=0, help="image: bytes of data; string: characters of filler")
    pub.add_argument("--start", type=int, default=0, help="first sequence number")
    pub.add_argument("--wait-matched", type=int, default=1, help="subscribers to wait for before sending")
    pub.add_argument("--wait-go", action="store_true", help="once matched, wait for a line on standard input")
    pub.add_argument("--wait-stop", action="store_true", help="a further line there ends the sending")
    pub.add_argument("--hold", type=float, default=0.0, help="seconds to stay after the last message")
    sub = roles.add_parser("sub", parents=[common])
    sub.add_argument("--linger", type=float, default=0.0, help="seconds to listen on for duplicates after --count")
    roles.add_parser("graph", parents=[common])
    return parser.parse_args()


def configuration(args: argparse.Namespace) -> str:
    parts = (LOCALHOST_XML if args.localhost else "") + (LARGE_XML if args.large else "")
    return f'<CycloneDDS><Domain Id="any">{parts}</Domain></CycloneDDS>' if parts else ""


class Stop:
    """Set once, by a signal or at the end of the work; wakes all waiting threads."""

    def __init__(self) -> None:
        self.event = threading.Event()
        self.by_signal = False
        self.hooks: list = []

    def set(self) -> None:
        self.event.set()
        for hook in self.hooks:
            hook()


def until_signal(stop: Stop) -> None:
    signal.sigwait({signal.SIGTERM, signal.SIGINT})
    stop.by_signal = True
    stop.set()


def qos_of(args: argparse.Namespace):
    from cyclonedds.core import Policy, Qos
    from cyclonedds.util import duration

    history = Policy.History.KeepLast(args.depth) if args.depth else Policy.History.KeepAll
    # A late joiner gets the samples of the durability service, which keeps 1 by default, whatever the history depth is. Both
    # get the same depth, as in rmw_cyclonedds.
    service = [Policy.DurabilityService(0, history, -1, -1, -1)] if args.transient_local else []
    deadline = [Policy.Deadline(duration(nanoseconds=int(args.deadline * 1e9)))] if args.deadline else []
    return Qos(
        *service,
        *deadline,
        history,
        Policy.Reliability.Reliable(duration(seconds=10)) if args.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if args.transient_local else Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=not args.xcdr2, use_xcdrv2_representation=args.xcdr2),
    )


class Matches:
    """Returns the number of matched counterparts."""

    def __init__(self) -> None:
        self.count = 0
        self.changed = threading.Condition()

    def update(self, _entity, status) -> None:
        with self.changed:
            self.count = status.current_count
            self.changed.notify_all()
        emit("matched", count=status.current_count)


def publish(args, stop: Stop, deadline: float) -> int:
    import graph
    from cyclonedds.core import Listener
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    kind, make, _ = KINDS[args.type]
    participant = graph.participant(args.domain, args.node)
    topic = Topic(participant, "rt" + args.topic, kind)
    matches = Matches()
    listener = Listener()
    listener.set_on_publication_matched(matches.update)
    writer = DataWriter(participant, topic, qos=qos_of(args), listener=listener)
    _node = graph.announce(participant, args.node, args.gid_bytes, [], [writer]) if args.node else None
    emit("ready")

    def wake() -> None:
        with matches.changed:
            matches.changed.notify_all()

    stop.hooks.append(wake)
    with matches.changed:
        matches.changed.wait_for(
            lambda: stop.event.is_set() or matches.count >= args.wait_matched, max(0.0, deadline - time.monotonic())
        )
    matched = matches.count >= args.wait_matched
    if matched and args.wait_go:
        matched = wait_go(stop, deadline)
    # Set at the end of sending; only `stop` ends the program.
    enough = threading.Event()
    stop.hooks.append(enough.set)
    if stop.event.is_set():
        enough.set()
    if matched and args.wait_stop:
        threading.Thread(target=lambda: (sys.stdin.readline(), enough.set()), daemon=True).start()
    sent, seq, first_at = 0, args.start, time.monotonic()
    while matched and not enough.is_set() and (args.count == 0 or sent < args.count):
        due = first_at + sent / args.rate if args.rate > 0 else 0.0
        if due > deadline or time.monotonic() > deadline:
            break
        if due > time.monotonic() and enough.wait(due - time.monotonic()):
            break
        writer.write(make(seq, time.time_ns(), args.size))
        if args.verbose:
            emit("sent", seq=seq)
        sent, seq = sent + 1, seq + 1
    seconds = time.monotonic() - first_at
    acknowledged = None
    if args.reliable and sent and not stop.by_signal:
        left = max(0.1, deadline - time.monotonic())
        acknowledged = writer.wait_for_acks(duration(milliseconds=int(left * 1000)))
    emit("all_sent", sent=sent, acknowledged=acknowledged)
    if args.hold > 0 and not stop.event.is_set():
        stop.event.wait(args.hold)
    emit(
        "summary", role="pub", sent=sent, first=args.start if sent else None, last=seq - 1 if sent else None,
        seconds=round(seconds, 3), acknowledged=acknowledged, matched=matches.count,
    )  # fmt: skip
    leave(participant)
    if stop.by_signal:
        return EXIT_OK
    return EXIT_OK if matched and sent >= args.count and acknowledged is not False else EXIT_INCOMPLETE


def leave(participant) -> None:
    """Deletes the participant and all it holds, so that the others hear a farewell now rather than miss us in 10 s.

    The binding's own destructor does not get to it: it looks itself up in a weak dictionary that has forgotten it by then.
    """
    participant._delete(participant._ref)


def wait_go(stop: Stop, deadline: float) -> bool:
    """Returns whether a line came on standard input before the deadline, a signal or the end of the input."""
    answer: list[bool] = []
    woken = threading.Event()
    stop.hooks.append(woken.set)

    def listen() -> None:
        answer.append(sys.stdin.readline() != "")
        woken.set()

    threading.Thread(target=listen, daemon=True).start()
    if not stop.event.is_set():
        woken.wait(max(0.0, deadline - time.monotonic()))
    return answer == [True] and not stop.event.is_set()


class Tally:
    """The record of received messages."""

    def __init__(self) -> None:
        self.seen: set[int] = set()
        self.duplicated = self.altered = self.reordered = 0
        self.last_seq = -1
        self.latency_us: list[int] = []

    def add(self, seq: int, stamp_ns: int, intact: bool) -> None:
        self.latency_us.append((time.time_ns() - stamp_ns) // 1000)
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
        pick = lambda part: ordered[min(len(ordered) - 1, int(len(ordered) * part))] if ordered else None  # noqa: E731
        return {
            "received": len(self.seen), "first": first, "last": last,
            "lost": last - first + 1 - len(self.seen) if self.seen else 0,
            "duplicated": self.duplicated, "altered": self.altered, "reordered": self.reordered,
            "latency_us": {"p50": pick(0.5), "p99": pick(0.99), "max": pick(1.0)},
        }  # fmt: skip


def subscribe(args, stop: Stop, deadline: float) -> int:
    import graph
    from cyclonedds.core import GuardCondition, InstanceState, Listener, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.internal import InvalidSample
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    kind, _, read = KINDS[args.type]
    participant = graph.participant(args.domain, args.node)
    topic = Topic(participant, "rt" + args.topic, kind)
    matches = Matches()
    listener = Listener()
    listener.set_on_subscription_matched(matches.update)
    reader = DataReader(participant, topic, qos=qos_of(args), listener=listener)
    _node = graph.announce(participant, args.node, args.gid_bytes, [reader], []) if args.node else None
    waiting = WaitSet(participant)
    waiting.attach(ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead))
    ending = GuardCondition(participant)
    waiting.attach(ending)
    stop.hooks.append(lambda: ending.set(True))
    if stop.event.is_set():
        ending.set(True)
    emit("ready")
    tally = Tally()
    complete_at = None
    while not stop.event.is_set():
        if args.count and complete_at is None and len(tally.seen) >= args.count:
            complete_at = time.monotonic()
        left = (deadline if complete_at is None else complete_at + args.linger) - time.monotonic()
        if left <= 0 or waiting.wait(duration(milliseconds=max(1, int(left * 1000)))) == 0:
            break
        for sample in reader.take(TAKE_MAX):
            if isinstance(sample, InvalidSample):
                continue
            try:
                seq, stamp_ns, intact = read(sample)
            except Exception as error:  # content so wrong that it cannot be read: altered
                emit("unreadable", error=repr(error))
                seq, stamp_ns, intact = -1, time.time_ns(), False
            tally.add(seq, stamp_ns, intact)
            if args.verbose or not intact:
                emit("received", seq=seq, ok=intact)
    emit("summary", role="sub", matched=matches.count, **tally.summary())
    stop.hooks.clear()
    leave(participant)
    if tally.altered or tally.duplicated:
        return EXIT_WRONG
    return EXIT_OK if stop.by_signal or len(tally.seen) >= args.count else EXIT_INCOMPLETE


def watch_graph(args, stop: Stop, deadline: float) -> int:
    """Reports nodes and endpoints at each change."""
    import graph
    from cyclonedds.core import GuardCondition, WaitSet
    from cyclonedds.util import duration

    node = args.node or "/graph_watcher"
    participant = graph.participant(args.domain, node)
    view = graph.Graph(participant, args.gid_bytes)
    _node = graph.announce(participant, node, args.gid_bytes, [], [])
    waiting = WaitSet(participant)
    view.attach(waiting)
    ending = GuardCondition(participant)
    waiting.attach(ending)
    stop.hooks.append(lambda: ending.set(True))
    if stop.event.is_set():
        ending.set(True)
    emit("ready")
    told = None
    while not stop.event.is_set():
        left = deadline - time.monotonic()
        if left <= 0 or waiting.wait(duration(milliseconds=max(1, int(left * 1000)))) == 0:
            break
        view.take()
        described = view.describe()
        if described != told:
            told = described
            emit("graph", **described)
    emit("summary", role="graph")
    stop.hooks.clear()
    leave(participant)
    return EXIT_OK if stop.by_signal else EXIT_INCOMPLETE


def main() -> None:
    args = arguments()
    # Blocked before any thread starts, so that every thread inherits it and only `sigwait` takes the signal.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT})
    if "CYCLONEDDS_URI" not in os.environ:
        os.environ["CYCLONEDDS_URI"] = configuration(args)
    stop = Stop()
    threading.Thread(target=until_signal, args=(stop,), daemon=True).start()
    role = {"pub": publish, "sub": subscribe, "graph": watch_graph}[args.role]
    code = role(args, stop, time.monotonic() + args.timeout)
    sys.exit(code)


if __name__ == "__main__":
    main()
