"""Publishes on many topics below `--publish`, and subscribes to as many below `--hear` (../README.md)."""

import argparse
import json
import os
import sys
import threading

import rclpy
from rclpy.node import Node
from std_msgs.msg import String


def report(event: str, **facts: object) -> None:
    print(json.dumps({"event": event, **facts}), flush=True)


class Many(Node):
    """Reports when it has heard from all topics, again after each line on standard input."""

    def __init__(self, args: argparse.Namespace) -> None:
        super().__init__("many")
        self.count = args.count
        self.silent = set(range(args.count))
        self.talkers = [self.create_publisher(String, f"{args.publish}/t{n}", 10) for n in range(args.count)]
        for n in range(args.count):
            self.create_subscription(String, f"{args.hear}/t{n}", lambda _, n=n: self.hears(n), 10)
        self.create_timer(1 / args.rate, self.talk)

    def talk(self) -> None:
        for talker in self.talkers:
            talker.publish(String(data="x"))

    def hears(self, number: int) -> None:
        if number in self.silent:
            self.silent.remove(number)
            if not self.silent:
                report("heard_all")


def read_lines(node: Many) -> None:
    for _ in sys.stdin:
        node.silent = set(range(node.count))
    os._exit(0)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--publish", required=True)
    parser.add_argument("--hear", required=True)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--rate", type=float, default=2)
    args = parser.parse_args()
    rclpy.init()
    node = Many(args)
    threading.Thread(target=read_lines, args=(node,), daemon=True).start()
    rclpy.spin(node)


if __name__ == "__main__":
    main()
