"""`armctl doctor ROBOT`: what is doubtful in a robot's file."""

from __future__ import annotations

import argparse

from armctl.cli import common


def add(commands: common.Commands) -> None:
    """Adds the command to the parser."""
    parser = common.add_command(commands, "doctor", run, "list what is missing, impossible or assumed in a robot's file")
    common.add_robot(parser)
    parser.add_argument("--tip", help="site, body or geom at the end of the chain")
    parser.add_argument("--base", help="body at the start of the chain")
    parser.add_argument("--srdf", help="path of an SRDF")
    parser.add_argument("--hold-base", action="store_true", help="fix the base of a floating or walking robot at its keyframe")
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from dataclasses import asdict

    from armctl.analysis.diagnose import diagnose

    found = diagnose(args.robot, tip=args.tip, base=args.base, hold_base=args.hold_base, srdf=args.srdf)
    payload = found.payload if found else None
    figures = {"name": found.name, "payload": payload, "findings": [asdict(f) for f in found.findings]}
    common.print_result(args, str(found), figures, found.reason)
    return common.DONE if found else common.NOT_REACHED
