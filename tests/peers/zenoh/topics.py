"""Roles with topics: `pub`, `sub`, `ping`, `echo`."""

from __future__ import annotations

import argparse
import threading
import time

from content import Bulk, Tally, Text
from rmw import Attachment, Node, Publisher, Qos, Subscription
from run import EXIT_INCOMPLETE, EXIT_OK, EXIT_WRONG, Run, emit, open_context

# Zenoh reports no arrival. A session that closes at once may take its last messages with it.
SETTLE_S = 0.5
ECHO_PATIENCE_S = 1.0


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--topic", default="/chatter")
    parser.add_argument("--bytes", type=int, help="std_msgs/msg/UInt8MultiArray with so many bytes, not std_msgs/msg/String")
    parser.add_argument("--count", type=int, default=0, help="messages; 0: until --timeout or a signal")
    parser.add_argument("--reliable", dest="reliable", action="store_true", default=True)
    parser.add_argument("--best-effort", dest="reliable", action="store_false")
    parser.add_argument("--transient-local", action="store_true")
    parser.add_argument("--depth", type=int, default=10, help="history depth; 0 keeps all")
    parser.add_argument("--hash", help="another type hash")
    parser.add_argument("--buffers", action="store_true", help="as Lyrical does with types like that of --bytes")
    parser.add_argument("--verbose", action="store_true", help="one line for each message")


def pub_options(parser: argparse.ArgumentParser) -> None:
    options(parser)
    parser.add_argument("--rate", type=float, default=10.0, help="messages a second; 0: as fast as it goes")
    parser.add_argument("--size", type=int, default=0, help="characters of filler in a string; 0: as the number says")
    parser.add_argument("--start", type=int, default=0, help="first sequence number")
    parser.add_argument("--wait-matched", type=int, default=1, help="subscriptions to wait for before sending")
    parser.add_argument("--wait-go", action="store_true", help="once matched, wait for a line on standard input")
    parser.add_argument("--wait-stop", action="store_true", help="a further line there, or its end, ends the sending")
    parser.add_argument("--begin", type=float, default=0.0, help="seconds between the first message and the second")
    parser.add_argument("--hold", type=float, default=0.0, help="seconds to stay after the last message")


def sub_options(parser: argparse.ArgumentParser) -> None:
    options(parser)
    parser.add_argument("--linger", type=float, default=0.0, help="seconds to listen on for duplicates after --count")


def ping_options(parser: argparse.ArgumentParser) -> None:
    options(parser)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--back", default="/load_back", help="the topic of echoes")
    parser.set_defaults(topic="/load", bytes=1000)


def qos_of(args: argparse.Namespace) -> Qos:
    return Qos(reliable=args.reliable, transient_local=args.transient_local, depth=args.depth)


def content_of(args: argparse.Namespace) -> Text | Bulk:
    return Text() if args.bytes is None else Bulk()


def identity_of(args: argparse.Namespace, content: Text | Bulk) -> tuple[str, str]:
    type_name, type_hash = content.message.identity
    return type_name, args.hash or type_hash


class Matches:
    """Reports changes of the number of matched endpoints."""

    def __init__(self, endpoint: Publisher | Subscription) -> None:
        self.endpoint, self.count = endpoint, 0
        self.lock = threading.Lock()
        endpoint.node.context.graph.listeners.append(self.look)
        self.look()

    def look(self) -> None:
        with self.lock:
            count = self.endpoint.matched()
            if count != self.count:
                self.count = count
                emit("matched", count=count)


def publish(args: argparse.Namespace, run: Run) -> int:
    content = content_of(args)
    size = args.bytes if args.bytes is not None else args.size
    with open_context(args, run) as context:
        node = Node(context, args.node)
        publisher = Publisher(node, args.topic, *identity_of(args, content), qos_of(args), args.buffers)
        matches = Matches(publisher)
        emit("ready")
        if args.wait_go or args.wait_stop:
            run.read_lines()
        matched = run.wait(lambda: publisher.matched() >= args.wait_matched)
        if matched and args.wait_go:
            matched = run.take_line()
        begun, sent = time.monotonic(), 0
        while matched and not run.is_over() and (args.count == 0 or sent < args.count):
            due = begun + sent / args.rate if args.rate > 0 else 0.0
            if run.wait(lambda: args.wait_stop and bool(run.lines or run.input_ended), due) or run.is_over():
                break
            publisher.publish(content.make(args.start + sent, size))
            if args.verbose:
                emit("sent", seq=args.start + sent)
            sent += 1
            if sent == 1 and args.begin:
                run.wait(until=time.monotonic() + args.begin)
                begun += args.begin
        seconds = time.monotonic() - begun
        emit("all_sent", sent=sent, acknowledged=None)
        # A signal ends only a stay that was asked for.
        if args.hold:
            run.wait(until=time.monotonic() + args.hold)
        elif sent:
            time.sleep(SETTLE_S)
        first, last = (args.start, args.start + sent - 1) if sent else (None, None)
        emit(
            "summary", role="pub", sent=sent, first=first, last=last, seconds=round(seconds, 3), acknowledged=None,
            matched=matches.count,
        )  # fmt: skip
    return EXIT_OK if run.by_signal or (matched and sent >= args.count) else EXIT_INCOMPLETE


