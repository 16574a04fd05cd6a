"""The client against a gateway that the test of crates/sgc-gateway has started: python against_gateway.py PORT TOKEN IMAGES

There is a talker on /chatter, which says "hello N" without end; a camera on /camera, latched; /secret, which TOKEN does not
permit; and on /cmd_vel, /echoed and /large the test hears.
"""

from __future__ import annotations

import array
import logging
import math
import os
import subprocess
import sys
import tempfile
import threading
import zlib

import grpc

import sgc
from sgc import _cbor

EXAMPLES = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "examples")
LARGE = 13 << 20


def cbor() -> None:
    """What is written is read again, by the bytes that others write."""
    value = {
        "text": "ä",
        "numbers": [0, 23, 24, -1, -25, 2**63, 2**64 - 1, -(2**63)],
        "bytes": b"\0\1",
        "flags": [True, False],
        "inside": {"x": 1.5},
        "typed": array.array("d", [1.0, -2.5]),
        "small": array.array("b", [-1, 2]),
    }
    again = _cbor.loads(_cbor.dumps(value))
    assert again == value, again
    assert again.inside.x == 1.5 and isinstance(again.typed, array.array)
    # Half, single and double floats; what is not a number.
    assert _cbor.loads(bytes.fromhex("83f93c00fa47c35000fb3ff199999999999a")) == [1.0, 100000.0, 1.1]
    assert math.isnan(_cbor.loads(bytes.fromhex("f97e00"))) and _cbor.loads(bytes.fromhex("f97c00")) == math.inf
    for wrong in ("", "83", "5f", "1b00", "6261", "0000", "a1"):
        try:
            _cbor.loads(bytes.fromhex(wrong))
        except _cbor.CborError:
            continue
        raise AssertionError(wrong)
    members = sgc.Message(values=[1], items=2)
    assert members.values == [1] and members.items == 2
    members.x = 3
    assert members["x"] == 3


def refused(code: str, words: str, work: object) -> None:
    try:
        work()  # type: ignore[operator]
    except sgc.GatewayError as error:
        assert error.code == code and words in str(error), (error.code, str(error))
    else:
        raise AssertionError(f"not refused: {words}")


