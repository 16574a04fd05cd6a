"""Says what comes on a topic: python listen.py grpc://127.0.0.1:50051 /odom"""

from __future__ import annotations

import sys

import sgc


def main(address: str, topic: str) -> None:
    with sgc.connect(address) as robot:
        for message in robot.subscribe(topic, rate=5):
            print(message, sgc.info(message))


if __name__ == "__main__":
    main(*sys.argv[1:3])
