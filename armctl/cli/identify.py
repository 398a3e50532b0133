"""`armctl identify ROBOT FILE.csv`: inertia and friction of an arm from a recording."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from armctl.cli import common, outputs
from armctl.core.errors import InputError

_QUANTITIES = ("t", "q", "tau")

_EXAMPLES = (
    "panda run.csv",
    "panda run.csv --columns t=time q=position_* tau=effort_* --units t=ms q=deg --out identification.html --out panda.urdf",
)


def add(commands: common.Commands) -> None:
    parser = common.add_command(
        commands, "identify", run, "identify inertia and friction of an arm from a recording", _EXAMPLES
    )
    common.add_arm(parser)
    parser.add_argument("file", type=Path, help="the recording: a .csv of t, q and tau, or a log of armctl (.npz)")
    parser.add_argument("--friction", default="coulomb+viscous", help="none, coulomb+viscous (the default) or stribeck")
    parser.add_argument("--columns", nargs="+", metavar="QUANTITY=NAME", help="columns, such as t=time q=pos* tau=torque*")
    parser.add_argument("--units", nargs="+", metavar="QUANTITY=UNIT", help="units, such as t=ms q=deg")
    parser.add_argument("--holdout", default="0.2", help="share of the recording that validates the result (default 0.2)")
    parser.add_argument("--any-inertia", action="store_true", help="accept physically inconsistent inertia")
    outputs.add_out(parser, "a page of the figures, and the robot with the result", [".html", ".xml", ".urdf"])
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    from armctl.core.log import Log
    from armctl.lab.identification.identification_page import identification_page
    from armctl.lab.identification.identify import identify

    outputs.check_out(args)
    columns = _table("columns", args.columns)
    units = _table("units", args.units)
    holdout = common.one_number("holdout", args.holdout)
    arm = common.load_arm(args)
    units = {"q": arm.units, "tau": arm.torque_units, **units}
    is_log = args.file.suffix in (".npz", ".parquet")
    log = Log.load(args.file) if is_log else Log.from_csv(args.file, columns, units=units, robot=arm.name)
    estimate = identify(arm, log, args.friction, not args.any_inertia, holdout=holdout)
    common.print_result(args, str(estimate), estimate.to_dict(), estimate.reason)
    files = [outputs.Output("identification.html", (".html",), lambda path: identification_page(estimate, path))]
    if estimate:
        files.append(outputs.Output(f"{arm.name}.xml", (".xml",), lambda path: estimate.to_mjcf(path, args.robot)))
        files.append(outputs.Output(f"{arm.name}.urdf", (".urdf",), estimate.to_urdf))
    outputs.write_outputs(args, files)
    return common.DONE if estimate else common.NOT_REACHED


def _table(what: str, words: Sequence[str] | None) -> dict[str, str]:
    """{"t": "time"} of ["t=time"]."""
    table = {}
    for word in words or ():
        quantity, _, name = word.partition("=")
        if quantity not in _QUANTITIES or not name:
            raise InputError(f"{what}: expected columns such as {what} t=... q=... tau=..., got {word!r:.60}")
        table[quantity] = name
    return table