class Sources:
    """The publishers of received messages, by the ids in their attachments, and gaps in the numbers that they count."""

    def __init__(self) -> None:
        self.last: dict[bytes, int] = {}
        self.skipped = self.repeated = 0

    def add(self, attachment: Attachment) -> None:
        last = self.last.get(attachment.gid)
        if last is not None:
            self.skipped += max(0, attachment.number - last - 1)
            self.repeated += attachment.number <= last
        self.last[attachment.gid] = max(attachment.number, last or 0)

    def summary(self, gids: dict) -> dict:
        """Names each publisher's node, or its id if no token has that."""
        nodes = [gids[gid].node() if gid in gids else gid.hex() for gid in self.last]
        return {"from": sorted(nodes), "numbers_skipped": self.skipped, "numbers_repeated": self.repeated}


def subscribe(args: argparse.Namespace, run: Run) -> int:
    content, tally, sources = content_of(args), Tally(), Sources()

    def take(payload: bytes, attachment: Attachment) -> None:
        now = time.time_ns()
        try:
            seq, stamp_ns, intact = content.read(payload)
        except Exception as error:  # content so wrong that it cannot be read: altered
            emit("unreadable", error=repr(error))
            seq, stamp_ns, intact = -1, now, False
        with run.changed:
            tally.add(seq, now - stamp_ns, intact)
            sources.add(attachment)
        if args.verbose or not intact:
            emit("received", seq=seq, ok=intact)
        run.wake()

    def refuse(why: str) -> None:
        emit("unreadable", error=why)
        tally.altered += 1

    with open_context(args, run) as context:
        node = Node(context, args.node)
        subscription = Subscription(node, args.topic, *identity_of(args, content), take, qos_of(args), refuse, args.buffers)
        matches = Matches(subscription)
        emit("ready")
        if run.wait(lambda: 0 < args.count <= len(tally.seen)):
            run.wait(until=time.monotonic() + args.linger)
        with run.changed:
            described = tally.summary() | sources.summary(context.graph.gids)
        emit("summary", role="sub", matched=matches.count, **described)
    if tally.altered or tally.duplicated:
        return EXIT_WRONG
    return EXIT_OK if run.by_signal or len(tally.seen) >= args.count else EXIT_INCOMPLETE


def ping(args: argparse.Namespace, run: Run) -> int:
    """Publishes a message, waits for its echo, and publishes the next."""
    content, tally, came = content_of(args), Tally(), []

    def take(payload: bytes, _: Attachment) -> None:
        seq, _, intact = content.read(payload)
        came.append((seq, intact))
        run.wake()

    with open_context(args, run) as context:
        node = Node(context, args.node)
        publisher = Publisher(node, args.topic, *identity_of(args, content), qos_of(args))
        subscription = Subscription(node, args.back, *identity_of(args, content), take, qos_of(args))
        Matches(publisher)
        emit("ready")
        run.wait(lambda: publisher.matched() > 0 and subscription.matched() > 0)
        sent = 0
        while not run.is_over() and (args.count == 0 or sent < args.count):
            message = content.make(sent, args.bytes or 0)
            begun = time.monotonic()
            publisher.publish(message)
            # The first message may be lost if one end is matched before the other.
            if run.wait(lambda: any(seq == sent for seq, _ in came), begun + ECHO_PATIENCE_S):
                took = time.monotonic() - begun
                tally.add(sent, int(took * 1e9), all(intact for _, intact in came))
            came.clear()
            sent += 1
            if args.rate > 0:
                run.wait(until=begun + 1 / args.rate)
        emit("summary", role="ping", sent=sent, **tally.summary())
    return EXIT_WRONG if tally.altered else EXIT_OK if tally.seen else EXIT_INCOMPLETE


def echo(args: argparse.Namespace, run: Run) -> int:
    """Publishes each message of one topic on another, unread."""
    echoed = 0
    with open_context(args, run) as context:
        node, content = Node(context, args.node), content_of(args)
        publisher = Publisher(node, args.back, *identity_of(args, content), qos_of(args))

        def take(payload: bytes, _: Attachment) -> None:
            nonlocal echoed
            publisher.publish(payload)
            echoed += 1
            run.wake()

        subscription = Subscription(node, args.topic, *identity_of(args, content), take, qos_of(args))
        Matches(subscription)
        emit("ready")
        run.wait(lambda: 0 < args.count <= echoed)
        emit("summary", role="echo", received=echoed)
    return EXIT_OK if run.by_signal or echoed >= args.count else EXIT_INCOMPLETE


ROLES = {
    "pub": (pub_options, publish),
    "sub": (sub_options, subscribe),
    "ping": (ping_options, ping),
    "echo": (ping_options, echo),
}
