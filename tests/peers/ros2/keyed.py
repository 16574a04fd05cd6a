"""Publishes and hears topics with keys, of test_msgs, by value. JSON lines as in ../README.md."""

import argparse
import json
import signal
import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from test_msgs.msg import ComplexNestedKey, KeyedLong, KeyedString

INSTANCES = 5
# Of each instance: fewer than the history of a subscriber with the default depth.
OF_EACH = 4


def emit(**event):
    print(json.dumps(event), flush=True)


def messages():
    """All messages of each topic, in their order."""
    longs, strings, nested = [], [], []
    for value in range(OF_EACH):
        for key in range(INSTANCES):
            longs.append(KeyedLong(key=key, value=value))
            strings.append(KeyedString(key=f"instance {key} of a key longer than a hash", value=str(value)))
            message = ComplexNestedKey(uint32_key=key)
            message.nested_keys.nested_data.key = f"k{key}"
            message.nested_keys.some_int = -key
            message.float64_value = value / 8
            nested.append(message)
    return {"/keyed_long": longs, "/keyed_string": strings, "/complex_nested_key": nested}


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["pub", "sub"])
    parser.add_argument("--timeout", type=float, default=60)
    options = parser.parse_args()
    deadline = time.monotonic() + options.timeout

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("keyed")
    ended = []
    signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
    expected = messages()
    qos = QoSProfile(depth=10)
    heard = {topic: [] for topic in expected}
    publishers = {}
    for topic, sent in expected.items():
        if options.role == "pub":
            publishers[topic] = node.create_publisher(type(sent[0]), topic, qos)
        else:
            node.create_subscription(type(sent[0]), topic, heard[topic].append, qos)
    emit(event="ready")
    if options.role == "pub":
        while not ended and time.monotonic() < deadline:
            if all(publisher.get_subscription_count() for publisher in publishers.values()):
                break
            rclpy.spin_once(node, timeout_sec=0.01)
        # Once again for who was matched and did not know it yet.
        while not ended and time.monotonic() < deadline:
            for topic, sent in expected.items():
                for message in sent:
                    publishers[topic].publish(message)
                    rclpy.spin_once(node, timeout_sec=0.005)
        emit(event="summary", role="pub")
        return 0

    def is_complete():
        return all(all(message in heard[topic] for message in sent) for topic, sent in expected.items())

    while not ended and time.monotonic() < deadline and not is_complete():
        rclpy.spin_once(node, timeout_sec=0.1)
    altered = sum(message not in expected[topic] for topic in heard for message in heard[topic])
    counts = {topic: len(all_of_it) for topic, all_of_it in heard.items()}
    emit(event="summary", role="sub", complete=is_complete(), altered=altered, heard=counts)
    return 0 if is_complete() and not altered else 1


if __name__ == "__main__":
    sys.exit(main())
