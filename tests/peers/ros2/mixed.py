"""Nodes of rclpy with a topic, a service and an action of their own, and with all that each node has besides: `robot` offers them, `desk`
takes them. Says so on standard output as load.c does; ends at a signal, at the end of its time, or when standard input ends."""

import argparse
import json
import os
import sys
import threading

import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci


def say(event: str, **more: object) -> None:
    print(json.dumps({"event": event, **more}), flush=True)


class Robot(Node):
    def __init__(self) -> None:
        super().__init__("talker", namespace="/robot")
        self.sent = self.create_publisher(String, "/robot/chatter", 10)
        self.create_service(Trigger, "/robot/status", lambda _, answer: answer)
        self.server = ActionServer(self, Fibonacci, "/robot/fibonacci", lambda goal: Fibonacci.Result())
        self.create_timer(0.05, lambda: self.sent.publish(String(data="x")))


class Desk(Node):
    def __init__(self) -> None:
        super().__init__("listener", namespace="/desk")
        self.is_first = True
        self.create_subscription(String, "/robot/chatter", self.received, 10)
        self.status = self.create_client(Trigger, "/robot/status")
        self.fibonacci = ActionClient(self, Fibonacci, "/robot/fibonacci")

    def received(self, _: String) -> None:
        if self.is_first:
            self.is_first = False
            say("received")


def end_with_parent() -> None:
    sys.stdin.read()
    os._exit(0)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["robot", "desk"])
    parser.add_argument("--timeout", type=float, default=60)
    args = parser.parse_args()
    threading.Thread(target=end_with_parent, daemon=True).start()
    end = threading.Timer(args.timeout, lambda: os._exit(3))
    end.daemon = True
    end.start()
    rclpy.init()
    node = Robot() if args.role == "robot" else Desk()
    say("ready")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
