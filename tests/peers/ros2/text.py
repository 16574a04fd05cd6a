"""Publishes texts on one topic, hears another, and serves and calls services as options say.

The command line and the JSON lines are those of ../README.md.
"""

import argparse
import json
import sys
import time

import rclpy
from std_msgs.msg import String
from test_msgs.srv import BasicTypes

PERIOD_S = 0.05


def say(event: str, **more) -> None:
    print(json.dumps({"event": event, **more}), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--publish", default="/text_out")
    parser.add_argument("--topic", default="/text_in")
    parser.add_argument("--serve", help="a service that answers after --delay seconds")
    parser.add_argument("--call", help="a service that is called again as soon as it answers, or does not for --patience seconds")
    parser.add_argument("--delay", type=float, default=0)
    parser.add_argument("--patience", type=float, default=5)
    parser.add_argument("--timeout", type=float, default=60)
    options = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node("text")
    deadline = time.monotonic() + options.timeout
    publisher = node.create_publisher(String, options.publish, 10)
    node.create_subscription(String, options.topic, lambda message: say("received", text=message.data), 10)
    number = 0

    def tick() -> None:
        nonlocal number
        publisher.publish(String(data=f"text {number}"))
        number += 1

    def answer(request, response):
        say("asked", number=request.int64_value)
        time.sleep(options.delay)
        response.int64_value = request.int64_value + 1
        return response

    node.create_timer(PERIOD_S, tick)
    if options.serve:
        node.create_service(BasicTypes, options.serve, answer)
    client = node.create_client(BasicTypes, options.call) if options.call else None
    future, asked, since = None, 0, 0.0
    say("ready")
    while time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.1)
        if client is None:
            continue
        if future is not None and future.done():
            say("answered", number=asked, took=time.monotonic() - since, right=future.result().int64_value == asked + 1)
            future = None
        elif future is not None and time.monotonic() - since > options.patience:
            say("unanswered", number=asked)
            client.remove_pending_request(future)
            future = None
        if future is None and client.service_is_ready():
            asked, since = asked + 1, time.monotonic()
            say("calls", number=asked)
            future = client.call_async(BasicTypes.Request(int64_value=asked))
    return 0


if __name__ == "__main__":
    sys.exit(main())
