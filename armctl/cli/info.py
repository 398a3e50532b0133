"""`armctl info ROBOT`: joints and limits."""

from __future__ import annotations

import argparse

from armctl.cli.common import DONE, Commands, add_arm, add_command, add_json, load_arm, print_result


def add(commands: Commands) -> None:
    """Adds the command to the parser."""
    parser = add_command(commands, "info", run, "show a robot's joints and limits")
    add_arm(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from armctl.analysis.describe import describe, facts

    arm = load_arm(args)
    print_result(args, describe(arm), facts(arm))
    return DONE
