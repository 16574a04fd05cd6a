"""Publishes and hears topics with keys, of test_msgs, by value. JSON lines as in ../README.md."""

import argparse
import json
import signal
import sys
import time

import rclpy
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from test_msgs.msg import ComplexNestedKey, KeyedLong, KeyedString

INSTANCES = 5
VALUES = 4
LINGER_S = 1


def keyed_long(key, value):
    return KeyedLong(key=key, value=value)


def keyed_string(key, value):
    return KeyedString(key=f"instance {key} of a key longer than a hash", value=str(value))


def complex_nested_key(key, value):
    message = ComplexNestedKey(uint32_key=key, float64_value=value / 8)
    message.nested_keys.nested_data.key = f"k{key}"
    message.nested_keys.some_int = -key
    return message


TOPICS = {
    "/keyed_long": (KeyedLong, keyed_long),
    "/keyed_string": (KeyedString, keyed_string),
    "/complex_nested_key": (ComplexNestedKey, complex_nested_key),
}


def emit(**event):
    print(json.dumps(event), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["pub", "sub"])
    parser.add_argument("--timeout", type=float, default=60)
    parser.add_argument("--transient-local", action="store_true", help="with a depth of 1")
    options = parser.parse_args()
    deadline = time.monotonic() + options.timeout

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("keyed")
    ended = []
    signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
    qos = QoSProfile(depth=10)
    if options.transient_local:
        qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    expected = {
        topic: [(key, value, make(key, value)) for value in range(VALUES) for key in range(INSTANCES)]
        for topic, (_, make) in TOPICS.items()
    }
    matched = {topic: 0 for topic in TOPICS}

    def note(topic, status):
        matched[topic] = status.current_count
        emit(event="matched", count=min(matched.values()))

    def is_over():
        return ended or time.monotonic() > deadline

    if options.role == "pub":
        publishers = {
            topic: node.create_publisher(
                kind,
                topic,
                qos,
                event_callbacks=PublisherEventCallbacks(matched=lambda status, topic=topic: note(topic, status)),
            )
            for topic, (kind, _) in TOPICS.items()
        }
        emit(event="ready")
        while not is_over() and not options.transient_local and min(matched.values()) == 0:
            rclpy.spin_once(node, timeout_sec=0.1)
        rounds = 0
        # Repeated for a subscriber that was matched and did not know it yet.
        while not is_over():
            if rounds == 0 or not options.transient_local:
                for topic, all_of_it in expected.items():
                    for _, _, message in all_of_it:
                        publishers[topic].publish(message)
                if rounds == 0:
                    emit(event="all_sent")
                rounds += 1
            rclpy.spin_once(node, timeout_sec=0.05)
        emit(event="summary", role="pub", rounds=rounds)
        return 0

    heard = {topic: [] for topic in TOPICS}
    altered = []

    def hear(topic, message):
        which = next((e[:2] for e in expected[topic] if e[2] == message), None)
        (altered if which is None else heard[topic]).append(which)

    for topic, (kind, _) in TOPICS.items():
        node.create_subscription(
            kind,
            topic,
            lambda message, topic=topic: hear(topic, message),
            qos,
            event_callbacks=SubscriptionEventCallbacks(matched=lambda status, topic=topic: note(topic, status)),
        )
    emit(event="ready")
    last = {(key, VALUES - 1) for key in range(INSTANCES)}
    wanted = last if options.transient_local else {(k, v) for k in range(INSTANCES) for v in range(VALUES)}

    def is_complete():
        return all(wanted <= set(all_of_it) for all_of_it in heard.values())

    while not is_over() and not is_complete():
        rclpy.spin_once(node, timeout_sec=0.1)
    until = time.monotonic() + LINGER_S
    while not is_over() and time.monotonic() < until:
        rclpy.spin_once(node, timeout_sec=0.1)
    complete = is_complete()
    older = sum(len(set(all_of_it) - wanted) for all_of_it in heard.values())
    counts = {topic: len(all_of_it) for topic, all_of_it in heard.items()}
    emit(event="summary", role="sub", complete=complete, altered=len(altered), older=older, heard=counts)
    return 0 if complete and not altered else 1


if __name__ == "__main__":
    sys.exit(main())
