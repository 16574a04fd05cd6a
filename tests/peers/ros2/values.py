"""Publishes and hears each message type of the packages that both distributions have, by value (../README.md)."""

import argparse
import array
import importlib
import json
import pathlib
import random
import re
import signal
import sys
import time

import numpy
import rclpy
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions

PACKAGES = [
    "action_msgs",
    "builtin_interfaces",
    "geometry_msgs",
    "lifecycle_msgs",
    "nav_msgs",
    "rcl_interfaces",
    "rosgraph_msgs",
    "sensor_msgs",
    "service_msgs",
    "std_msgs",
    "test_msgs",
    "type_description_interfaces",
    "unique_identifier_msgs",
]
# Types with keys, which Jazzy does not have, are tested by keyed.py.
KEYED = re.compile("Key")
# Number of messages of each type. The first may be lost during discovery.
VARIANTS = 3
# Pause between the first messages and the others.
PAUSE_S = 0.5
LINGER_S = 0.5
INTEGER = re.compile(r"(u?)int(8|16|32|64)$")


def types() -> dict[str, type]:
    found = {}
    for package in PACKAGES:
        module = importlib.import_module(f"{package}.msg")
        for name in dir(module):
            kind = getattr(module, name)
            if hasattr(kind, "get_fields_and_field_types") and not KEYED.search(name):
                found[f"{package}/{name}"] = kind
    return found


def value(spelling: str, dice: random.Random) -> object:
    """Returns a value that differs from the default of its type."""
    if of := re.fullmatch(r"sequence<(.*?)(?:, (\d+))?>", spelling):
        return [value(of[1], dice) for _ in range(min(int(of[2] or 3), 3))]
    if of := re.fullmatch(r"(.*)\[(\d+)\]", spelling):
        return [value(of[1], dice) for _ in range(int(of[2]))]
    if of := INTEGER.match(spelling):
        bits = int(of[2])
        return dice.randrange(1, 2**bits) if of[1] else -dice.randrange(1, 2 ** (bits - 1) + 1)
    if spelling == "boolean":
        return True
    if spelling == "octet":
        return bytes([dice.randrange(1, 256)])
    if spelling == "float":
        return dice.randrange(1, 2**20) / -8
    if spelling == "double":
        return dice.uniform(-1e300, -1)
    if of := re.fullmatch(r"w?string(?:<(\d+)>)?", spelling):
        return f"{dice.randrange(10**9):09} äß€"[: int(of[1] or 99)]
    package, name = spelling.split("/")
    return filled(getattr(importlib.import_module(f"{package}.msg"), name), dice)


def filled(kind: type, dice: random.Random) -> object:
    message = kind()
    for field, spelling in kind.get_fields_and_field_types().items():
        setattr(message, field, value(spelling, dice))
    return message


def fields(of: object, path: str = "") -> dict[str, object]:
    """Returns each field with its path, without differences of representation in Python."""
    if hasattr(of, "get_fields_and_field_types"):
        parts = [fields(getattr(of, name), f"{path}.{name}") for name in of.get_fields_and_field_types()]
        return {name: part for each in parts for name, part in each.items()}
    if isinstance(of, (list, tuple, array.array, numpy.ndarray)):
        parts = [fields(item, f"{path}[{i}]") for i, item in enumerate(of)]
        return {f"{path}.length": len(of)} | {name: part for each in parts for name, part in each.items()}
    return {path: of.item() if isinstance(of, numpy.generic) else of}


def variants(name: str, kind: type) -> list[object]:
    return [filled(kind, random.Random(f"{name} {variant}")) for variant in range(VARIANTS)]


