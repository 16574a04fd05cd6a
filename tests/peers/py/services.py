"""ROS 2-shaped servers and clients of services and actions on Cyclone DDS that do not know SGC.

What is on the wire is rmw_cyclonedds' mapping: two topics for a service, in front of each request and reply the client's id
and the number of the request. Reports in JSON lines as `peer.py` does, whose settings it shares; the command line is in
`../README.md`. Written with the types spelt out, so that nothing of ROS 2 has to be installed.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import threading
import time
import types
from dataclasses import dataclass

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import cdrv0, final
from cyclonedds.idl.types import array, int8, int32, int64, sequence, uint8, uint32, uint64

from peer import LOCALHOST_XML, emit, leave

TAKE_MAX = 64
ADD = "example_interfaces::srv::dds_::AddTwoInts"
FIBONACCI = "example_interfaces::action::dds_::Fibonacci"


def struct(typename: str, **fields: object) -> type:
    """A final type in plain CDR."""
    name = typename.split("::")[-1]
    cls = types.new_class(name, (IdlStruct,), {"typename": typename}, lambda body: body.update(__annotations__=fields))
    return cdrv0(final(dataclass(cls)))


def message(typename: str, **fields: object) -> type:
    """A final type in plain CDR, with the header of rmw_cyclonedds in front."""
    return struct(typename, client=uint64, number=int64, **fields)


Time = struct("builtin_interfaces::msg::dds_::Time_", sec=int32, nanosec=uint32)
Uuid = struct("unique_identifier_msgs::msg::dds_::UUID_", uuid=array[uint8, 16])
GoalInfo = struct("action_msgs::msg::dds_::GoalInfo_", goal_id=Uuid, stamp=Time)
GoalStatus = struct("action_msgs::msg::dds_::GoalStatus_", goal_info=GoalInfo, status=int8)
GoalStatusArray = struct("action_msgs::msg::dds_::GoalStatusArray_", status_list=sequence[GoalStatus])
Feedback = struct(f"{FIBONACCI}_FeedbackMessage_", goal_id=Uuid, sequence=sequence[int32])

AddRequest = message(f"{ADD}_Request_", a=int64, b=int64)
AddReply = message(f"{ADD}_Response_", sum=int64)
GoalRequest = message(f"{FIBONACCI}_SendGoal_Request_", goal_id=Uuid, order=int32)
GoalReply = message(f"{FIBONACCI}_SendGoal_Response_", accepted=bool, stamp=Time)
ResultRequest = message(f"{FIBONACCI}_GetResult_Request_", goal_id=Uuid)
ResultReply = message(f"{FIBONACCI}_GetResult_Response_", status=int8, sequence=sequence[int32])
CancelRequest = message("action_msgs::srv::dds_::CancelGoal_Request_", goal_info=GoalInfo)
CancelReply = message(
    "action_msgs::srv::dds_::CancelGoal_Response_", return_code=int8, goals_canceling=sequence[GoalInfo]
)

SUCCEEDED, CANCELED = 4, 5


def qos(depth: int = 1000, transient_local: bool = False):
    from cyclonedds.core import Policy, Qos
    from cyclonedds.util import duration

    history = Policy.History.KeepLast(depth)
    service = [Policy.DurabilityService(0, history, -1, -1, -1)] if transient_local else []
    return Qos(
        *service,
        history,
        Policy.Reliability.Reliable(duration(seconds=10)),
        Policy.Durability.TransientLocal if transient_local else Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


class Node:
    """A participant, and a thread that passes samples to their handlers."""

    def __init__(self, domain: int) -> None:
        from cyclonedds.core import WaitSet
        from cyclonedds.domain import DomainParticipant

        self.participant = DomainParticipant(domain)
        self.waiting = WaitSet(self.participant)
        self.takers: list = []
        self.ended = threading.Event()

    def reader(self, topic: str, kind: type, take, **settings):
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.internal import InvalidSample
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        reader = DataReader(self.participant, Topic(self.participant, topic, kind), qos=qos(**settings))
        self.waiting.attach(ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead))

        def take_all() -> None:
            for sample in reader.take(TAKE_MAX):
                if not isinstance(sample, InvalidSample):
                    take(sample)

        self.takers.append(take_all)
        return reader

    def writer(self, topic: str, kind: type, **settings):
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        return DataWriter(self.participant, Topic(self.participant, topic, kind), qos=qos(**settings))

    def serve(self, name: str, request: type, reply: type, answer) -> None:
        """`answer` gets a request and a function that sends what the reply holds, now or later."""
        writer = self.writer(f"rr{name}Reply", reply)

        def asked(sample) -> None:
            answer(sample, lambda *fields: writer.write(reply(sample.client, sample.number, *fields)))

        self.reader(f"rq{name}Request", request, asked)

    def run(self, deadline: float) -> None:
        from cyclonedds.util import duration

        while not self.ended.is_set() and time.monotonic() < deadline:
            if self.waiting.wait(duration(milliseconds=200)):
                for take in self.takers:
                    take()


class Client:
    """A client, which counts a server as matched like rmw: by both its reader and its writer."""

    def __init__(self, node: Node, name: str, request: type, reply: type) -> None:
        self.request, self.id, self.number = request, random.getrandbits(64), 0
        self.open: dict[int, object] = {}
        self.others = 0
        self.lock = threading.Lock()
        self.reader = node.reader(f"rr{name}Reply", reply, self.answered)
        self.writer = node.writer(f"rq{name}Request", request)

    def servers(self) -> int:
        return min(len(self.writer.get_matched_subscriptions()), len(self.reader.get_matched_publications()))

    def wait_for_service(self, deadline: float, there: bool = True) -> bool:
        while (self.servers() > 0) != there:
            if time.monotonic() > deadline:
                return False
            time.sleep(0.01)
        return True

    def call(self, then, *fields) -> int:
        with self.lock:
            self.number += 1
            number = self.number
            self.open[number] = then
        self.writer.write(self.request(self.id, number, *fields))
        return number

    def answered(self, sample) -> None:
        if sample.client != self.id:
            self.others += 1
            return
        with self.lock:
            then = self.open.pop(sample.number, None)
        if then is None:
            emit("unexpected", number=sample.number)
        else:
            then(sample)


def fibonacci(order: int) -> list[int]:
    numbers = [0, 1]
    while len(numbers) <= order:
        numbers.append(numbers[-1] + numbers[-2])
    return numbers[: order + 1]


def server(node: Node, args, deadline: float) -> None:
    """Serves AddTwoInts; with --hold, replies after a line on standard input."""
    held: list = []
    lock = threading.Lock()

    def add(request, reply) -> None:
        answer = lambda: reply(request.a + request.b)  # noqa: E731
        if args.hold:
            with lock:
                held.append(answer)
        # A reader of this report may send its line at once.
        emit("request", a=request.a, b=request.b)
        if not args.hold:
            answer()

    def release() -> None:
        for _ in sys.stdin:
            with lock:
                answers, held[:] = held[:], []
            for answer in answers:
                answer()
            emit("released", count=len(answers))

    node.serve(args.name, AddRequest, AddReply, add)
    threading.Thread(target=release, daemon=True).start()
    emit("ready")
    node.run(deadline)


def client(node: Node, args, deadline: float) -> None:
    """Calls --count times, then reports when the service goes and comes back, and calls at each line of standard input."""
    adds = Client(node, args.name, AddRequest, AddReply)
    threading.Thread(target=node.run, args=(deadline,), daemon=True).start()
    begun = threading.Lock()
    called = [0]

    def call() -> None:
        with begun:
            called[0] += 1
            n = called[0]

        def done(reply) -> None:
            emit("answer", n=n, right=reply.sum == args.base + n)

        adds.call(done, args.base, n)
        emit("called", n=n)

    def told() -> None:
        for _ in sys.stdin:
            call()

    emit("ready")
    if adds.wait_for_service(deadline):
        emit("service", there=True)
        for _ in range(args.count):
            call()
        threading.Thread(target=told, daemon=True).start()
    there = True
    while not node.ended.is_set() and time.monotonic() < deadline:
        if (adds.servers() > 0) != there:
            there = not there
            emit("service", there=there)
        time.sleep(0.02)
    emit("summary", called=called[0], open=len(adds.open), others=adds.others)


def action_server(node: Node, args, deadline: float) -> None:
    """Fibonacci: feedback for each number, a status for each change, a result once it is done or cancelled."""
    statuses = node.writer(f"rt{args.name}/_action/status", GoalStatusArray, depth=1, transient_local=True)
    feedback = node.writer(f"rt{args.name}/_action/feedback", Feedback)
    goals: dict[bytes, dict] = {}
    lock = threading.Lock()
    now = Time(0, 0)

    def tell() -> None:
        with lock:
            infos = [GoalStatus(GoalInfo(Uuid(list(k)), now), g["status"]) for k, g in goals.items()]
        statuses.write(GoalStatusArray(infos))

    def work(key: bytes, goal: dict) -> None:
        numbers: list[int] = []
        for n in fibonacci(goal["order"]):
            if goal["cancelled"].wait(args.step):
                break
            numbers.append(n)
            feedback.write(Feedback(Uuid(list(key)), list(numbers)))
        with lock:
            goal["status"] = CANCELED if goal["cancelled"].is_set() else SUCCEEDED
            goal["numbers"], waiting, goal["waiting"] = numbers, goal["waiting"], None
        tell()
        for reply in waiting:
            reply(goal["status"], numbers)

    def send_goal(request, reply) -> None:
        key = bytes(request.goal_id.uuid)
        goal = {"order": request.order, "status": 2, "waiting": [], "cancelled": threading.Event()}
        with lock:
            goals[key] = goal
        emit("goal", order=request.order)
        reply(True, now)
        tell()
        threading.Thread(target=work, args=(key, goal), daemon=True).start()

    def get_result(request, reply) -> None:
        with lock:
            goal = goals.get(bytes(request.goal_id.uuid))
            if goal and goal["waiting"] is not None:
                goal["waiting"].append(reply)
                return
        reply(*((goal["status"], goal["numbers"]) if goal else (0, [])))

    def cancel_goal(request, reply) -> None:
        with lock:
            goal = goals.get(bytes(request.goal_info.goal_id.uuid))
        if goal:
            goal["cancelled"].set()
        emit("cancel")
        reply(0, [request.goal_info] if goal else [])

    node.serve(f"{args.name}/_action/send_goal", GoalRequest, GoalReply, send_goal)
    node.serve(f"{args.name}/_action/get_result", ResultRequest, ResultReply, get_result)
    node.serve(f"{args.name}/_action/cancel_goal", CancelRequest, CancelReply, cancel_goal)
    emit("ready")
    node.run(deadline)


def action_client(node: Node, args, deadline: float) -> None:
    """One goal of --order; with --cancel it is cancelled after two numbers."""
    goal_id = Uuid([random.getrandbits(8) for _ in range(16)])
    key = bytes(goal_id.uuid)
    done, seen, statuses, cancelling = threading.Event(), [], [], []
    ends = {
        part: Client(node, f"{args.name}/_action/{part}", *kinds)
        for part, kinds in {
            "send_goal": (GoalRequest, GoalReply),
            "get_result": (ResultRequest, ResultReply),
            "cancel_goal": (CancelRequest, CancelReply),
        }.items()
    }

    def on_feedback(sample) -> None:
        if bytes(sample.goal_id.uuid) != key:
            return
        seen.append(list(sample.sequence))
        emit("feedback", length=len(sample.sequence))
        if args.cancel and len(sample.sequence) == 2:
            ends["cancel_goal"].call(lambda reply: cancelling.extend(reply.goals_canceling), GoalInfo(goal_id, Time(0, 0)))

    def on_status(sample) -> None:
        found = [s.status for s in sample.status_list if bytes(s.goal_info.goal_id.uuid) == key]
        statuses.extend(found)

    feedback = node.reader(f"rt{args.name}/_action/feedback", Feedback, on_feedback)
    status = node.reader(
        f"rt{args.name}/_action/status", GoalStatusArray, on_status, depth=1, transient_local=True
    )
    threading.Thread(target=node.run, args=(deadline,), daemon=True).start()
    emit("ready")
    for end in ends.values():
        end.wait_for_service(deadline)
    while not (feedback.get_matched_publications() and status.get_matched_publications()):
        if time.monotonic() > deadline:
            break
        time.sleep(0.01)
    emit("service", there=True)

    def result(reply) -> None:
        emit("result", status=reply.status, right=list(reply.sequence) == fibonacci(args.order))
        done.set()

    def accepted(reply) -> None:
        emit("accepted", accepted=reply.accepted)
        ends["get_result"].call(result, goal_id)

    ends["send_goal"].call(accepted, goal_id, args.order)
    while not (done.is_set() and bool(cancelling) == args.cancel and statuses and statuses[-1] in (SUCCEEDED, CANCELED)):
        if node.ended.is_set() or time.monotonic() > deadline:
            break
        time.sleep(0.01)
    grows = all(len(b) == len(a) + 1 for a, b in zip(seen, seen[1:]))
    last = statuses[-1] if statuses else None
    emit("summary", feedback=len(seen), grows=grows, last_status=last, cancelling=len(cancelling))


ROLES = {"server": server, "client": client, "action-server": action_server, "action-client": action_client}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("role", choices=ROLES)
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--name", default="/add_two_ints")
    parser.add_argument("--timeout", type=float, default=60.0, help="seconds, from the start")
    parser.add_argument("--localhost", action="store_true", help="use the loopback interface only")
    parser.add_argument("--count", type=int, default=0, help="client: calls to make at once")
    parser.add_argument("--base", type=int, default=1000, help="client: what is added to")
    parser.add_argument("--hold", action="store_true", help="server: answer at a line on standard input")
    parser.add_argument("--order", type=int, default=5, help="action client: how far to count")
    parser.add_argument("--step", type=float, default=0.05, help="action server: seconds for a number")
    parser.add_argument("--cancel", action="store_true", help="action client: after two numbers")
    args = parser.parse_args()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT})
    if "CYCLONEDDS_URI" not in os.environ and args.localhost:
        os.environ["CYCLONEDDS_URI"] = f'<CycloneDDS><Domain Id="any">{LOCALHOST_XML}</Domain></CycloneDDS>'
    node = Node(args.domain)

    def until_signal() -> None:
        signal.sigwait({signal.SIGTERM, signal.SIGINT})
        node.ended.set()

    threading.Thread(target=until_signal, daemon=True).start()
    ROLES[args.role](node, args, time.monotonic() + args.timeout)
    node.ended.set()
    leave(node.participant)
    # Threads that read standard input would keep the process alive.
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