def topics(robot: sgc.Client, address: str, token: str) -> None:
    with robot.subscribe("/chatter", depth=5) as heard:
        assert (heard.type, heard.type_hash[:7]) == ("std_msgs/msg/String", "RIHS01_")
        message = next(heard)
        assert message.data.startswith("hello ") and message["data"] == message.data
        said = sgc.info(message)
        assert said is not None and said.source_time_ns > 0 and said.received_time_ns > 0
    assert next(iter(heard), None) is None
    with robot.subscribe_raw("/chatter") as raw:
        payload, _ = next(raw)
        assert payload[:4] == b"\0\1\0\0" and b"hello " in payload

    refused("PERMISSION_DENIED", "may not subscribe to /secret", lambda: robot.subscribe("/secret"))
    refused("NOT_FOUND", "the type of /py/none is not known", lambda: robot.subscribe("/py/none"))
    refused("INVALID_ARGUMENT", "is of type", lambda: robot.subscribe("/chatter", "std_msgs/Bool"))

    with robot.publisher("/echoed", "std_msgs/msg/String") as echoed:
        with robot.subscribe("/echoed", "std_msgs/String") as back:
            echoed.publish(data="one")
            assert next(back).data == "one"
            echoed.publish({"data": "two"})
            assert next(back).data == "two"
        assert echoed.close() == 2
    wrong = robot.publisher("/echoed", "std_msgs/msg/String")
    wrong.publish(date="no such member")
    refused("INVALID_ARGUMENT", "message 1 of this stream", wrong.close)

    def forgetful() -> None:
        with sgc.connect(address, token=token) as other:
            other.publisher("/secret", "std_msgs/msg/String").publish(data="never closed")

    refused("PERMISSION_DENIED", "may not publish /secret", forgetful)

    with robot.publisher("/large", "sensor_msgs/msg/Image") as large:
        with robot.subscribe("/large", "sensor_msgs/msg/Image") as back:
            data = bytes(range(256)) * (LARGE // 256)
            large.publish(data=data, encoding="mono8", width=4096, height=LARGE // 4096, step=4096)
            image = next(back)
            assert image.data == data and image.header.frame_id == ""


def services(robot: sgc.Client, address: str, token: str) -> None:
    @robot.service("/py/add", "example_interfaces/srv/AddTwoInts")
    def add(request: sgc.Message) -> dict:
        if request.a < 0:
            raise ValueError("not below zero")
        return {"sum": request.a + request.b}

    with sgc.connect(address, token=token) as other:
        assert other.call("/py/add", {"a": 2, "b": 40}).sum == 42
        sums = []
        threads = [
            threading.Thread(target=lambda n=n: sums.append(other.call("/py/add", {"a": n, "b": 1}).sum))
            for n in range(16)
        ]
        [thread.start() for thread in threads]
        [thread.join() for thread in threads]
        assert sorted(sums) == list(range(1, 17)), sums
        refused("DEADLINE_EXCEEDED", "", lambda: other.call("/py/add", {"a": -1}, timeout=0.5))
        refused("INVALID_ARGUMENT", "not a message of that type", lambda: other.call("/py/add", {"c": 1}))
        refused("UNAVAILABLE", "nobody serves", lambda: other.call("/py/none", type="std_srvs/Empty"))


def actions(robot: sgc.Client, address: str, token: str) -> None:
    @robot.action("/py/fibonacci", "example_interfaces/action/Fibonacci")
    def fibonacci(goal: sgc.ActionGoal) -> dict:
        sequence = [0, 1]
        for _ in range(goal.request.order - 1):
            sequence.append(sequence[-1] + sequence[-2])
            goal.feedback({"sequence": sequence})
            if goal.request.order > 50 and goal.wait(20):
                break
        return {"sequence": sequence}

    with sgc.connect(address, token=token) as other:
        goal = other.send_goal("/py/fibonacci", {"order": 5})
        told = [list(feedback.sequence) for feedback in goal]
        assert told[-1] == [0, 1, 1, 2, 3, 5], told
        assert goal.outcome().status == "succeeded" and list(goal.outcome().result.sequence) == told[-1]
        goal = other.send_goal("/py/fibonacci", {"order": 80})
        next(iter(goal))
        goal.cancel()
        assert goal.outcome().status == "canceled"


def graph(robot: sgc.Client) -> None:
    seen = robot.graph()
    assert seen.topics["/chatter"].type == "std_msgs/msg/String" and "/secret" not in seen.topics
    assert seen.topics["/camera"].publishers[0].qos.latched
    assert "/py/add" in seen.services and "/py/fibonacci" in seen.actions
    changes = robot.watch_graph()
    assert "/chatter" in next(changes).topics
    with robot.publisher("/py/new", "std_msgs/msg/String"):
        while "/py/new" not in next(changes).topics:
            pass
    while "/py/new" in next(changes).topics:
        pass
    twist = robot.type("geometry_msgs/msg/Twist")
    assert twist.hash.startswith("RIHS01_") and "float64 x" in twist.texts["geometry_msgs/msg/Vector3"]


def example(name: str, *args: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-B", os.path.join(EXAMPLES, name), *args]
    return subprocess.run(command, stdout=subprocess.PIPE, timeout=60, check=True, text=True)


def examples(robot: sgc.Client, address: str) -> None:
    with tempfile.TemporaryDirectory() as directory:
        file = os.path.join(directory, "shot.png")
        example("camera.py", address, "/camera", file)
        with open(file, "rb") as png:
            head = png.read()
        assert head[:8] == b"\x89PNG\r\n\x1a\n" and int.from_bytes(head[16:20], "big") == 4, head[:32]
        begin = head.index(b"IDAT") + 4
        rows = zlib.decompress(head[begin : head.index(b"IEND")])
        # bgr8: the first pixel is blue.
        assert rows[:7] == b"\0\0\0\xff\0\xff\0", rows[:7]
    assert "commands" in example("drive.py", address, "/cmd_vel", "0.2", "0.35").stdout
    command = [sys.executable, "-B", os.path.join(EXAMPLES, "serve.py"), address, "/py/example_add"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None and "is served" in server.stdout.readline()
        assert robot.call("/py/example_add", {"a": 1, "b": 2}).sum == 3
        server.terminate()


def main(port: str, token: str) -> None:
    logging.basicConfig(level=logging.CRITICAL)
    cbor()
    address = f"grpc://127.0.0.1:{port}"
    with sgc.connect(address, token=token) as robot:
        topics(robot, address, token)
        services(robot, address, token)
        actions(robot, address, token)
        graph(robot)
        refused("UNAUTHENTICATED", "not admitted", sgc.connect(address, token="nonsense").graph)
        examples(sgc.connect(address), address)
    refused("UNAVAILABLE", "no gateway at", lambda: sgc.connect("127.0.0.1:1", timeout=0.5))
    print(f"grpcio {grpc.__version__}: all is well", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:3])
