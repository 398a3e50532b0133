"""`armctl info ROBOT`: joints and limits."""

from __future__ import annotations

import argparse

from armctl.cli import common


def add(commands: common.Commands) -> None:
    """Adds the command to the parser."""
    parser = common.add_command(commands, "info", run, "show a robot's joints and limits")
    common.add_arm(parser)
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from armctl.analysis.describe import describe, facts

    arm = common.load_arm(args)
    common.print_result(args, describe(arm), facts(arm))
    return common.DONE
