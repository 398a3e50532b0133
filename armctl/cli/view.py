"""`armctl view ROBOT`: drag the target in the browser, and the arm follows."""

from __future__ import annotations

import argparse

from armctl.cli.common import DONE, Commands, add_arm, add_command, load_arm
from armctl.core.errors import InputError


def add(commands: Commands) -> None:
    """Adds the command to the parser."""
    parser = add_command(commands, "view", run, "drag the target in the browser, and the arm follows")
    add_arm(parser)
    parser.add_argument("--controller", default="computed-torque", help="the first controller (default computed-torque)")
    parser.add_argument("--port", type=int, default=8080, help="where to serve; the next free one if taken (default 8080)")
    parser.add_argument("--host", help="serve other machines too, at this address; requires --token")
    parser.add_argument("--token", help="what visitors from other machines must know, at least 8 characters")
    parser.add_argument("--native", action="store_true", help="MuJoCo's own viewer instead of the browser")


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from armctl import viewer
    from armctl.loading import catalog

    if args.host and not args.token:
        raise InputError("host: anyone who finds the page could control the arm; choose a --token for your visitors")
    if args.token and not args.host:
        raise InputError("token: without --host only this machine can reach the page, which needs no token")
    if args.native:
        viewer.view_natively(load_arm(args), args.controller)
    else:
        catalog.locate(args.robot)  # an unknown name is reported before a browser opens
        viewer.view(lambda: load_arm(args), args.controller, port=args.port, host=args.host, token=args.token)
    return DONE
