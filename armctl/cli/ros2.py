"""`armctl ros2 serve ROBOT`: a simulated arm, or a robot behind a link, as a node of ROS 2."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from armctl.cli import common

if TYPE_CHECKING:
    from armctl.model.arm.arm import Arm
    from armctl.run.links.link import Link

_EXAMPLES = (
    "serve panda",
    "serve ur5e --controller scaled_joint_trajectory_controller --speed 0.5",
    "serve fr3 --franka 172.16.0.2",
)
_SIMULATED_TIP_SPEED = 10.0  # m/s: nobody is beside a simulation
_ROBOT_TIP_SPEED = 0.25  # m/s, as of `Robot`
_SIMULATED_SPEED = 1.0
_ROBOT_SPEED = 0.2


def add(commands: common.Commands) -> None:
    parser = common.add_command(commands, "ros2", run, "serve an arm as a node of ROS 2, like the driver of a robot", _EXAMPLES)
    parser.add_argument("action", choices=["serve"], help="serve: until Ctrl-C")
    common.add_arm(parser)
    parser.add_argument("--franka", metavar="HOST", help="serve the robot at this address, instead of a simulated arm")
    parser.add_argument("--controller", default="joint_trajectory_controller", help="name of the node (default %(default)s)")
    parser.add_argument("--namespace", default="", help="of the node and of joint_states (default none)")
    parser.add_argument("--rate", metavar="HZ", default="100", help="messages per second on each topic (default 100)")
    parser.add_argument("--speed", metavar="FRACTION", help="fraction of full speed (default 1, of a robot 0.2)")
    parser.add_argument("--tip-speed", metavar="M/S", help="greatest speed of the tip (default none, of a robot 0.25)")


def run(args: argparse.Namespace) -> int:
    rate = common.one_number("rate", args.rate)
    is_robot = args.franka is not None
    speed = common.one_number("speed", args.speed) if args.speed else _ROBOT_SPEED if is_robot else _SIMULATED_SPEED
    limit = _ROBOT_TIP_SPEED if is_robot else _SIMULATED_TIP_SPEED
    tip_speed = common.one_number("tip_speed", args.tip_speed) if args.tip_speed else limit
    from armctl.run.links.robot import Robot
    from armctl.run.links.ros2_server import serve_ros2

    arm = common.load_arm(args)
    with Robot(arm, _link(args, arm), speed=speed, tip_speed=tip_speed) as robot:
        try:
            serve_ros2(robot, controller=args.controller, namespace=args.namespace, rate=rate)
        except KeyboardInterrupt:
            print("the arm is at rest; the node ends")
    return common.DONE


def _link(args: argparse.Namespace, arm: Arm) -> Link:
    if args.franka is not None:
        from armctl.run.links.franka import Franka

        return Franka(args.franka)
    from armctl.run.links.plant_link import PlantLink

    return PlantLink(arm, real_time=True)
