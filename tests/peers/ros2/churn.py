"""Makes many subscriptions one after the other, or many participants at once (../README.md)."""

import argparse
import json
import sys
import threading

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String


def report(event: str, **facts: object) -> None:
    print(json.dumps({"event": event, **facts}), flush=True)


def subscriptions(args: argparse.Namespace) -> None:
    """Makes and destroys subscriptions, and repeats that at each line on standard input."""
    rclpy.init()
    node = rclpy.create_node("churn")
    while True:
        for _ in range(args.count):
            node.destroy_subscription(node.create_subscription(String, args.topic, lambda _: None, 10))
        report("done")
        if not sys.stdin.readline():
            return


def participants(args: argparse.Namespace) -> None:
    """Makes participants at one time, each with a node that subscribes; says of each that it hears, and stays until standard input ends."""
    together = threading.Barrier(args.count)

    def join(number: int) -> None:
        context = Context()
        together.wait()
        rclpy.init(context=context)
        node = rclpy.create_node(f"crowd_{number}", context=context)
        hears = threading.Event()
        node.create_subscription(String, args.topic, lambda _: hears.set(), 10)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        while not hears.is_set():
            executor.spin_once(timeout_sec=0.1)
        report("hears", number=number)
        executor.spin()

    for number in range(args.count):
        threading.Thread(target=join, args=(number,), daemon=True).start()
    sys.stdin.read()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["subscriptions", "participants"])
    parser.add_argument("--topic", default="/churn")
    parser.add_argument("--count", type=int, default=13)
    args = parser.parse_args()
    subscriptions(args) if args.role == "subscriptions" else participants(args)


if __name__ == "__main__":
    main()
