"""Drives a robot for some seconds, then stops it: python drive.py grpc://127.0.0.1:50051 /cmd_vel 0.2 3"""

from __future__ import annotations

import sys
import time

import sgc

PERIOD = 0.1


def main(address: str, topic: str, speed: str, seconds: str) -> None:
    with sgc.connect(address) as robot, robot.publisher(topic, "geometry_msgs/msg/Twist") as wheels:
        end = time.monotonic() + float(seconds)
        while time.monotonic() < end:
            wheels.publish(linear={"x": float(speed)})
            time.sleep(PERIOD)
        # All that is left out is zero.
        wheels.publish()
        print(f"{wheels.close()} commands")


if __name__ == "__main__":
    main(*sys.argv[1:5])
