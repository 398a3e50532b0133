"""`armctl robot check HOST`: whether robot, model and connection are fit for motions; `view`: a page that moves the robot."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING

from armctl.cli import common
from armctl.core.errors import InputError
from armctl.core.json_values import json_value

if TYPE_CHECKING:
    from armctl.model.arm.arm import Arm
    from armctl.run.links.link import Link

_MODELS = {"franka": "fr3", "so101": "so101", "plant": "robot_arm_3dof"}

_EXAMPLES = (
    "check 172.16.0.2",
    "view 172.16.0.2 --tool panda_hand",
    "check /dev/ttyACM0 --link so101 --calibration arm.json",
)


def add(commands: common.Commands) -> None:
    parser = common.add_command(
        commands, "robot", run, "check the connection to a robot, or move it by hand on a page", _EXAMPLES
    )
    parser.add_argument("action", choices=["check", "view"], help="check: hold the position, and measure; view: a page")
    parser.add_argument("host", help="address of a Franka, serial port of an SO-101, any word for a simulated plant")
    parser.add_argument("--model", help="name or file of the model, by default that of the robot")
    parser.add_argument("--tool", help="gripper, hand or MJCF file at the tip of the model")
    add_link(parser)
    parser.add_argument("--duration", metavar="S", default="10", help="how long (default 10)")
    common.add_json(parser)


def add_link(parser: argparse.ArgumentParser) -> None:
    """Adds the options that `link_from` reads."""
    parser.add_argument("--link", choices=list(_MODELS), default="franka", help="which robot (default %(default)s)")
    parser.add_argument("--calibration", metavar="FILE", help="of an SO-101, as lerobot-calibrate wrote it")
    parser.add_argument("--payload", metavar="KG", default="0", help="that the robot is set to, in kg (default 0)")
    parser.add_argument("--no-real-time", action="store_true", help="without real-time priority, for a simulated Franka")


def run(args: argparse.Namespace) -> int:
    duration = common.one_number("duration", args.duration)
    payload = common.one_number("payload", args.payload)
    from armctl.model.loading.load import load
    from armctl.run.links.robot import Robot

    arm = load(args.model or _MODELS[args.link], tool=args.tool)
    with Robot(arm, link_from(args, arm, payload), payload=payload) as robot:
        if args.action == "view":
            from armctl.view import view_robot

            view_robot(robot)
            return common.DONE
        check = robot.check(duration)
    common.print_result(args, str(check), json_value(asdict(check)), check.reason)
    return common.DONE if check else common.NOT_REACHED


def link_from(args: argparse.Namespace, arm: Arm, payload: float) -> Link:
    """The link that the options name."""
    if args.link == "franka":
        from armctl.run.links.franka import Franka

        return Franka(args.host, payload=payload, real_time=not args.no_real_time)
    if args.link == "so101":
        from armctl.run.links.so101 import SO101

        if not args.calibration:
            raise InputError("calibration: an SO-101 needs the file that lerobot-calibrate wrote")
        return SO101(arm, args.host, args.calibration)
    from armctl.run.links.plant_link import PlantLink

    return PlantLink(arm, payload=payload, real_time=True)
