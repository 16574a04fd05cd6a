"""Nodes of rmw_zenoh on eclipse-zenoh that do not know SGC. `../README.md` specifies roles, options and reports."""

from __future__ import annotations

import argparse

import actions
import graph
import hostile
import parameters
import router
import services
import topics
import values
from run import Run, block_signals, leave, session_options

ROLES = topics.ROLES | services.ROLES | actions.ROLES | parameters.ROLES | graph.ROLES | values.ROLES | hostile.ROLES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    roles = parser.add_subparsers(dest="role", required=True)
    router.options(roles.add_parser("router", help="a router, as router.py"))
    common = session_options()
    for name, (options, _) in ROLES.items():
        options(roles.add_parser(name, parents=[common]))
    args = parser.parse_args()
    block_signals()
    if args.role == "router":
        leave(router.serve(args))
    leave(ROLES[args.role][1](args, Run(args.timeout)))


if __name__ == "__main__":
    main()
