"""Runs the peers against each other without SGC, to show that a failure elsewhere is not theirs.

Each case starts a subscriber and a publisher, waits until both say that they are matched, and only then lets the publisher
send: DDS matches each side on its own, so a publisher alone cannot know. Even then a volatile Cyclone reader takes its
first heartbeat as the beginning, so the first message may be lost to it; a case therefore counts from the first message
that was heard, and the publisher goes on until the subscriber has enough. RustDDS, and the types that came with it, are
checked in one network only, which says as much in a third of the time. Networks, which are checked at the same time:
`lo-netns` (a new namespace that has only `lo`) and `veth` (two namespaces joined by a cable, without shared memory).
Namespaces are named `sgct-…` and deleted at the end; where they cannot be made the run says so and fails. With
`--no-netns`, the loopback interface of this host takes their place.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PEERS = ("cyclone", "fastdds", "rustdds")
TIMEOUT_S = 60
# These pairs lose some of a stream of large messages, or fall behind it for good, with stock settings and stock socket buffers.
# They are run with --long and do not count as failures.
WEAK = {
    ("fastdds", "cyclone", "pointcloud"),
    ("rustdds", "cyclone", "pointcloud"),
    ("rustdds", "fastdds", "image"),
    ("rustdds", "fastdds", "pointcloud"),
}


class Peer:
    """One running peer and the lines it prints."""

    def __init__(self, name: str, role: str, netns: str | None, *options: str) -> None:
        inside = ["ip", "netns", "exec", netns] if netns else []
        command = [*inside, str(ROOT / ".peers" / name), role, "--timeout", str(TIMEOUT_S), *options]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.lines: queue.Queue = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stdout:
            self.lines.put(json.loads(line))
        self.lines.put(None)

    def until(self, event: str, good=lambda line: True) -> dict | None:
        """Returns the next matching line of this kind, or None when the peer ended or the time is up."""
        deadline = time.monotonic() + TIMEOUT_S
        while True:
            try:
                line = self.lines.get(timeout=max(0.01, deadline - time.monotonic()))
            except queue.Empty:
                return None
            if line is None:
                return None
            if line["event"] == event and good(line):
                return line

    def go(self) -> None:
        self.process.stdin.write("go\n")
        self.process.stdin.flush()

    def end(self) -> int:
        try:
            return self.process.wait(timeout=TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.process.terminate()
            return self.process.wait(timeout=10)


def run_case(
    place: str, pub: str, sub: str, kind: str, count: int, rate: float, size: int, where: tuple, more: list[str]
) -> str | None:
    """Returns None, or the failure. Prints one line of figures."""
    # Small messages come fast, and the default depth of 10 loses some if the machine pauses for a fifth of a second.
    depth = [] if size else ["--depth", "400"]
    same = ["--topic", "/peer_check", "--type", kind, "--domain", "91", *depth, *where[2], *more]
    listener = Peer(sub, "sub", where[1], *same, "--count", str(count), "--linger", "0.3")
    talker = Peer(pub, "pub", where[0], *same, "--rate", str(rate), "--size", str(size), "--wait-go")
    started = time.monotonic()
    matched = all(peer.until("matched", lambda line: line["count"] > 0) for peer in (listener, talker))
    matched_after = time.monotonic() - started
    if matched:
        talker.go()
    else:
        listener.process.terminate()
    heard = listener.until("summary") or {}
    talker.process.terminate()
    said = talker.until("summary") or {}
    codes = (talker.end(), listener.end())
    figures = f"matched after {matched_after:.2f} s, sent {said.get('sent')}, first heard {heard.get('first')}, "
    figures += f"lost {heard.get('lost')}, latency_us {heard.get('latency_us')}"
    good = matched and codes == (0, 0) and heard.get("received", 0) >= count and heard.get("lost") == 0
    weak = (pub, sub, kind) in WEAK
    print(f"{'ok  ' if good else 'weak' if weak else 'FAIL'} {place:<8} {pub:>7} -> {sub:<7} {kind:<10} {size or '':>8} x{count}: {figures}", flush=True)
    return None if good or weak else f"{place} {pub} -> {sub} {kind}: exits {codes}, sent {said}, heard {heard}"


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


class Networks:
    """Namespaces of this run, removed at the end."""

    def __init__(self) -> None:
        self.names = [f"sgct-{os.getpid()}-{i}" for i in range(3)]

    def __enter__(self) -> "Networks":
        alone, left, right = self.names
        for name in self.names:
            ip("netns", "add", name)
            ip("-n", name, "link", "set", "lo", "up")
        ip("link", "add", "eth0", "netns", left, "type", "veth", "peer", "name", "eth0", "netns", right)
        for name, address in ((left, "10.231.0.1/24"), (right, "10.231.0.2/24")):
            ip("-n", name, "addr", "add", address, "dev", "eth0")
            ip("-n", name, "link", "set", "eth0", "up")
        return self

    def __exit__(self, *_exc) -> None:
        for name in self.names:
            subprocess.run(["ip", "netns", "delete", name], check=False, stderr=subprocess.DEVNULL)

    def places(self) -> dict[str, tuple]:
        alone, left, right = self.names
        return {"lo-netns": (alone, alone, ["--localhost"]), "veth": (left, right, ["--udp-only"])}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true", help="also images of 13 MB, and more of everything")
    parser.add_argument("--no-netns", action="store_true", help="only the loopback interface of this host")
    parser.add_argument("--stock", action="store_true", help="images too with every setting as the DDS ships it")
    parser.add_argument("--only", help="only cases whose 'pub sub type' contains this")
    args = parser.parse_args()
    cases = [("string", 50, 50.0, 0), ("custom", 50, 50.0, 0), ("image", 10, 10.0, 1_000_000)]
    if args.long:
        cases = [("string", 500, 500.0, 0), ("custom", 500, 500.0, 0), ("image", 50, 10.0, 1_000_000),
                 ("image", 5, 1.0, 13_000_003)]  # fmt: skip
    more_cases = [("wstring", 30, 50.0, 0), ("keyed", 30, 50.0, 0), ("pointcloud", 10, 10.0, 6_000_000)]
    pairs = [(pub, sub) for pub in PEERS for sub in PEERS]
    problems: list[str | None] = []

    def run_at(place: str, where: tuple) -> None:
        for pub, sub in pairs:
            third = "rustdds" in (pub, sub)
            if third and place == "veth":
                continue
            for kind, count, rate, size in cases + (more_cases if place != "veth" else []):
                if third and kind == "keyed":
                    continue  # ros2-client has no keyed topics
                if (pub, sub, kind) in WEAK and not args.long:
                    continue
                if not args.only or args.only in f"{pub} {sub} {kind} {place}":
                    more = ["--large"] if size and not args.stock else []
                    problems.append(run_case(place, pub, sub, kind, count, rate, size, where, more))

    if args.no_netns:
        print("network namespaces: left out, as asked", flush=True)
        run_at("lo", (None, None, ["--localhost"]))
    else:
        with Networks() as networks, ThreadPoolExecutor() as places:
            for place in [places.submit(run_at, *place) for place in networks.places().items()]:
                place.result()
    bad = [problem for problem in problems if problem]
    for problem in bad:
        print(problem, file=sys.stderr)
    print(f"{len(problems) - len(bad)} passed, {len(bad)} failed", flush=True)
    return 1 if bad or not problems else 0


if __name__ == "__main__":
    sys.exit(main())
