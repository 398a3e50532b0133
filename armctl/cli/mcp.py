"""`armctl mcp ROBOT`: an arm for a language model that calls tools; `armctl allow`: the person who lets it move a robot."""

from __future__ import annotations

import argparse

from armctl.cli import common
from armctl.cli.robot import add_link, link_from

_EXAMPLES = (
    "panda",
    "panda --scene table.xml --out record",
    "fr3 --robot 172.16.0.2 --tool panda_hand",
)
_ALLOW_EXAMPLES = ("",)


def add(commands: common.Commands) -> None:
    parser = common.add_command(
        commands, "mcp", run, "serve an arm to a language model (MCP, over standard input and output)", _EXAMPLES
    )
    common.add_arm(parser)
    parser.add_argument(
        "--robot", dest="host", metavar="HOST", help="a robot instead of a simulation: its address, or the port of an SO-101"
    )
    add_link(parser)
    common.add_speed(parser)
    parser.add_argument("--out", metavar="FOLDER", help="record: calls.jsonl, and the log of each motion")
    common.add_command(
        commands, "allow", run_allow, "let the agent of `armctl mcp` move its robot, until you press Enter", _ALLOW_EXAMPLES
    )


def run(args: argparse.Namespace) -> int:
    from armctl.run.agent.server import claimed_wire, require_sdk, serve_on

    require_sdk()
    speed = common.speed_from(args.speed)
    payload = common.one_number("payload", args.payload)
    with claimed_wire() as wire:
        arm = common.load_arm(args)
        if args.host is None:
            from armctl.run.sim.simulation import Simulation

            slower = arm if speed == 1.0 else arm.with_limits(arm.limits.at_speed(speed))
            serve_on(wire, Simulation(slower), args.out)
            return common.DONE
        from armctl.run.links.robot import Robot

        with Robot(arm, link_from(args, arm, payload), payload=payload, speed=speed) as robot:
            serve_on(wire, robot, args.out)
    return common.DONE


def run_allow(args: argparse.Namespace) -> int:
    from armctl.run.agent.person import allow

    allow()
    return common.DONE
