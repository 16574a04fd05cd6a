"""Drives a robot, or is one: publishes commands while told to hold, or says which command it got last.

As an operator it reads `hold SPEED` and `release` from standard input, and publishes each 20 ms while it holds. As a robot it
says each speed that differs from the one before. The JSON lines are those of ../README.md.
"""

import argparse
import json
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import Twist

PERIOD_S = 0.02


def say(event: str, **more) -> None:
    print(json.dumps({"event": event, **more}), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["operator", "robot"])
    parser.add_argument("--topic", default="/cmd_vel")
    parser.add_argument("--timeout", type=float, default=60)
    options = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node(options.role)
    deadline = time.monotonic() + options.timeout
    if options.role == "operator":
        operate(node, options.topic)
    else:
        listen(node, options.topic)
    say("ready")
    while time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.1)
    return 0


def operate(node, topic: str) -> None:
    publisher = node.create_publisher(Twist, topic, 10)
    held = None

    def read() -> None:
        nonlocal held
        for line in sys.stdin:
            word, *speed = line.split()
            held = float(speed[0]) if word == "hold" else None

    def tick() -> None:
        if (speed := held) is not None:
            message = Twist()
            message.linear.x = speed
            publisher.publish(message)

    threading.Thread(target=read, daemon=True).start()
    node.create_timer(PERIOD_S, tick)


def listen(node, topic: str) -> None:
    last = None

    def hear(message: Twist) -> None:
        nonlocal last
        if message.linear.x != last:
            last = message.linear.x
            say("speed", speed=last, at=time.time())

    node.create_subscription(Twist, topic, hear, 10)


if __name__ == "__main__":
    sys.exit(main())
