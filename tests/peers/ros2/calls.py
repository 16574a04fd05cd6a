"""Calls or serves services, actions and parameters with Python's client library, and tests first messages of topics.

The command line and the JSON lines are those of ../README.md. Every call has a client of its own, which calls in the moment in which
it sees the server, and every message a publisher of its own.
"""

import argparse
import json
import signal
import sys
import threading
import time

import rclpy
from action_msgs.msg import GoalStatus
from rcl_interfaces.srv import GetParameters
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import UInt64
from test_msgs.action import Fibonacci
from test_msgs.srv import BasicTypes

POLL_S = 0.001
# Python may take messages more slowly than they come. Newer ones then replace waiting ones, natively as well.
DEPTH = 1000
PARAMETER = "answer"


def wait_go() -> None:
    sys.stdin.readline()


def say(event: str, **more) -> None:
    print(json.dumps({"event": event, **more}), flush=True)


def serve(options) -> int:
    rclpy.init(signal_handler_options=rclpy.SignalHandlerOptions.NO)
    node = rclpy.create_node(options.node)
    node.declare_parameter(PARAMETER, 42)
    group = ReentrantCallbackGroup()
    served = 0

    def answer(request, response):
        nonlocal served
        time.sleep(options.delay)
        served += 1
        response.int64_value = request.int64_value + 1
        response.string_value = request.string_value
        return response

    def execute(goal):
        time.sleep(options.delay)
        goal.succeed()
        return Fibonacci.Result(sequence=[goal.request.order])

    for name in options.service:
        node.create_service(BasicTypes, name, answer, qos_profile=QoSProfile(depth=DEPTH), callback_group=group)
    actions = [ActionServer(node, Fibonacci, name, execute, callback_group=group) for name in options.action]
    executor = MultiThreadedExecutor(num_threads=options.threads)
    executor.add_node(node)
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    threading.Thread(target=executor.spin, daemon=True).start()
    say("ready")
    ended.wait(options.timeout)
    say("summary", role="serve", served=served)
    executor.shutdown(timeout_sec=1)
    [action.destroy() for action in actions]
    node.destroy_node()
    rclpy.shutdown()
    return 0


