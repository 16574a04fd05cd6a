"""Roles with an action, Fibonacci, and with parameters, on Python's client library: `action-serve`, `action-call`, `params`,
`params-call`. Options and reports are those of `../zenoh/actions.py` and `../zenoh/parameters.py`.
"""

import argparse
import json
import signal
import sys
import threading
import time

import rclpy
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import DescribeParameters, GetParameters, GetParameterTypes, ListParameters, SetParameters
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from test_msgs.action import Fibonacci

EXIT_INCOMPLETE = 3
INITIAL = {"answer": 42, "ratio": 0.5, "robot.name": "arm"}
POLL_S = 0.01
CANCEL_AT = 2


def say(event: str, **facts: object) -> None:
    print(json.dumps({"event": event, **facts}), flush=True)


def fibonacci(order: int) -> list[int]:
    numbers = [0, 1]
    while len(numbers) <= order:
        numbers.append(numbers[-1] + numbers[-2])
    return numbers[: order + 1]


class Program:
    """A node whose callbacks run on threads, until a signal or the end of its time."""

    def __init__(self, args: argparse.Namespace) -> None:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self.ended = threading.Event()
        signal.signal(signal.SIGTERM, lambda *_: self.ended.set())
        self.deadline = time.monotonic() + args.timeout
        name, namespace = args.node.rsplit("/", 1)[::-1]
        self.node = Node(name, namespace=namespace or "/")
        self.group = ReentrantCallbackGroup()
        self.executor = MultiThreadedExecutor(num_threads=4)

    def spin(self) -> None:
        """Begins to call back. An executor ends when it meets an action client that is half made."""
        self.executor.add_node(self.node)
        threading.Thread(target=self.executor.spin, daemon=True).start()

    def until(self, is_so=lambda: False) -> bool:
        while not is_so() and not self.ended.is_set() and time.monotonic() < self.deadline:
            self.ended.wait(POLL_S)
        return is_so()

    def end(self) -> None:
        self.executor.shutdown(timeout_sec=1)
        self.node.destroy_node()
        rclpy.shutdown()


def action_serve(args: argparse.Namespace, program: Program) -> int:
    goals = 0

    def execute(goal) -> Fibonacci.Result:
        nonlocal goals
        goals += 1
        say("goal", order=goal.request.order)
        numbers: list[int] = []
        for number in fibonacci(goal.request.order):
            time.sleep(args.step)
            if goal.is_cancel_requested:
                goal.canceled()
                return Fibonacci.Result(sequence=numbers)
            numbers.append(number)
            goal.publish_feedback(Fibonacci.Feedback(sequence=numbers))
        goal.succeed()
        return Fibonacci.Result(sequence=numbers)

    def cancel(_) -> CancelResponse:
        say("cancel")
        return CancelResponse.ACCEPT

    server = ActionServer(
        program.node, Fibonacci, args.name, execute, cancel_callback=cancel, callback_group=program.group
    )  # fmt: skip
    program.spin()
    say("ready")
    program.until()
    say("summary", role="action-serve", goals=goals)
    server.destroy()
    return 0


def action_call(args: argparse.Namespace, program: Program) -> int:
    lengths: list[int] = []
    cancelling: list = []
    client = ActionClient(program.node, Fibonacci, args.name, callback_group=program.group)
    program.spin()
    say("ready")
    handle = None

    def on_cancelling(future) -> None:
        cancelling.extend(future.result().goals_canceling)

    def on_feedback(message) -> None:
        lengths.append(len(message.feedback.sequence))
        say("feedback", length=lengths[-1])
        if args.cancel and lengths[-1] == CANCEL_AT:
            program.until(lambda: handle is not None)
            handle.cancel_goal_async().add_done_callback(on_cancelling)

    status = right = None
    if program.until(client.server_is_ready):
        say("service", there=True)
        sent = client.send_goal_async(Fibonacci.Goal(order=args.order), on_feedback)
        if program.until(sent.done) and sent.result().accepted:
            handle = sent.result()
            say("accepted", accepted=True)
            result = handle.get_result_async()
            if program.until(lambda: result.done() and bool(cancelling) == args.cancel):
                status, numbers = result.result().status, list(result.result().result.sequence)
                expected = fibonacci(args.order)
                is_prefix = numbers == expected[: len(numbers)]
                right = is_prefix and (args.cancel or len(numbers) == len(expected))
                say("result", status=status, right=right)
    grows = all(after == before + 1 for before, after in zip(lengths, lengths[1:]))
    say(
        "summary", role="action-call", feedback=len(lengths), grows=grows, last_status=status,
        cancelling=len(cancelling), right=bool(right),
    )  # fmt: skip
    return 0 if right else EXIT_INCOMPLETE


