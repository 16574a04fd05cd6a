"""Role `values`: each message type that ../ros2/values.py has, by value. Bytes and values come from its role `dump`."""

from __future__ import annotations

import argparse
import json
import time

from cdr import CdrError, Codec
from interfaces import dds_name
from rmw import Node, Publisher, Subscription
from run import EXIT_INCOMPLETE, EXIT_OK, EXIT_WRONG, Run, emit, open_context

# As in ../ros2/values.py.
VARIANTS = 3
PAUSE_S = 0.5
LINGER_S = 0.5


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("direction", choices=["pub", "sub"])
    parser.add_argument("--file", required=True, help="output of `ros2/values.py dump`")
    parser.add_argument("--namespace", default="/types", help="of the topics")


def fields(of: object, path: str = "") -> dict[str, object]:
    """Returns each field with its path."""
    if isinstance(of, dict):
        return {name: part for key, value in of.items() for name, part in fields(value, f"{path}.{key}").items()}
    if isinstance(of, (list, bytes)):
        parts = [fields(item, f"{path}[{i}]") for i, item in enumerate(of)]
        return {f"{path}.length": len(of)} | {name: part for each in parts for name, part in each.items()}
    return {path: of}


def difference(one: dict, other: dict) -> str | None:
    return next((path for path in one | other if one.get(path) != other.get(path)), None)


def values(args: argparse.Namespace, run: Run) -> int:
    with open(args.file, encoding="utf-8") as file:
        dumped = json.load(file)
    messages = dumped["messages"]
    codec = Codec(dumped["definitions"])

    def identity(name: str) -> tuple[str, str]:
        return dds_name(name.replace("/", "/msg/")), messages[name]["hash"]

    for name, one in messages.items():
        for variant in one["variants"]:
            data = bytes.fromhex(variant["cdr"])
            # rclpy's `serialize_message` returns as many bytes as it estimated, and so leaves some behind the message.
            message, length = codec.decode_first(name, data)
            variant["cdr"] = data[:length]
            # A mistake of the codec here would look like one of the network.
            for read in (message, codec.decode(name, codec.encode(name, message))):
                path = difference(variant["values"], fields(read))
                assert path is None, f"{name}{path}: {fields(read).get(path)!r} is not {variant['values'].get(path)!r}"

    with open_context(args, run) as context:
        node = Node(context, args.node)
        if args.direction == "pub":
            return publish(args, run, node, {name: identity(name) for name in messages}, messages)
        return subscribe(args, run, node, {name: identity(name) for name in messages}, messages, codec)


def report_matched(run: Run, endpoints: dict) -> bool:
    matched = run.wait(lambda: all(endpoint.matched() for endpoint in endpoints.values()))
    if matched:
        emit("matched", count=1)
    return matched


def publish(args: argparse.Namespace, run: Run, node: Node, identities: dict, messages: dict) -> int:
    publishers = {name: Publisher(node, f"{args.namespace}/{name}", *key) for name, key in identities.items()}
    emit("ready", types=len(publishers))
    run.read_lines()
    report_matched(run, publishers)
    run.take_line()
    for variant in range(VARIANTS):
        for name, publisher in publishers.items():
            publisher.publish(messages[name]["variants"][variant]["cdr"])
        if variant == 0:
            run.wait(until=time.monotonic() + PAUSE_S)
    emit("all_sent")
    run.wait()
    emit("summary", role="pub", types=len(publishers))
    return EXIT_OK


def subscribe(args: argparse.Namespace, run: Run, node: Node, identities: dict, messages: dict, codec: Codec) -> int:
    heard: dict[str, list[int]] = {name: [] for name in messages}
    altered: list[str] = []

    def take(name: str, payload: bytes) -> None:
        expected = [variant["values"] for variant in messages[name]["variants"]]
        try:
            found = fields(codec.decode(name, payload))
        except (CdrError, UnicodeDecodeError) as error:
            altered.append(f"{name}: {error}: {payload.hex()}")
            return
        if found in expected:
            # All messages of a type with a single test value are alike.
            heard[name].append(max(i for i, one in enumerate(expected) if one == found))
        else:
            nearest = min(expected, key=lambda one: len(one.items() ^ found.items()))
            path = difference(nearest, found)
            altered.append(f"{name}{path}: {found.get(path)!r} instead of {nearest.get(path)!r}")
        run.wake()

    def missing() -> list[str]:
        """Returns the types of which the last message, or any but the first, is missing."""
        return [name for name, which in heard.items() if len(which) < VARIANTS - 1 or which[-1] != VARIANTS - 1]

    subscriptions = {
        name: Subscription(node, f"{args.namespace}/{name}", *key, lambda payload, _, name=name: take(name, payload))
        for name, key in identities.items()
    }
    emit("ready", types=len(subscriptions))
    report_matched(run, subscriptions)
    if run.wait(lambda: not missing()):
        run.wait(until=time.monotonic() + LINGER_S)

    def is_wrong(which: list[int], name: str) -> bool:
        """Reports repeated or reordered messages."""
        first, *_, last = (variant["values"] for variant in messages[name]["variants"])
        return len(which) > VARIANTS if first == last else which not in ([0, 1, 2], [1, 2])

    wrong = {name: which for name, which in heard.items() if is_wrong(which, name)}
    emit("summary", role="sub", types=len(messages), missing=missing(), altered=altered, wrong=wrong)
    return EXIT_INCOMPLETE if missing() else EXIT_WRONG if altered or wrong else EXIT_OK


ROLES = {"values": (options, values)}
