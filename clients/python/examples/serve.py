"""Serves a service that adds two numbers: python serve.py grpc://127.0.0.1:50051 /add_two_ints"""

from __future__ import annotations

import sys
from typing import Dict

import sgc


def add(request: sgc.Message) -> Dict[str, int]:
    return {"sum": request.a + request.b}


def main(address: str, service: str) -> None:
    with sgc.connect(address) as robot:
        serving = robot.serve(service, add, "example_interfaces/srv/AddTwoInts")
        print(f"{service} is served", flush=True)
        serving.wait()


if __name__ == "__main__":
    main(*sys.argv[1:3])
