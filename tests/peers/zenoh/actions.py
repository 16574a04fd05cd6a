"""Roles with an action, Fibonacci: `action-serve`, `action-call`. An action is three services and two topics."""

from __future__ import annotations

import argparse
import random
import threading

from interfaces import FIBONACCI_OF, Message, Service
from rmw import Client, Node, Publisher, Qos, Server, Subscription
from run import EXIT_INCOMPLETE, EXIT_OK, Run, emit, open_context

EXECUTING, SUCCEEDED, CANCELED = 2, 4, 5
NO_TIME = {"sec": 0, "nanosec": 0}
STATUS = Message("action_msgs/msg/GoalStatusArray")
STATUS_QOS = Qos(depth=1, transient_local=True)
CANCEL = Service("action_msgs/srv/CancelGoal")


def parts_of(package: str) -> tuple[Service, Service, Message]:
    base = f"{package}/action/Fibonacci_"
    return Service(f"{base}SendGoal"), Service(f"{base}GetResult"), Message(f"{base}FeedbackMessage")


def fibonacci(order: int) -> list[int]:
    numbers = [0, 1]
    while len(numbers) <= order:
        numbers.append(numbers[-1] + numbers[-2])
    return numbers[: order + 1]


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--name", default="/fibonacci")
    parser.add_argument("--package", choices=FIBONACCI_OF, default=FIBONACCI_OF[0], help="that defines the action")


def serve_options(parser: argparse.ArgumentParser) -> None:
    options(parser)
    parser.add_argument("--step", type=float, default=0.05, help="seconds for a number")


def call_options(parser: argparse.ArgumentParser) -> None:
    options(parser)
    parser.add_argument("--order", type=int, default=5, help="how far to count")
    parser.add_argument("--cancel", action="store_true", help="after two numbers")


def serve(args: argparse.Namespace, run: Run) -> int:
    """Sends feedback for each number, a status for each change, and a result once the goal is done or cancelled."""
    send_goal, get_result, feedback = parts_of(args.package)
    goals: dict[bytes, dict] = {}
    lock = threading.Lock()

    def tell() -> None:
        with lock:
            infos = [
                {"goal_info": {"goal_id": {"uuid": key}, "stamp": NO_TIME}, "status": goal["status"]}
                for key, goal in goals.items()
            ]
            statuses.publish(STATUS.encode({"status_list": infos}))

    def work(key: bytes, goal: dict) -> None:
        numbers: list[int] = []
        for number in fibonacci(goal["order"]):
            if goal["cancelled"].wait(args.step):
                break
            numbers.append(number)
            feedbacks.publish(feedback.encode({"goal_id": {"uuid": key}, "sequence": numbers}))
        with lock:
            goal["status"] = CANCELED if goal["cancelled"].is_set() else SUCCEEDED
            goal["numbers"], waiting, goal["waiting"] = numbers, goal["waiting"], None
        tell()
        for reply in waiting:
            reply(get_result.encode_reply({"status": goal["status"], "sequence": numbers}))

    def on_goal(payload: bytes, reply) -> None:
        request = send_goal.decode_request(payload)
        key, order = request["goal_id"]["uuid"], request["order"]
        goal = {"order": order, "status": EXECUTING, "waiting": [], "cancelled": threading.Event()}
        with lock:
            goals[key] = goal
        emit("goal", order=order)
        reply(send_goal.encode_reply({"accepted": True, "stamp": NO_TIME}))
        tell()
        threading.Thread(target=work, args=(key, goal), daemon=True).start()

    def on_result(payload: bytes, reply) -> None:
        with lock:
            goal = goals.get(get_result.decode_request(payload)["goal_id"]["uuid"])
            if goal and goal["waiting"] is not None:
                goal["waiting"].append(reply)
                return
        answer = {"status": goal["status"], "sequence": goal["numbers"]} if goal else {"status": 0, "sequence": []}
        reply(get_result.encode_reply(answer))

    def on_cancel(payload: bytes, reply) -> None:
        info = CANCEL.decode_request(payload)["goal_info"]
        with lock:
            goal = goals.get(info["goal_id"]["uuid"])
        if goal:
            goal["cancelled"].set()
        emit("cancel")
        reply(CANCEL.encode_reply({"return_code": 0, "goals_canceling": [info] if goal else []}))

    with open_context(args, run) as context:
        node, hidden = Node(context, args.node), f"{args.name}/_action"
        statuses = Publisher(node, f"{hidden}/status", *STATUS.identity, STATUS_QOS)
        feedbacks = Publisher(node, f"{hidden}/feedback", *feedback.identity)
        _servers = [
            Server(node, f"{hidden}/send_goal", *send_goal.identity, on_goal),
            Server(node, f"{hidden}/get_result", *get_result.identity, on_result),
            Server(node, f"{hidden}/cancel_goal", *CANCEL.identity, on_cancel),
        ]
        emit("ready")
        run.wait()
        emit("summary", role="action-serve", goals=len(goals))
    return EXIT_OK


