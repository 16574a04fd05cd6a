"""The parts that all roles share: reports on standard output, the end by a signal or a time-out, and lines on standard input."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import threading
import time
from typing import Callable

import rmw
import zenoh

EXIT_OK, EXIT_WRONG, EXIT_USAGE, EXIT_INCOMPLETE = 0, 1, 2, 3

_print_lock = threading.Lock()


def emit(event: str, **fields: object) -> None:
    line = json.dumps({"event": event, **fields})
    with _print_lock:
        try:
            sys.stdout.write(line + "\n")
            sys.stdout.flush()
        except BrokenPipeError:
            # The reader of standard output is gone. An exception would end only this thread.
            os._exit(EXIT_INCOMPLETE)


def block_signals() -> None:
    """Blocks the signals of `Run` in this thread and those that it starts. The first session starts threads."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT})


class Run:
    """A running role: it ends at its deadline, at a signal, or when it is `finish`ed."""

    def __init__(self, timeout: float) -> None:
        self.deadline = time.monotonic() + timeout
        self.changed = threading.Condition()
        self.is_stopped = self.by_signal = False
        self.lines: list[str] = []
        self.input_ended = False
        threading.Thread(target=self._until_signal, daemon=True).start()

    def _until_signal(self) -> None:
        signal.sigwait({signal.SIGTERM, signal.SIGINT})
        self.by_signal = True
        self.finish()

    def finish(self) -> None:
        with self.changed:
            self.is_stopped = True
            self.changed.notify_all()

    def wake(self) -> None:
        with self.changed:
            self.changed.notify_all()

    def wait(self, is_so: Callable[[], bool] = lambda: False, until: float | None = None) -> bool:
        """Waits until the condition holds, which is looked at after each `wake`. Returns whether it holds."""
        until = self.deadline if until is None else min(until, self.deadline)
        with self.changed:
            self.changed.wait_for(lambda: self.is_stopped or is_so(), max(0.0, until - time.monotonic()))
            return is_so()

    def is_over(self) -> bool:
        return self.is_stopped or time.monotonic() >= self.deadline

    def read_lines(self) -> None:
        def read() -> None:
            for line in sys.stdin:
                with self.changed:
                    self.lines.append(line)
                    self.changed.notify_all()
            with self.changed:
                self.input_ended = True
                self.changed.notify_all()

        threading.Thread(target=read, daemon=True).start()

    def take_line(self) -> bool:
        """Waits for a line on standard input. Returns `False` at its end, at a signal and after the deadline."""
        self.wait(lambda: bool(self.lines) or self.input_ended)
        with self.changed:
            return bool(self.lines and self.lines.pop(0))


def session_options() -> argparse.ArgumentParser:
    """Returns the options of all roles that open a session."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--connect", action="append", help="the router, tcp/127.0.0.1:7447 if none is given")
    parser.add_argument("--mode", choices=["peer", "client"], default="peer", help="peer: on the router's host")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--enclave", default="/")
    parser.add_argument("--node", default="/zenoh_peer", help="full name of the node")
    parser.add_argument("--zid", help="id of the session, in hexadecimal digits")
    parser.add_argument("--lease", type=float, default=60, help="seconds after which a silent connection counts as lost")
    parser.add_argument("--ca", help="certificate of the authority that signed the router's")
    parser.add_argument("--cert", help="certificate of this session, for a router that asks for one")
    parser.add_argument("--key", help="its key")
    parser.add_argument("--any-name", action="store_true", help="accept a certificate for another host name")
    parser.add_argument("--timeout", type=float, default=60.0, help="seconds, from the start")
    return parser


def config_of(args: argparse.Namespace) -> dict:
    config = rmw.session_config(args.connect or ["tcp/127.0.0.1:7447"], args.mode, args.zid, args.lease)
    if args.ca:
        rmw.with_tls(config, args.ca, args.cert, args.key, bool(args.cert), not args.any_name)
    return config


def open_context(args: argparse.Namespace, run: Run) -> rmw.Context:
    """Opens a session and waits for a router, as a node of rmw_zenoh does."""
    try:
        context = rmw.Context(config_of(args), args.domain, args.enclave)
    except zenoh.ZError as error:
        # A client does not wait.
        emit("no_router", error=str(error))
        leave(EXIT_INCOMPLETE)
    context.graph.listeners.append(run.wake)
    if not context.wait_for_router(run.deadline):
        context.close()
        emit("no_router")
        leave(EXIT_INCOMPLETE)
    emit("session", zid=context.zid)
    return context


def leave(code: int) -> None:
    """Ends the process. A thread that reads standard input would keep it alive."""
    sys.stdout.flush()
    os._exit(code)
