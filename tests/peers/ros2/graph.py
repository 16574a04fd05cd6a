"""Shows what the graph says of the endpoints of a topic, or of a service. JSON lines as in ../README.md."""

import argparse
import json
import sys
import time

import rclpy
from rclpy.node import Node


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--topic", required=True)
    parser.add_argument("--publishers", type=int, default=0, help="waits for so many")
    parser.add_argument("--subscribers", type=int, default=0, help="waits for so many")
    parser.add_argument("--node", help="waits until all publishers are of this node")
    parser.add_argument("--timeout", type=float, default=60)
    options = parser.parse_args()
    deadline = time.monotonic() + options.timeout

    rclpy.init()
    node = Node("graph_reader")

    def endpoint(info):
        qos = info.qos_profile
        return {
            "node": info.node_name,
            "namespace": info.node_namespace,
            "type": info.topic_type,
            "hash": str(info.topic_type_hash),
            "gid": bytes(info.endpoint_gid).hex(),
            "reliability": qos.reliability.name,
            "durability": qos.durability.name,
        }

    def endpoints(read):
        return [endpoint(info) for info in read(options.topic)]

    while True:
        publishers = endpoints(node.get_publishers_info_by_topic)
        subscribers = endpoints(node.get_subscriptions_info_by_topic)
        is_known = all(e["node"] and not e["node"].startswith("_") for e in publishers + subscribers)
        is_known = is_known and all(e["node"] == options.node or not options.node for e in publishers)
        enough = len(publishers) >= options.publishers and len(subscribers) >= options.subscribers
        if (enough and is_known) or time.monotonic() > deadline:
            break
        rclpy.spin_once(node, timeout_sec=0.1)
    nodes = sorted(f"{namespace.rstrip('/')}/{name}" for name, namespace in node.get_node_names_and_namespaces())
    print(json.dumps({"event": "summary", "publishers": publishers, "subscribers": subscribers, "nodes": nodes}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