def call(args: argparse.Namespace, run: Run) -> int:
    """Sends one goal, and cancels it if told to."""
    send_goal, get_result, feedback = parts_of(args.package)
    key = random.randbytes(16)
    goal_id = {"uuid": key}
    lengths: list[int] = []
    statuses: list[int] = []
    cancelling: list[dict] = []
    results: list[bool] = []

    with open_context(args, run) as context:
        node, hidden = Node(context, args.node), f"{args.name}/_action"
        goals = Client(node, f"{hidden}/send_goal", *send_goal.identity)
        asks = Client(node, f"{hidden}/get_result", *get_result.identity)
        cancels = Client(node, f"{hidden}/cancel_goal", *CANCEL.identity)

        def on_feedback(payload: bytes, _) -> None:
            message = feedback.decode(payload)
            if message["goal_id"] != goal_id:
                return
            lengths.append(len(message["sequence"]))
            emit("feedback", length=lengths[-1])
            if args.cancel and lengths[-1] == 2:
                request = {"goal_info": {"goal_id": goal_id, "stamp": NO_TIME}}
                cancels.call(CANCEL.encode_request(request), on_cancelling)

        def on_cancelling(payload: bytes) -> None:
            cancelling.extend(CANCEL.decode_reply(payload)["goals_canceling"])
            run.wake()

        def on_status(payload: bytes, _) -> None:
            for one in STATUS.decode(payload)["status_list"]:
                if one["goal_info"]["goal_id"] == goal_id:
                    statuses.append(one["status"])
            run.wake()

        def on_result(payload: bytes) -> None:
            reply = get_result.decode_reply(payload)
            expected = fibonacci(args.order)
            is_prefix = reply["sequence"] == expected[: len(reply["sequence"])]
            right = is_prefix and (args.cancel or len(reply["sequence"]) == len(expected))
            emit("result", status=reply["status"], right=right)
            results.append(right)
            run.wake()

        def on_accepted(payload: bytes) -> None:
            emit("accepted", accepted=send_goal.decode_reply(payload)["accepted"])
            asks.call(get_result.encode_request({"goal_id": goal_id}), on_result)

        feedbacks = Subscription(node, f"{hidden}/feedback", *feedback.identity, on_feedback)
        states = Subscription(node, f"{hidden}/status", *STATUS.identity, on_status, STATUS_QOS)
        emit("ready")
        ends = [goals.servers, asks.servers, cancels.servers, feedbacks.matched, states.matched]
        if run.wait(lambda: all(count() for count in ends)):
            emit("service", there=True)
            goals.call(send_goal.encode_request({"goal_id": goal_id, "order": args.order}), on_accepted)

        def is_done() -> bool:
            ended = bool(statuses) and statuses[-1] in (SUCCEEDED, CANCELED)
            return bool(results) and ended and bool(cancelling) == args.cancel

        done = run.wait(is_done)
        grows = all(after == before + 1 for before, after in zip(lengths, lengths[1:]))
        last = statuses[-1] if statuses else None
        emit(
            "summary", role="action-call", feedback=len(lengths), grows=grows, last_status=last,
            cancelling=len(cancelling), right=results == [True],
        )  # fmt: skip
    return EXIT_OK if done and results == [True] else EXIT_INCOMPLETE


ROLES = {"action-serve": (serve_options, serve), "action-call": (call_options, call)}
