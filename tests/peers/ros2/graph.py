"""Prints the graph's endpoints of a topic, or of a service. JSON lines as in ../README.md."""

import argparse
import json
import sys
import time

import rclpy
from rclpy.action import get_action_client_names_and_types_by_node
from rclpy.node import Node


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--topic", required=True)
    parser.add_argument("--publishers", type=int, default=0, help="waits for so many")
    parser.add_argument("--subscribers", type=int, default=0, help="waits for so many")
    parser.add_argument("--exactly", action="store_true", help="waits for just so many")
    parser.add_argument("--service", help="shows its clients")
    parser.add_argument("--action", help="shows its clients")
    parser.add_argument("--client", help="waits until this node, with its namespace, is among them")
    parser.add_argument("--node", help="waits until all publishers are of this node")
    parser.add_argument("--subscriber-nodes", help="waits for one subscriber of each of these nodes (A,B), and no other")
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

    def of_each_node(read):
        for name, namespace in node.get_node_names_and_namespaces():
            try:
                yield f"{namespace.rstrip('/')}/{name}", dict(read(name, namespace))
            except RuntimeError:  # NodeNameNonExistentError: gone meanwhile
                pass

    def clients(read, interface):
        return sorted(name for name, interfaces in of_each_node(read) if interface in interfaces)

    def all_of(read):
        return sorted({interface for _, interfaces in of_each_node(read) for interface in interfaces})

    def action_clients(name, namespace):
        return get_action_client_names_and_types_by_node(node, name, namespace)

    def is_there(found):
        return options.client in found or not options.client

    while True:
        service_clients = clients(node.get_client_names_and_types_by_node, options.service) if options.service else []
        in_action = clients(action_clients, options.action) if options.action else []
        publishers = endpoints(node.get_publishers_info_by_topic)
        subscribers = endpoints(node.get_subscriptions_info_by_topic)
        is_known = all(e["node"] and not e["node"].startswith("_") for e in publishers + subscribers)
        is_known = is_known and all(e["node"] == options.node or not options.node for e in publishers)
        subscriber_nodes = sorted(options.subscriber_nodes.split(",")) if options.subscriber_nodes else None
        is_known = is_known and subscriber_nodes in (None, sorted(e["node"] for e in subscribers))
        have, wanted = (len(publishers), len(subscribers)), (options.publishers, options.subscribers)
        enough = have == wanted if options.exactly else have[0] >= wanted[0] and have[1] >= wanted[1]
        enough = enough and (not options.service or is_there(service_clients)) and (not options.action or is_there(in_action))
        if (enough and is_known) or time.monotonic() > deadline:
            break
        rclpy.spin_once(node, timeout_sec=0.1)
    nodes = sorted(f"{namespace.rstrip('/')}/{name}" for name, namespace in node.get_node_names_and_namespaces())
    said = {"publishers": publishers, "subscribers": subscribers, "nodes": nodes}
    said |= {"service_clients": service_clients, "action_clients": in_action}
    said |= {"published": all_of(node.get_publisher_names_and_types_by_node)}
    said |= {"served": all_of(node.get_service_names_and_types_by_node)}
    print(json.dumps({"event": "summary"} | said), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
