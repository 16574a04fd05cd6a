"""Roles with parameters: `params` is a node that has some, `params-call` asks for those of another node."""

from __future__ import annotations

import argparse
import time

from interfaces import MESSAGES, Message, Service
from rmw import PARAMETERS, Client, Node, Publisher, Server
from run import EXIT_INCOMPLETE, EXIT_OK, Run, emit, open_context

NOT_SET, BOOL, INTEGER, DOUBLE, STRING = range(5)
FIELDS = {BOOL: "bool_value", INTEGER: "integer_value", DOUBLE: "double_value", STRING: "string_value"}
TYPES = {bool: BOOL, int: INTEGER, float: DOUBLE, str: STRING}
EVENT = Message("rcl_interfaces/msg/ParameterEvent")
SERVICES = {
    name: Service(f"rcl_interfaces/srv/{kind}")
    for name, kind in {
        "describe_parameters": "DescribeParameters",
        "get_parameter_types": "GetParameterTypes",
        "get_parameters": "GetParameters",
        "list_parameters": "ListParameters",
        "set_parameters": "SetParameters",
        "set_parameters_atomically": "SetParametersAtomically",
    }.items()
}
INITIAL = {"answer": 42, "ratio": 0.5, "robot.name": "arm", "use_sim_time": False}


def to_value(value: object) -> dict:
    """Returns a `ParameterValue`."""
    fields = MESSAGES["rcl_interfaces/ParameterValue"]
    empty = {name: "" if kind == "string" else () if "sequence" in kind else 0 for name, kind in fields.items()}
    kind = TYPES.get(type(value), NOT_SET)
    return empty | {"type": kind} | ({FIELDS[kind]: value} if kind else {})


def from_value(value: dict) -> object:
    return value[FIELDS[value["type"]]] if value["type"] in FIELDS else None


def parsed(text: str) -> object:
    """Returns a value from the command line, as `ros2 param set` reads it."""
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def serve_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="another parameter")


def serve(args: argparse.Namespace, run: Run) -> int:
    """Serves the six services, and publishes an event for each change."""
    values = dict(INITIAL) | {name: parsed(value) for name, value in (pair.split("=", 1) for pair in args.set)}

    def set_one(parameter: dict) -> dict:
        name, new = parameter["name"], from_value(parameter["value"])
        if name not in values:
            return {"successful": False, "reason": f"parameter '{name}' cannot be set because it was not declared"}
        if type(new) is not type(values[name]):
            return {"successful": False, "reason": f"Wrong parameter type, parameter '{name}'"}
        values[name] = new
        event = {
            "stamp": dict(zip(("sec", "nanosec"), divmod(time.time_ns(), 10**9))),
            "node": args.node,
            "new_parameters": [],
            "changed_parameters": [parameter],
            "deleted_parameters": [],
        }
        events.publish(EVENT.encode(event))
        emit("set", name=name, value=new)
        return {"successful": True, "reason": ""}

    def describe(name: str) -> dict:
        nothing = {"description": "", "additional_constraints": "", "floating_point_range": (), "integer_range": ()}
        return nothing | {"name": name, "type": to_value(values.get(name))["type"], "read_only": False, "dynamic_typing": False}

    def list_all(request: dict) -> dict:
        prefixes = request["prefixes"]
        names = [name for name in sorted(values) if not prefixes or any(f"{name}.".startswith(f"{p}.") for p in prefixes)]
        return {"result": {"names": names, "prefixes": sorted({n.rpartition(".")[0] for n in names if "." in n})}}

    def set_all(request: dict) -> dict:
        # Atomically: nothing is set if one is refused.
        known = all(one["name"] in values for one in request["parameters"])
        results = [set_one(one) for one in request["parameters"] if known]
        refused = [one for one in results if not one["successful"]]
        return {"result": refused[0] if refused else {"successful": known, "reason": "" if known else "not declared"}}

    answers = {
        "describe_parameters": lambda request: {"descriptors": [describe(name) for name in request["names"]]},
        "get_parameter_types": lambda request: {"types": bytes(describe(name)["type"] for name in request["names"])},
        "get_parameters": lambda request: {"values": [to_value(values.get(name)) for name in request["names"]]},
        "list_parameters": list_all,
        "set_parameters": lambda request: {"results": [set_one(one) for one in request["parameters"]]},
        "set_parameters_atomically": set_all,
    }

    with open_context(args, run) as context:
        node = Node(context, args.node)
        events = Publisher(node, "/parameter_events", *EVENT.identity, PARAMETERS)

        def server(name: str, service: Service) -> Server:
            def asked(payload: bytes, reply) -> None:
                reply(service.encode_reply(answers[name](service.decode_request(payload))))

            return Server(node, f"{args.node}/{name}", *service.identity, asked, PARAMETERS)

        _servers = [server(name, service) for name, service in SERVICES.items()]
        emit("ready")
        run.wait()
        emit("summary", role="params", values=values)
    return EXIT_OK


def call_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--of", required=True, help="full name of the other node")
    parser.add_argument("--set", metavar="NAME=VALUE", help="sets one, before they are read")


def call(args: argparse.Namespace, run: Run) -> int:
    """Lists, describes and reads the parameters of a node."""
    found: dict = {}
    with open_context(args, run) as context:
        node = Node(context, args.node)
        clients = {
            name: Client(node, f"{args.of}/{name}", *service.identity, PARAMETERS) for name, service in SERVICES.items()
        }

        def ask(name: str, request: dict) -> dict | None:
            replies: list[dict] = []

            def done(payload: bytes) -> None:
                replies.append(SERVICES[name].decode_reply(payload))
                run.wake()

            clients[name].call(SERVICES[name].encode_request(request), done)
            return replies[0] if run.wait(lambda: bool(replies)) else None

        emit("ready")
        good = run.wait(lambda: all(client.servers() for client in clients.values()))
        if good and args.set:
            name, value = args.set.split("=", 1)
            reply = ask("set_parameters", {"parameters": [{"name": name, "value": to_value(parsed(value))}]})
            good = bool(reply and reply["results"][0]["successful"])
        listed = ask("list_parameters", {"prefixes": [], "depth": 0}) if good else None
        if listed:
            names = {"names": listed["result"]["names"]}
            got, types = ask("get_parameters", names), ask("get_parameter_types", names)
            described = ask("describe_parameters", names)
            if good := bool(got and types and described):
                found = dict(zip(names["names"], map(from_value, got["values"])))
                kinds = [one["type"] for one in got["values"]]
                good = list(types["types"]) == kinds == [one["type"] for one in described["descriptors"]]
        emit("summary", role="params-call", good=good and bool(listed), values=found)
    return EXIT_OK if good and listed else EXIT_INCOMPLETE


ROLES = {"params": (serve_options, serve), "params-call": (call_options, call)}
