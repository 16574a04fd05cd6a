"""Roles without content: `graph` reports the ROS graph, `churn` makes and destroys endpoints or sessions."""

from __future__ import annotations

import argparse
import contextlib

from interfaces import identity
from rmw import Client, Context, Node, Publisher, Qos, Server, Subscription
from run import EXIT_INCOMPLETE, EXIT_OK, Run, config_of, emit, open_context

TEXT, ADD = identity("std_msgs/msg/String"), identity("example_interfaces/srv/AddTwoInts")


def graph_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--hidden", action="store_true", help="without a node of its own")


def watch(args: argparse.Namespace, run: Run) -> int:
    """Reports nodes and endpoints at each change."""
    told = None
    with open_context(args, run) as context:
        _node = None if args.hidden else Node(context, args.node)
        emit("ready")
        while not run.is_over():
            if run.wait(lambda: context.graph.describe() != told):
                told = context.graph.describe()
                emit("graph", **told)
        emit("summary", role="graph")
    return EXIT_OK if run.by_signal else EXIT_INCOMPLETE


def churn_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--topic", default="/churn", help="name of topics and services; a number follows")
    parser.add_argument("--same", action="store_true", help="one name, without a number")
    parser.add_argument("--count", type=int, default=20, help="endpoints in a round: of the four kinds in turn")
    parser.add_argument("--rounds", type=int, default=1, help="before `done` is reported")
    parser.add_argument("--restart", action="store_true", help="a session of its own for each round")


def churn(args: argparse.Namespace, run: Run) -> int:
    """Makes and destroys endpoints, and again after each line on standard input.

    An observer in a session of its own has to see all of them come and go.
    """
    rounds = made = 0

    def declare(node: Node, number: int):
        name = args.topic if args.same else f"{args.topic}_{number}"
        kinds = [
            lambda: Publisher(node, name, *TEXT),
            lambda: Subscription(node, name, *TEXT, lambda *_: None, Qos(transient_local=number % 8 == 1)),
            lambda: Server(node, name, *ADD, lambda _, reply: reply(b"\0\1\0\0" + bytes(8))),
            lambda: Client(node, name, *ADD),
        ]
        return kinds[number % len(kinds)]()

    def one_round(context: Context, seen) -> bool:
        node = Node(context, args.node)
        endpoints = [declare(node, number) for number in range(args.count)]
        came = run.wait(lambda: seen(context) == args.count)
        for endpoint in endpoints:
            endpoint.destroy()
        node.destroy()
        return came and run.wait(lambda: seen(context) == 0)

    with open_context(args, run) as observer:

        def seen(context: Context) -> int:
            return sum(one["session"] == context.zid for one in observer.graph.describe()["endpoints"])

        config = config_of(args)
        config.pop("id", None)
        emit("ready")
        run.read_lines()
        with contextlib.ExitStack() as stack:
            lasting = None if args.restart else stack.enter_context(Context(config, args.domain, args.enclave))
            good = True
            while good and not run.is_over():
                for _ in range(args.rounds):
                    if lasting:
                        good = one_round(lasting, seen)
                    else:
                        with Context(config, args.domain, args.enclave) as brief:
                            good = brief.wait_for_router(run.deadline) and one_round(brief, seen)
                    if not good:
                        break
                    rounds, made = rounds + 1, made + args.count
                if good:
                    emit("done", rounds=rounds)
                if not run.take_line():
                    break
        emit("summary", role="churn", rounds=rounds, made=made, good=good)
    return EXIT_OK if good else EXIT_INCOMPLETE


ROLES = {"graph": (graph_options, watch), "churn": (churn_options, churn)}
