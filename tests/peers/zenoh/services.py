"""Roles with services: `serve`, `call`."""

from __future__ import annotations

import argparse
import threading
import time

from interfaces import BASIC, Service
from rmw import Client, Node, Server
from run import EXIT_INCOMPLETE, EXIT_OK, Run, emit, open_context

ADD, BASIC_TYPES, TRIGGER = TYPES = ("example_interfaces/srv/AddTwoInts", "test_msgs/srv/BasicTypes", "std_srvs/srv/Trigger")


def answer_to(kind: str, request: dict) -> dict:
    """Returns the sum, the number plus one (as ../ros2/calls.py and text.py), or success."""
    if kind == ADD:
        return {"sum": request["a"] + request["b"]}
    if kind == BASIC_TYPES:
        return request | {"int64_value": request["int64_value"] + 1}
    return {"success": True, "message": "triggered"}


def request_of(kind: str, base: int, number: int) -> dict:
    if kind == ADD:
        return {"a": base, "b": number}
    if kind == BASIC_TYPES:
        return dict.fromkeys(BASIC, 0) | {"int64_value": base + number, "string_value": f"call {number}"}
    return {}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--type", choices=TYPES, default=ADD)
    parser.add_argument("--name", default="/add_two_ints")


def serve_options(parser: argparse.ArgumentParser) -> None:
    options(parser)
    parser.add_argument("--hold", action="store_true", help="answer open requests at a line on standard input")
    parser.add_argument("--delay", type=float, default=0, help="seconds that an answer takes")


def call_options(parser: argparse.ArgumentParser) -> None:
    options(parser)
    parser.add_argument("--count", type=int, default=0, help="calls to make at once")
    parser.add_argument("--base", type=int, default=1000, help="what the number of the call is added to")
    parser.add_argument("--stay", action="store_true", help="stay after --count answers, for lines and reports")


def serve(args: argparse.Namespace, run: Run) -> int:
    """Reports each request."""
    service, held, served = Service(args.type), [], 0
    lock = threading.Lock()

    def asked(payload: bytes, reply) -> None:
        request = service.decode_request(payload)

        def answer() -> None:
            nonlocal served
            # Counted first: the client may end this program as soon as it has the reply.
            with lock:
                served += 1
            reply(service.encode_reply(answer_to(args.type, request)))

        if args.hold:
            with lock:
                held.append(answer)
        # A reader of this report may send its line at once.
        emit("request", **{name: value for name, value in request.items() if name in ("a", "b", "int64_value")})
        if args.delay:
            threading.Timer(args.delay, answer).start()
        elif not args.hold:
            answer()

    with open_context(args, run) as context:
        _server = Server(Node(context, args.node), args.name, *service.identity, asked)
        emit("ready")
        run.read_lines()
        while run.take_line():
            with lock:
                answers, held[:] = held[:], []
            for answer in answers:
                answer()
            emit("released", count=len(answers))
        run.wait()
        emit("summary", role="serve", served=served)
    return EXIT_OK


def call(args: argparse.Namespace, run: Run) -> int:
    """Calls --count times once the service is there, reports when it goes and comes back, and calls at each line."""
    service = Service(args.type)
    begun: dict[int, float] = {}
    called = answered = wrong = 0
    took_us: list[int] = []
    is_there = False
    lock = threading.Lock()
    with open_context(args, run) as context:
        client = Client(Node(context, args.node), args.name, *service.identity)

        def look() -> None:
            nonlocal is_there
            with lock:
                changed = (client.servers() > 0) != is_there
                is_there ^= changed
                if changed:
                    emit("service", there=is_there)

        def make_call() -> None:
            nonlocal called
            called += 1
            number, request = called, request_of(args.type, args.base, called)

            def done(payload: bytes) -> None:
                nonlocal answered, wrong
                expected = answer_to(args.type, request)
                right = service.decode_reply(payload) == expected
                with lock:
                    since = begun.pop(number, None)
                    if since is None:
                        emit("unexpected", number=number)
                        return
                    took_us.append(int((time.monotonic() - since) * 1e6))
                    answered, wrong = answered + 1, wrong + (not right)
                emit("answer", n=number, right=right)
                run.wake()

            begun[number] = time.monotonic()
            client.call(service.encode_request(request), done)
            emit("called", n=number)

        context.graph.listeners.append(look)
        emit("ready")
        look()
        run.wait(lambda: is_there)
        for _ in range(args.count if is_there else 0):
            make_call()
        run.read_lines()
        if args.stay or not args.count:
            while run.take_line():
                make_call()
            run.wait()
        else:
            run.wait(lambda: answered >= args.count)
        took_us.sort()
        p50 = took_us[len(took_us) // 2] if took_us else None
        emit(
            "summary", role="call", called=called, answered=answered, wrong=wrong, open=len(begun), others=client.foreign,
            p50_us=p50,
        )  # fmt: skip
    return EXIT_OK if called >= args.count and answered == called and not wrong else EXIT_INCOMPLETE


ROLES = {"serve": (serve_options, serve), "call": (call_options, call)}
