"""Publishes /chatter, or waits for one message of it: chatter.py talk SECONDS | hear SECONDS."""

import sys
import time

import rclpy
from std_msgs.msg import String

role, seconds = sys.argv[1], float(sys.argv[2])
heard = []
rclpy.init()
node = rclpy.create_node(role)
if role == "talk":
    publisher = node.create_publisher(String, "/chatter", 10)
    node.create_timer(0.1, lambda: publisher.publish(String(data="hello from the robot")))
else:
    subscription = node.create_subscription(String, "/chatter", lambda message: heard.append(message.data), 10)
end = time.monotonic() + seconds
while time.monotonic() < end and not heard:
    rclpy.spin_once(node, timeout_sec=0.1)
if role == "hear":
    print(*heard)
    sys.exit(not heard)
