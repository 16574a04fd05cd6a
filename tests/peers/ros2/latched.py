"""Topics that ROS 2 itself latches: a map (`map`), and log lines (`log`), which any node publishes on /rosout; `hear` takes either. Events are
those of ../README.md; the sequence number of a map is its width."""

import argparse
import json
import signal
import time

import rclpy
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile

MAP_CELLS = 100_000
MAP_PAUSE_S = 0.3
MAP_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Takes all available messages.
HEAR_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LOG_QOS = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def say(event: str, **facts: object) -> None:
    print(json.dumps({"event": event, **facts}), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["map", "log", "hear"])
    parser.add_argument("--topic", default="/map")
    parser.add_argument("--count", type=int, default=3)
    parser.add_argument("--timeout", type=float, default=60)
    options = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node(f"latched_{options.role}")
    stopped = []
    signal.signal(signal.SIGTERM, lambda *_: stopped.append(True))
    seqs: list[int] = []

    def hear(seq: int) -> None:
        seqs.append(seq)
        say("received", seq=seq, ok=True)

    if options.role == "map":
        publisher = node.create_publisher(OccupancyGrid, options.topic, MAP_QOS)
        while publisher.get_subscription_count() == 0 and not stopped:
            time.sleep(0.01)
        for seq in range(options.count):
            time.sleep(MAP_PAUSE_S)
            grid = OccupancyGrid(data=[0] * MAP_CELLS)
            grid.info.width = seq
            publisher.publish(grid)
        say("all_sent", sent=options.count)
    elif options.role == "log":
        for seq in range(options.count):
            node.get_logger().info(f"line {seq}")
        say("all_sent", sent=options.count)
    elif options.topic == "/rosout":
        take = lambda line: hear(int(line.msg.split()[1])) if line.name == "latched_log" else None  # noqa: E731
        node.create_subscription(Log, options.topic, take, LOG_QOS)
    else:
        node.create_subscription(OccupancyGrid, options.topic, lambda grid: hear(grid.info.width), HEAR_QOS)

    until = time.monotonic() + options.timeout
    while not stopped and time.monotonic() < until:
        rclpy.spin_once(node, timeout_sec=0.05)
    say("summary", role=options.role, received=len(set(seqs)), duplicated=len(seqs) - len(set(seqs)))


if __name__ == "__main__":
    main()
