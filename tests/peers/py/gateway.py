"""A program without ROS at a gateway of SGC, by gRPC (`clients/python`) or by the rosbridge protocol (PyPI `roslibpy`).

Reports in JSON lines as `peer.py` does. It hears a topic of texts, publishes on another, and calls `/add_two_ints`; with
`--serve` it serves one that adds as well; with `--hear` it hears alone, says when that fails, and begins anew.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import threading
import time
from pathlib import Path

from peer import emit

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "clients/python/src"))

CALL = {"a": 2, "b": 40}


def grpc(args: argparse.Namespace) -> None:
    import sgc

    options = {name: value for name in ("token", "ca", "server_name") if (value := getattr(args, name))}
    while True:
        try:
            with sgc.connect(args.address, **options) as gateway:
                hear_by_grpc(gateway, args)
                if not args.hear:
                    return
        except sgc.GatewayError as error:
            emit("failed", code=error.code, reason=str(error))
            if not args.hear:
                return
            time.sleep(0.2)


def hear_by_grpc(gateway: object, args: argparse.Namespace) -> None:
    emit("topics", topics=sorted(gateway.graph().topics))
    if args.serve:
        gateway.serve(args.serve, lambda call: {"sum": call.a + call.b}, "example_interfaces/srv/AddTwoInts")
        emit("served", service=args.serve)
    if args.publish:
        publisher = gateway.publisher(args.publish, "std_msgs/msg/String")
        publish(lambda text: publisher.publish(data=text))
        emit("sum", sum=until_served(lambda: gateway.call("/add_two_ints", CALL, timeout=30)["sum"]))
    for message in gateway.subscribe(args.topic, "std_msgs/msg/String", depth=100):
        emit("heard", text=message["data"])


def rosbridge(args: argparse.Namespace) -> None:
    import roslibpy

    ros = roslibpy.Ros(args.address)
    ros.run(timeout=30)
    emit("topics", topics=sorted(ros.get_topics()))
    if args.publish:
        topic = roslibpy.Topic(ros, args.publish, "std_msgs/msg/String")
        topic.advertise()
        publish(lambda text: topic.publish(roslibpy.Message({"data": text})))
        service = roslibpy.Service(ros, "/add_two_ints", "example_interfaces/srv/AddTwoInts")
        emit("sum", sum=until_served(lambda: service.call(roslibpy.ServiceRequest(CALL), timeout=30)["sum"]))
    heard = roslibpy.Topic(ros, args.topic, "std_msgs/msg/String", queue_length=100)
    heard.subscribe(lambda message: emit("heard", text=message["data"]))
    threading.Event().wait()


def until_served(call: object) -> int:
    """Repeats a call until a server answers, because a far server takes a moment to be known."""
    while True:
        try:
            return call()
        except Exception as error:  # each client has its own
            emit("not_served", reason=str(error))
            time.sleep(0.2)


def publish(say: object) -> None:
    """Publishes a text ten times a second until the program ends."""

    def run() -> None:
        for number in itertools.count():
            say(f"without ROS {number}")
            time.sleep(0.1)

    threading.Thread(target=run, daemon=True).start()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("protocol", choices=("grpc", "rosbridge"))
    parser.add_argument("address")
    parser.add_argument("--topic", default="/chatter")
    parser.add_argument("--publish", help="a topic to publish on")
    parser.add_argument("--serve", help="by gRPC, a service that adds two numbers")
    parser.add_argument("--hear", action="store_true", help="hear, come what may")
    parser.add_argument("--token")
    parser.add_argument("--ca")
    parser.add_argument("--server-name")
    parser.add_argument("--timeout", type=float, default=120.0, help="seconds, from the start")
    args = parser.parse_args()
    # The program must not outlive its test, whatever it waits for.
    end = threading.Timer(args.timeout, os._exit, (0,))
    end.daemon = True
    end.start()
    {"grpc": grpc, "rosbridge": rosbridge}[args.protocol](args)


if __name__ == "__main__":
    main()
