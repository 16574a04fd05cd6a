"""Runs the Zenoh peers against each other without SGC, to show that a failure elsewhere is not theirs.

Two hosts are two network namespaces joined by a cable, each with a router of its own, as rmw_zenoh does it: nodes reach the nodes of
their own host directly, and those of the other host through both routers. A third kind of node is a client of the other
host's router. Namespaces are named `sgct-…` and deleted at the end.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from check import ROOT, Peer, ip

sys.path.insert(0, str(Path(__file__).parent / "zenoh"))

LEFT, RIGHT = "10.232.0.1", "10.232.0.2"
SHARE = ROOT / ".peers" / "jazzy" / "share"
# A description with the references of a service, and one of the action itself, under other names.
COPIES = {
    "example_interfaces/action/Fibonacci": "test_msgs/action/Fibonacci",
    "example_interfaces/srv/AddTwoInts": "test_msgs/srv/BasicTypes",
}
INT64 = 8
ACCESS = """
// Denies one topic to all.
{
  enabled: true,
  default_permission: "allow",
  rules: [{
    id: "secret", permission: "deny", flows: ["ingress", "egress"], messages: ["put", "declare_subscriber"],
    key_exprs: ["0/secret/**"],
  }],
  subjects: [{ id: "all" }],
  policies: [{ rules: ["secret"], subjects: ["all"] }],
}
"""


class Hosts:
    """Two hosts on a cable, each with a router, removed at the end."""

    def __init__(self) -> None:
        self.left, self.right = (f"sgct-{os.getpid()}-z{side}" for side in "lr")
        self.routers: list[Peer] = []

    def __enter__(self) -> "Hosts":
        for name in (self.left, self.right):
            ip("netns", "add", name)
            ip("-n", name, "link", "set", "lo", "up")
        ip("link", "add", "eth0", "netns", self.left, "type", "veth", "peer", "name", "eth0", "netns", self.right)
        for name, address in ((self.left, LEFT), (self.right, RIGHT)):
            ip("-n", name, "addr", "add", f"{address}/24", "dev", "eth0")
            ip("-n", name, "link", "set", "eth0", "up")
        self.routers = [
            Peer("zenoh", "router", self.left, "--timeout", "3600"),
            Peer("zenoh", "router", self.right, "--timeout", "3600", "--connect", f"tcp/{LEFT}:7447"),
        ]
        assert all(router.until("ready") for router in self.routers), "no router"
        return self

    def __exit__(self, *_exc: object) -> None:
        for router in self.routers:
            router.process.terminate()
            router.end()
        for name in (self.left, self.right):
            subprocess.run(["ip", "netns", "delete", name], check=False, stderr=subprocess.DEVNULL)


class Checks:
    def __init__(self, hosts: Hosts, only: str | None) -> None:
        self.hosts, self.only = hosts, only
        # Host and options of the second program; the first is on the left.
        self.places = {
            "one host": (hosts.left, []),
            "two hosts": (hosts.right, []),
            "client": (hosts.right, ["--mode", "client", "--connect", f"tcp/{LEFT}:7447"]),
        }
        self.passed, self.failures = 0, []

    def run(self, name: str, check, *arguments: object) -> None:
        if self.only and self.only not in name:
            return
        begun = time.monotonic()
        with contextlib.ExitStack() as stack:
            self.stack = stack
            problem = check(*arguments)
        print(f"{'FAIL' if problem else 'ok  '} {name}: {problem or f'{time.monotonic() - begun:.1f} s'}", flush=True)
        if problem:
            self.failures.append(name)
        else:
            self.passed += 1

    def peer(self, vendor: str, role: str, host: str, *options: str) -> Peer:
        """Starts a peer that ends with the check."""
        peer = Peer(vendor, role, host, *options)
        self.stack.callback(peer.process.wait)
        self.stack.callback(peer.process.kill)
        return peer

    def messages(self, pub: str, sub: str, place: str, count: int, *options: str) -> str | None:
        host, there = self.places[place]
        listener = self.peer(sub, "sub", host, "--count", str(count), "--linger", "0.3", *there, *options)
        rate = ["--rate", "2"] if "--bytes" in options else ["--rate", "200"]
        talker = self.peer(pub, "pub", self.hosts.left, "--count", str(count), "--wait-go", "--node", "/talker", *rate, *options)
        if not all(peer.until("matched", lambda line: line["count"] == 1) for peer in (listener, talker)):
            return "no match"
        talker.go()
        heard = listener.until("summary") or {}
        if listener.end() != 0 or talker.end() != 0:
            return f"exits {listener.end()}, {talker.end()}: {heard}"
        whole = heard["received"] == count and heard["lost"] == heard["reordered"] == heard["numbers_skipped"] == 0
        # hiroz does not say, and its own ids are no hashes of its tokens.
        is_source = "hiroz" in (pub, sub) or heard["from"] == ["/talker"]
        return None if whole and is_source else str(heard)

    def late_joiner(self, pub: str, sub: str, place: str) -> str | None:
        """A late joiner gets the last messages, and then the live ones."""
        host, there = self.places[place]
        latched = ["--transient-local", "--depth", "5"]
        talker = self.peer(
            pub, "pub", self.hosts.left, *latched, "--count", "20", "--rate", "100", "--wait-matched", "0", "--hold", "60"
        )  # fmt: skip
        if not talker.until("all_sent"):
            return "nothing was sent"
        listener = self.peer(sub, "sub", host, *latched, *there, "--count", "5", "--linger", "0.5", "--timeout", "20")
        heard = listener.until("summary") or {}
        if (heard.get("received"), heard.get("first"), heard.get("duplicated"), heard.get("reordered")) != (5, 15, 0, 0):
            return str(heard)
        volatile = self.peer(sub, "sub", host, *there, "--count", "1", "--timeout", "2")
        heard = volatile.until("summary") or {}
        return str(heard) if heard.get("received") != 0 else None

    def calls(self, server: str, client: str, place: str, *options: str) -> str | None:
        host, there = self.places[place]
        serving = self.peer(server, "serve", self.hosts.left, *options)
        if not serving.until("ready"):
            return "no server"
        calling = self.peer(client, "call", host, "--count", "20", *there, *options)
        called = calling.until("summary") or {}
        serving.process.terminate()
        served = serving.until("summary") or {}
        good = calling.end() == 0 and (called["answered"], called["others"], served.get("served")) == (20, 0, 20)
        return None if good else f"{called}, {served}"

    def action(self, server: str, client: str, place: str, *options: str) -> str | None:
        host, there = self.places[place]
        self.peer(server, "action-serve", self.hosts.left)
        calling = self.peer(client, "action-call", host, *there, *options)
        ended = calling.until("summary") or {}
        cancelled = "--cancel" in options
        numbers = ended.get("feedback", 0)
        good = calling.end() == 0 and ended["grows"] and ended["last_status"] == (5 if cancelled else 4)
        return None if good and (numbers < 10 if cancelled else numbers == 6) else str(ended)

    def parameters(self, place: str) -> str | None:
        host, there = self.places[place]
        self.peer("zenoh", "params", self.hosts.left, "--node", "/robot/arm")
        calling = self.peer("zenoh", "params-call", host, "--of", "/robot/arm", "--set", "answer=7", *there)
        ended = calling.until("summary") or {}
        good = calling.end() == 0 and ended["values"] == {"answer": 7, "ratio": 0.5, "robot.name": "arm", "use_sim_time": False}
        return None if good else str(ended)

    def values(self) -> str | None:
        """Bytes of one distribution against values of the other."""
        folder = self.stack.enter_context(tempfile.TemporaryDirectory())
        files = {}
        for distribution in ("jazzy", "kilted"):
            files[distribution] = f"{folder}/{distribution}.json"
            command = [str(ROOT / ".peers" / distribution / "bin" / "python"), "-B", str(ROOT / "tests/peers/ros2/values.py")]
            with open(files[distribution], "w", encoding="utf-8") as file:
                subprocess.run([*command, "dump"], check=True, stdout=file)
        listener = self.peer("zenoh", "values", self.hosts.right, "sub", "--file", files["jazzy"])
        talker = self.peer("zenoh", "values", self.hosts.left, "pub", "--file", files["kilted"])
        if not all(peer.until("matched") for peer in (listener, talker)):
            return "no match"
        talker.go()
        heard = listener.until("summary") or {}
        return None if listener.end() == 0 and heard["types"] == 138 else str(heard)

    def graph(self) -> str | None:
        """Endpoints come, and go when their program is killed or their session is closed."""
        watching = self.peer("zenoh", "graph", self.hosts.right, "--hidden")
        if not watching.until("graph", lambda graph: not graph["nodes"]):
            return "others are there"
        talker = self.peer("zenoh", "pub", self.hosts.left, "--node", "/a/talker", "--best-effort", "--depth", "3")
        seen = watching.until("graph", lambda graph: len(graph["endpoints"]) == 1)
        if not seen or seen["nodes"] != ["/a/talker"] or seen["endpoints"][0]["qos"] != "2::,3:,:,:,,":
            return f"saw {seen}"
        talker.process.kill()
        if not watching.until("graph", lambda graph: not graph["nodes"] and not graph["endpoints"]):
            return "a killed program stays"
        for restart in ([], ["--restart"]):
            churning = self.peer("zenoh", "churn", self.hosts.left, "--rounds", "5", *restart)
            if not churning.until("done"):
                return "churn saw no change"
            churning.process.terminate()
            if churning.end() != 0:
                return "churn ended badly"
        watching.process.terminate()
        last = None
        while told := watching.until("graph"):
            last = told
        return f"left: {last}" if last and last["endpoints"] else None

    def far_peer(self) -> str | None:
        """A peer on another host than its router and the nodes there: the router does not forward between peers."""
        self.peer("zenoh", "pub", self.hosts.left, "--node", "/talker")
        there = ["--hidden", "--timeout", "4", "--connect", f"tcp/{LEFT}:7447"]
        client = self.peer("zenoh", "graph", self.hosts.right, *there, "--mode", "client")
        if not client.until("graph", lambda graph: graph["nodes"] == ["/talker"]):
            return "a client does not see the node"
        far = self.peer("zenoh", "graph", self.hosts.right, *there)
        return "it sees the node" if far.until("graph", lambda graph: graph["nodes"]) else None

    def certificates(self) -> str | None:
        """A router with certificates and access control, on a port of its own."""
        folder = self.stack.enter_context(tempfile.TemporaryDirectory())
        make_certificates(folder, "ca", ["router", "robot"])
        make_certificates(folder, "other", ["stranger"])
        Path(folder, "access.json5").write_text(ACCESS)
        address = f"tls/{LEFT}:7448"

        def files(ca: str, name: str) -> list[str]:
            return ["--ca", f"{folder}/{ca}.pem", "--cert", f"{folder}/{name}.pem", "--key", f"{folder}/{name}.key"]

        rules = ["--access-control", f"{folder}/access.json5"]
        router = self.peer("zenoh", "router", self.hosts.left, "--listen", address, "--mutual", *files("ca", "router"), *rules)
        if not router.until("ready"):
            return "no router"
        there = ["--mode", "client", "--connect", address, "--count", "10"]
        robot = [*there, *files("ca", "robot")]
        for topic, expected in (("/open", 10), ("/secret", 0)):
            listener = self.peer("zenoh", "sub", self.hosts.right, "--topic", topic, "--timeout", "4", *robot)
            talker = self.peer("zenoh", "pub", self.hosts.left, "--topic", topic, "--rate", "100", *robot)
            talker.until("summary")
            heard = listener.until("summary") or {}
            if heard.get("received") != expected:
                return f"{topic}: {heard}"
        for kind, options in (("a stranger", files("ca", "stranger")), ("nobody", ["--ca", f"{folder}/ca.pem"])):
            if not self.peer("zenoh", "sub", self.hosts.right, *there, *options).until("no_router"):
                return f"{kind} was admitted"
        return None


def make_certificates(folder: str, authority: str, names: list[str]) -> None:
    def openssl(*words: str) -> None:
        subprocess.run(["openssl", *words], check=True, cwd=folder, capture_output=True)

    key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    openssl("req", "-x509", *key, "-keyout", f"{authority}.key", "-out", f"{authority}.pem", "-days", "2", "-subj", f"/CN={authority}")
    Path(folder, "extensions").write_text(f"subjectAltName=IP:{LEFT}\nbasicConstraints=critical,CA:false\n")
    for name in names:
        openssl("req", *key, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        by = ["-CA", f"{authority}.pem", "-CAkey", f"{authority}.key", "-CAcreateserial", "-extfile", "extensions"]
        openssl("x509", "-req", "-in", f"{name}.csr", *by, "-days", "2", "-out", f"{name}.pem")


def wrong_hashes() -> str | None:
    """Compares the hashes of the Zenoh peer with those in the type descriptions of ROS 2 Jazzy."""
    from interfaces import HASHES

    def described(name: str) -> tuple[dict, dict]:
        file = json.loads((SHARE / f"{name}.json").read_text())
        message = file["type_description_msg"]
        types = {one["type_name"]: one for one in (message["type_description"], *message["referenced_type_descriptions"])}
        return types, {one["type_name"]: one["hash_string"] for one in file["type_hashes"]}

    def hash_of(types: dict, name: str) -> str:
        """Computes a hash as rosidl_generator_type_description does (REP 2016)."""

        def stripped(kind: dict) -> dict:
            fields = [{key: field[key] for key in ("name", "type")} for field in kind["fields"]]
            return {"type_name": kind["type_name"], "fields": fields}

        names, open_ends = set(), [name]
        while open_ends:
            nested = {field["type"]["nested_type_name"] for field in types[open_ends.pop()]["fields"]} - names - {""}
            names |= nested
            open_ends += nested
        whole = {
            "type_description": stripped(types[name]),
            "referenced_type_descriptions": [stripped(types[one]) for one in sorted(names)],
        }
        return "RIHS01_" + hashlib.sha256(json.dumps(whole, separators=(", ", ": ")).encode()).hexdigest()

    def int64(name: str) -> dict:
        return {"name": name, "type": {"type_id": INT64, "capacity": 0, "string_capacity": 0, "nested_type_name": ""}}

    true: dict[str, str] = {}
    for copy, original in COPIES.items():
        types, hashes = described(original)
        if any(hash_of(types, name) != found for name, found in hashes.items()):
            return f"the rule of the hash does not give that of {original}"
        types = json.loads(json.dumps(types).replace(original, copy))
        if copy.endswith("AddTwoInts"):
            types[f"{copy}_Request"]["fields"] = [int64("a"), int64("b")]
            types[f"{copy}_Response"]["fields"] = [int64("sum")]
        true |= {name: hash_of(types, name) for name in types}
    for name in HASHES:
        if name not in true:
            package, kind, base = name.split("/")
            true |= described(f"{package}/{kind}/{base.split('_')[0]}")[1]
    wrong = [name for name, found in HASHES.items() if true.get(name) != found]
    return f"wrong: {wrong}" if wrong else None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true", help="also messages of 13 MB, values, certificates, and every pair at every place")
    parser.add_argument("--only", help="only checks whose name contains this")
    args = parser.parse_args()
    vendors = ["zenoh"] + (["hiroz"] if (ROOT / ".peers" / "hiroz").exists() else [])
    if len(vendors) == 1:
        print("hiroz: left out, because `make peers-hiroz` was not run", flush=True)
    pairs = [(one, other) for one in vendors for other in vendors if args.long or "zenoh" in (one, other)]
    with Hosts() as hosts:
        checks = Checks(hosts, args.only)
        checks.run("type hashes", wrong_hashes)
        # The suites of `sgc` use the same programs at the other places.
        for place in checks.places if args.long else ["two hosts"]:
            for one, other in pairs:
                name = f"{one} -> {other}, {place}"
                checks.run(f"string {name}", checks.messages, one, other, place, 200, "--depth", "400")
                checks.run(f"late joiner {name}", checks.late_joiner, one, other, place)
                checks.run(f"service {name}", checks.calls, one, other, place)
            checks.run(f"best effort, {place}", checks.messages, "zenoh", "zenoh", place, 50, "--best-effort")
            checks.run(f"1 MB, {place}", checks.messages, "zenoh", "zenoh", place, 5, "--bytes", "1000000", "--depth", "0")
            if args.long:
                checks.run(f"13 MB, {place}", checks.messages, "zenoh", "zenoh", place, 5, "--bytes", "13000003", "--depth", "0")
        checks.run("buffers", checks.messages, "zenoh", "zenoh", "two hosts", 10, "--bytes", "1000", "--buffers")
        checks.run("service BasicTypes", checks.calls, "zenoh", "zenoh", "two hosts", "--type", "test_msgs/srv/BasicTypes")
        for one, other in pairs:
            checks.run(f"action {one} -> {other}", checks.action, one, other, "two hosts")
            # hiroz 0.2.1 takes no cancellation while a client waits for the result.
            if one != "hiroz":
                cancel = ["--order", "20", "--cancel"]
                checks.run(f"cancelled action {one} -> {other}", checks.action, one, other, "client", *cancel)
        checks.run("parameters", checks.parameters, "two hosts")
        checks.run("graph", checks.graph)
        checks.run("far peer", checks.far_peer)
        if args.long:
            checks.run("values", checks.values)
            checks.run("certificates", checks.certificates)
    print(f"{checks.passed} passed, {len(checks.failures)} failed", flush=True)
    return 1 if checks.failures or not checks.passed else 0


if __name__ == "__main__":
    sys.exit(main())
