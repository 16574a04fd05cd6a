"""A publisher or a subscriber of std_msgs/String that reports its QoS events (../README.md)."""

import argparse
import json
import sys
import threading

import rclpy
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

KINDS = {"automatic": LivelinessPolicy.AUTOMATIC, "manual": LivelinessPolicy.MANUAL_BY_TOPIC}


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["pub", "sub"])
    parser.add_argument("--topic", default="/events")
    parser.add_argument("--node", default="events")
    parser.add_argument("--kind", choices=KINDS, default="automatic")
    parser.add_argument("--lease", type=float)
    parser.add_argument("--deadline", type=float)
    parser.add_argument("--lifespan", type=float)
    parser.add_argument("--depth", type=int, default=10)
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--transient-local", action="store_true")
    parser.add_argument("--rate", type=float, default=10)
    parser.add_argument("--count", type=int, default=0)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--asserts", action="store_true")
    return parser.parse_args()


def qos(args: argparse.Namespace) -> QoSProfile:
    times = {"liveliness_lease_duration": args.lease, "deadline": args.deadline, "lifespan": args.lifespan}
    return QoSProfile(
        depth=args.depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if args.best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if args.transient_local else DurabilityPolicy.VOLATILE,
        liveliness=KINDS[args.kind],
        **{name: Duration(seconds=time) for name, time in times.items() if time is not None},
    )


def report(event: str, **facts: object) -> None:
    print(json.dumps({"event": event, **facts}), flush=True)


def matched(status: object) -> None:
    report("matched", count=status.current_count)


def incompatible(status: object) -> None:
    report("incompatible", total=status.total_count, policy=int(status.last_policy_kind))


def publish(node: Node, args: argparse.Namespace) -> None:
    """Each line on standard input pauses, or goes on with, publishing; a number is that of further messages."""
    callbacks = PublisherEventCallbacks(
        deadline=lambda status: report("deadline_missed", total=status.total_count),
        liveliness=lambda status: report("liveliness_lost", total=status.total_count),
        incompatible_qos=incompatible,
        matched=matched,
    )
    publisher = node.create_publisher(String, args.topic, qos(args), event_callbacks=callbacks)
    runs = threading.Event()
    runs.set()
    sent = 0

    def tick() -> None:
        nonlocal sent
        if runs.is_set() and args.asserts:
            publisher.assert_liveliness()
        elif runs.is_set() and (args.count == 0 or sent < args.count):
            publisher.publish(String(data=str(args.start + sent)))
            sent += 1

    def listen() -> None:
        for line in sys.stdin:
            if line.strip().isdigit():
                args.count += int(line)
            else:
                runs.clear() if runs.is_set() else runs.set()

    node.create_timer(1 / args.rate, tick)
    threading.Thread(target=listen, daemon=True).start()


def subscribe(node: Node, args: argparse.Namespace) -> None:
    callbacks = SubscriptionEventCallbacks(
        deadline=lambda status: report("deadline_missed", total=status.total_count),
        liveliness=lambda status: report(
            "liveliness", alive=status.alive_count, not_alive=status.not_alive_count
        ),
        incompatible_qos=incompatible,
        matched=matched,
    )
    node.create_subscription(
        String,
        args.topic,
        lambda message: report("received", seq=int(message.data)),
        qos(args),
        event_callbacks=callbacks,
    )


def main() -> None:
    args = options()
    rclpy.init()
    node = rclpy.create_node(args.node)
    publish(node, args) if args.role == "pub" else subscribe(node, args)
    report("ready")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    report("summary")


if __name__ == "__main__":
    main()
