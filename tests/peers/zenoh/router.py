"""A Zenoh router as rmw_zenohd configures it (DEFAULT_RMW_ZENOH_ROUTER_CONFIG.json5), on eclipse-zenoh.

Reports `ready` with its id and the endpoints on which it listens, and ends at a signal.
"""

from __future__ import annotations

import argparse
import json

import rmw
import zenoh
from run import EXIT_OK, EXIT_USAGE, Run, block_signals, emit, leave

QUERY_TIMEOUT_S = 5


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--listen", action="append", help="tcp/[::]:7447 if none is given; tls/… needs --cert and --key")
    parser.add_argument("--connect", action="append", default=[], help="another router, as between hosts")
    parser.add_argument("--cert", help="certificate, PEM")
    parser.add_argument("--key", help="its key, PEM")
    parser.add_argument("--ca", help="certificate of the authority, PEM")
    parser.add_argument("--mutual", action="store_true", help="accept only sessions with a certificate of --ca")
    parser.add_argument("--any-name", action="store_true", help="accept a certificate for another host name")
    parser.add_argument("--access-control", help="file with the value of access_control, JSON5")
    parser.add_argument("--lease", type=float, default=60, help="seconds after which a silent connection counts as lost")
    parser.add_argument("--timeout", type=float, default=60.0, help="seconds, from the start")


def config_of(args: argparse.Namespace) -> zenoh.Config:
    config = rmw.base_config("router")
    config["connect"]["endpoints"] = args.connect
    config["listen"] = {"endpoints": args.listen or ["tcp/[::]:7447"]}
    config["routing"] = {"router": {"peers_failover_brokering": False}}
    config["adminspace"] = {"enabled": True, "permissions": {"read": True, "write": False}}
    config["transport"]["link"]["tx"]["lease"] = int(args.lease * 1000)
    if args.cert:
        rmw.with_tls(config, args.ca, args.cert, args.key, args.mutual, not args.any_name)
    config = zenoh.Config.from_json5(json.dumps(config))
    if args.access_control:
        with open(args.access_control, encoding="utf-8") as file:
            config.insert_json5("access_control", file.read())
    return config


def locators(session: zenoh.Session) -> list[str]:
    """Returns the endpoints, with the ports that the system chose."""
    for reply in session.get(f"@/{session.zid()}/router", timeout=QUERY_TIMEOUT_S):
        if reply.ok is not None:
            return json.loads(reply.ok.payload.to_string())["locators"]
    return []


def serve(args: argparse.Namespace) -> int:
    run = Run(args.timeout)
    try:
        session = zenoh.open(config_of(args))
    except zenoh.ZError as error:
        emit("refused", error=str(error))
        return EXIT_USAGE
    emit("ready", zid=str(session.zid()), endpoints=locators(session))
    run.wait()
    session.close()
    emit("summary", role="router")
    return EXIT_OK


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    options(parser)
    args = parser.parse_args()
    block_signals()
    leave(serve(args))


if __name__ == "__main__":
    main()