def params(_: argparse.Namespace, program: Program) -> int:
    node = program.node

    def on_set(parameters) -> SetParametersResult:
        for one in parameters:
            say("set", name=one.name, value=one.value)
        return SetParametersResult(successful=True)

    for name, value in INITIAL.items():
        node.declare_parameter(name, value)
    node.add_on_set_parameters_callback(on_set)
    program.spin()
    say("ready")
    program.until()
    values = {name: node.get_parameter(name).value for name in INITIAL}
    say("summary", role="params", values=values)
    return 0


def from_value(value: ParameterValue) -> object:
    fields = {
        ParameterType.PARAMETER_BOOL: "bool_value",
        ParameterType.PARAMETER_INTEGER: "integer_value",
        ParameterType.PARAMETER_DOUBLE: "double_value",
        ParameterType.PARAMETER_STRING: "string_value",
    }
    return getattr(value, fields[value.type]) if value.type in fields else None


def params_call(args: argparse.Namespace, program: Program) -> int:
    """Sets an integer, and lists, describes and reads the parameters of a node."""
    types = {
        "describe_parameters": DescribeParameters,
        "get_parameter_types": GetParameterTypes,
        "get_parameters": GetParameters,
        "list_parameters": ListParameters,
        "set_parameters": SetParameters,
    }
    clients = {
        name: program.node.create_client(kind, f"{args.of}/{name}", callback_group=program.group)
        for name, kind in types.items()
    }
    program.spin()
    say("ready")

    def ask(name: str, request):
        future = clients[name].call_async(request)
        return future.result() if program.until(future.done) else None

    found: dict = {}
    good = program.until(lambda: all(client.service_is_ready() for client in clients.values()))
    if good and args.set:
        name, value = args.set.split("=", 1)
        value = ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=int(value))
        reply = ask("set_parameters", SetParameters.Request(parameters=[Parameter(name=name, value=value)]))
        good = bool(reply and reply.results[0].successful)
    listed = ask("list_parameters", ListParameters.Request()) if good else None
    if listed:
        names = list(listed.result.names)
        got = ask("get_parameters", GetParameters.Request(names=names))
        kinds = ask("get_parameter_types", GetParameterTypes.Request(names=names))
        described = ask("describe_parameters", DescribeParameters.Request(names=names))
        good = bool(got and kinds and described)
        if good:
            found = dict(zip(names, map(from_value, got.values)))
            of_values = [value.type for value in got.values]
            good = list(kinds.types) == of_values == [one.type for one in described.descriptors]
    say("summary", role="params-call", good=good and bool(listed), values=found)
    return 0 if good and listed else EXIT_INCOMPLETE


def main() -> int:
    roles = {"action-serve": action_serve, "action-call": action_call, "params": params, "params-call": params_call}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("role", choices=roles)
    parser.add_argument("--node", default="/actions")
    parser.add_argument("--timeout", type=float, default=60)
    parser.add_argument("--name", default="/fibonacci")
    parser.add_argument("--step", type=float, default=0.05, help="seconds for a number")
    parser.add_argument("--order", type=int, default=5)
    parser.add_argument("--cancel", action="store_true", help="after two numbers")
    parser.add_argument("--of", help="full name of the node with parameters")
    parser.add_argument("--set", metavar="NAME=INTEGER", help="sets one, before they are read")
    args = parser.parse_args()
    program = Program(args)
    code = roles[args.role](args, program)
    program.end()
    return code


if __name__ == "__main__":
    sys.exit(main())