def dump(kinds: dict[str, type]) -> dict:
    """Returns definitions, type hashes and messages with their bytes, for a program without ROS 2 (../zenoh/values.py)."""
    definitions, messages = {}, {}

    def define(name: str, kind: type) -> None:
        if name not in definitions:
            definitions[name] = kind.get_fields_and_field_types()
            for spelling in definitions[name].values():
                if nested := re.search(r"\w+/\w+", spelling):
                    package, base = nested[0].split("/")
                    define(nested[0], getattr(importlib.import_module(f"{package}.msg"), base))

    def plain(of: object) -> object:
        return of[0] if isinstance(of, bytes) else of

    for name, kind in kinds.items():
        define(name, kind)
        package, base = name.split("/")
        described = json.loads((pathlib.Path(sys.prefix) / "share" / package / "msg" / f"{base}.json").read_text())
        hashes = {one["type_name"]: one["hash_string"] for one in described["type_hashes"]}
        messages[name] = {
            "hash": hashes[f"{package}/msg/{base}"],
            "variants": [
                {"cdr": serialize_message(one).hex(), "values": {path: plain(of) for path, of in fields(one).items()}}
                for one in variants(name, kind)
            ],
        }
    return {"definitions": definitions, "messages": messages}


def emit(**event: object) -> None:
    print(json.dumps(event), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["pub", "sub", "dump"], help="dump: write to standard output what pub would send")
    parser.add_argument("--namespace", default="/types", help="of the topics")
    parser.add_argument("--timeout", type=float, default=60)
    options = parser.parse_args()
    if options.role == "dump":
        print(json.dumps(dump(types())))
        return 0
    deadline = time.monotonic() + options.timeout
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("values")
    ended = []
    signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
    kinds = types()
    unmatched = set(kinds)

    def note(name: str, status: object) -> None:
        if status.current_count > 0 and name in unmatched:
            unmatched.remove(name)
            if not unmatched:
                emit(event="matched", count=1)

    def is_over() -> bool:
        return bool(ended) or time.monotonic() > deadline

    if options.role == "pub":
        publishers = {}
        for name, kind in kinds.items():
            callbacks = PublisherEventCallbacks(matched=lambda status, name=name: note(name, status))
            topic = f"{options.namespace}/{name}"
            publishers[name] = node.create_publisher(kind, topic, 10, event_callbacks=callbacks)
        emit(event="ready", types=len(kinds))
        while unmatched and not is_over():
            rclpy.spin_once(node, timeout_sec=0.1)
        sys.stdin.readline()
        for variant in range(VARIANTS):
            for name, publisher in publishers.items():
                publisher.publish(variants(name, kinds[name])[variant])
            if variant == 0:
                time.sleep(PAUSE_S)
        emit(event="all_sent")
        while not is_over():
            rclpy.spin_once(node, timeout_sec=0.1)
        return 0

    expected = {name: [fields(message) for message in variants(name, kind)] for name, kind in kinds.items()}
    heard = {name: [] for name in kinds}
    altered = []

    def hear(name: str, message: object) -> None:
        found = fields(message)
        if found in expected[name]:
            # All messages of a type with a single test value are alike.
            heard[name].append(max(i for i, one in enumerate(expected[name]) if one == found))
            return
        nearest = min(expected[name], key=lambda one: len(one.items() ^ found.items()))
        path = next(path for path in {**nearest, **found} if nearest.get(path) != found.get(path))
        altered.append(f"{name}{path}: {found.get(path)!r} instead of {nearest.get(path)!r}")

    for name, kind in kinds.items():
        node.create_subscription(
            kind,
            f"{options.namespace}/{name}",
            lambda message, name=name: hear(name, message),
            10,
            event_callbacks=SubscriptionEventCallbacks(matched=lambda status, name=name: note(name, status)),
        )
    emit(event="ready", types=len(kinds))

    def missing() -> list[str]:
        """Returns the types of which the last message, or any but the first, is missing."""
        return [name for name, which in heard.items() if len(which) < VARIANTS - 1 or which[-1] != VARIANTS - 1]

    while not is_over() and missing():
        rclpy.spin_once(node, timeout_sec=0.1)
    until = time.monotonic() + LINGER_S
    while not is_over() and time.monotonic() < until:
        rclpy.spin_once(node, timeout_sec=0.1)

    def is_wrong(which: list[int], name: str) -> bool:
        """Reports repeated or reordered messages."""
        first, *_, last = expected[name]
        return len(which) > VARIANTS if first == last else which not in ([0, 1, 2], [1, 2])

    wrong = {name: which for name, which in heard.items() if is_wrong(which, name)}
    emit(event="summary", role="sub", types=len(kinds), missing=missing(), altered=altered, wrong=wrong)
    return 0 if not (missing() or altered or wrong) else 1


if __name__ == "__main__":
    sys.exit(main())