class Calls:
    """Calls in progress, each of a client of its own."""

    def __init__(self, options):
        self.options = options
        self.context = None
        self.deadline = time.monotonic() + options.timeout
        self.asked, self.answered, self.wrong, self.slowest = 0, 0, 0, 0.0
        self.open = []

    def renew(self) -> None:
        """Creates a participant, unless a free one can be used again."""
        if self.context is None or self.options.participants:
            self.context = rclpy.Context()
            rclpy.init(context=self.context)
            self.executor = SingleThreadedExecutor(context=self.context)
            self.node = rclpy.create_node(self.options.node, context=self.context, start_parameter_services=False)
            self.executor.add_node(self.node)

    def end(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def until(self, is_so) -> bool:
        # On this thread: an executor on another one ends when it meets an action client that is half made.
        while not is_so() and time.monotonic() < self.deadline:
            self.executor.spin_once(timeout_sec=POLL_S)
        return is_so()

    def finish(self) -> None:
        """Waits until what was asked is answered and counted."""
        self.until(lambda: self.answered == self.asked)

    def ask(self, client, request, is_right) -> None:
        self.asked += 1
        if self.until(client.service_is_ready):
            self.follow(client.call_async(request), client, is_right)

    def follow(self, future, client, is_right) -> None:
        begun = time.monotonic()

        def done(future):
            self.answered += 1
            self.wrong += not is_right(future.result())
            self.slowest = max(self.slowest, time.monotonic() - begun)

        future.add_done_callback(done)
        self.open.append((future, client))
        if not self.options.overlap:
            self.finish()

    def call(self, name: str, number: int) -> None:
        client = self.node.create_client(BasicTypes, name, qos_profile=QoSProfile(depth=DEPTH))
        request = BasicTypes.Request(int64_value=number)
        self.ask(client, request, lambda response: response.int64_value == number + 1)

    def get_parameter(self, node: str, _: int) -> None:
        client = self.node.create_client(GetParameters, f"{node}/get_parameters")
        request = GetParameters.Request(names=[PARAMETER])
        self.ask(client, request, lambda response: [v.integer_value for v in response.values] == [42])

    def send_goal(self, name: str, number: int) -> None:
        client = ActionClient(self.node, Fibonacci, name)
        self.asked += 1
        if not self.until(client.server_is_ready):
            return
        goal = client.send_goal_async(Fibonacci.Goal(order=number))
        if not self.until(goal.done) or not goal.result().accepted:
            return

        def is_right(response):
            return response.status == GoalStatus.STATUS_SUCCEEDED and list(response.result.sequence) == [number]

        self.follow(goal.result().get_result_async(), client, is_right)


def call(options) -> int:
    calls = Calls(options)
    say("ready")
    kinds = [(calls.call, options.service), (calls.get_parameter, options.parameters), (calls.send_goal, options.action)]
    for number in range(options.count):
        for kind, names in kinds:
            for name in names:
                calls.renew()
                kind(name, number)
                if options.participants:
                    calls.end()
    if not options.participants:
        calls.finish()
        calls.end()
    say("summary", role="call", asked=calls.asked, answered=calls.answered, wrong=calls.wrong, slowest=calls.slowest)
    return 0 if calls.answered == calls.asked and not calls.wrong else 3


def leave(options) -> int:
    """Makes clients of a service without a server and drops them, one after the other."""
    rclpy.init()
    node = rclpy.create_node(options.node, start_parameter_services=False)
    say("ready")
    for _ in range(options.count):
        client = node.create_client(BasicTypes, options.service[0])
        time.sleep(options.delay)
        assert not client.service_is_ready(), "nobody serves it"
        node.destroy_client(client)
    node.destroy_node()
    rclpy.shutdown()
    say("summary", role="leave")
    return 0


def publish(options) -> int:
    """Publishes a number with each of several publishers as soon as it is matched."""
    rclpy.init()
    node = rclpy.create_node(options.node, start_parameter_services=False)
    say("ready")
    deadline = time.monotonic() + options.timeout
    publishers = []
    for number in range(options.count):
        publisher = node.create_publisher(UInt64, options.topic, 10)
        publishers.append(publisher)
        while publisher.get_subscription_count() < 1 and time.monotonic() < deadline:
            time.sleep(POLL_S)
        publisher.publish(UInt64(data=options.first + number))
    say("all_sent", sent=options.count)
    wait_go()
    node.destroy_node()
    rclpy.shutdown()
    say("summary", role="publish", sent=options.count)
    return 0


def listen(options) -> int:
    """Reports received numbers until all have come."""
    rclpy.init()
    node = rclpy.create_node(options.node, start_parameter_services=False)
    came = []

    def note(message):
        came.append(message.data)
        say("received", seq=message.data)

    subscription = node.create_subscription(UInt64, options.topic, note, QoSProfile(depth=DEPTH))
    say("ready")
    deadline = time.monotonic() + options.timeout
    while len(set(came)) < options.count and time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.1)
    lost = sorted(set(range(options.count)) - set(came))
    node.destroy_subscription(subscription)
    node.destroy_node()
    rclpy.shutdown()
    say("summary", role="listen", received=len(set(came)), lost=lost, duplicated=len(came) - len(set(came)))
    return 0


def main() -> int:
    roles = {"serve": serve, "call": call, "leave": leave, "publish": publish, "listen": listen}
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=roles)
    parser.add_argument("--node", default="calls")
    parser.add_argument("--service", action="append", default=[])
    parser.add_argument("--action", action="append", default=[])
    parser.add_argument("--parameters", action="append", default=[], help="the node whose parameters are read")
    parser.add_argument("--topic", default="/first")
    parser.add_argument("--count", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="the first number that is published")
    parser.add_argument("--delay", type=float, default=0, help="seconds that a server takes, or a client waits")
    parser.add_argument("--threads", type=int, default=8)
    parser.add_argument("--timeout", type=float, default=60)
    parser.add_argument("--participants", action="store_true", help="a participant for each call")
    parser.add_argument("--overlap", action="store_true", help="call again before the answer is there")
    options = parser.parse_args()
    return roles[options.role](options)


if __name__ == "__main__":
    sys.exit(main())
