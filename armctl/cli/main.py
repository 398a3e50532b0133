"""The command line: `armctl robots | chains | info | reach | compare | iso9283 | simulate`.

Exit status: 0 done and reached, 1 not reached, 2 a wrong call.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from armctl import __version__
from armctl.core.errors import ArmctlError, InputError, LimitError, UnknownNameError

if TYPE_CHECKING:
    from armctl.analysis.report import Report
    from armctl.robot.arm import Arm

OK, NOT_REACHED, WRONG_CALL = 0, 1, 2
_RUNS_A_WORKER = 6  # a process takes as long to start as a few runs
_PLANTS_HELP = "nominal, payload=1, mass=1.2, friction, delay=2, noise, ripple, continuous, all, or several joined with +"

_CHAIN_OPTIONS = {
    "--tip": "site, body or geom at the end of the chain",
    "--base": "body that the chain stands on; joints above it are held",
    "--tool": "gripper, hand or MJCF file to mount at the tip",
    "--scene": "MJCF file of what stands and lies around",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        argv: The arguments; those of the process if left out.

    Returns:
        The exit status.
    """
    args = _parser().parse_args(argv)
    warnings.showwarning = _show_warning
    try:
        return args.run(args)
    except ArmctlError as error:
        print(f"armctl: {error}", file=sys.stderr)
        return WRONG_CALL
    except BrokenPipeError:
        sys.stderr.close()
        return OK
    except OSError as error:  # such as a folder to write to that is a file
        print(f"armctl: {error.filename or 'file'}: {error.strerror or error}", file=sys.stderr)
        return WRONG_CALL
    except KeyboardInterrupt:
        print("armctl: stopped", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="armctl", description="Command robot arms in MuJoCo.")
    parser.add_argument("--version", action="version", version=f"armctl {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, run, text: str, robot: bool = True, chain: bool = True) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        sub.set_defaults(run=run)
        if robot:
            sub.add_argument("robot", help="bundled name, alias, Menagerie name, or path of an .xml or .urdf file")
        if chain:
            for option, meaning in _CHAIN_OPTIONS.items():
                sub.add_argument(option, help=meaning)
            sub.add_argument("--hold-base", action="store_true", help="hold a robot that floats or walks where its keyframe is")
        return sub

    command("robots", _robots, "list the robots that have a name", robot=False, chain=False)
    chains = command("chains", _chains, "list every serial chain of a robot: arms, legs, fingers", chain=False)
    info = command("info", _info, "show a robot's joints and limits")
    reach = command("reach", _reach, "bring the tip to a target and report")
    reach.add_argument("--target", nargs="+", metavar="N", help="x y z in m, and roll pitch yaw in rad if wanted")
    reach.add_argument("--controller", default="computed-torque", help="its name (default computed-torque)")
    reach.add_argument("--video", type=Path, metavar="FILE", help="film the run into this .mp4 or .gif")
    compare = command("compare", _compare, "follow the same motion under several controllers")
    compare.add_argument("--controllers", default="pd,computed-torque", metavar="A,B,...", help="or all (default %(default)s)")
    compare.add_argument("--plants", default="nominal", metavar="A,B,...", help=f"{_PLANTS_HELP} (default nominal)")
    compare.add_argument("--report", type=Path, metavar="DIR", help="write JSON, Markdown and an HTML page into this folder")
    compare.add_argument("--timestep", help="the tick, s (default the model's)")
    compare.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes at work (default one a core)")
    iso = command("iso9283", _iso9283, "pose and path accuracy by the standard's cycles")
    iso.add_argument("--controller", default="computed-torque-observer", help="its name (default computed-torque-observer)")
    iso.add_argument("--plant", default="noise", metavar="A+B", help=f"{_PLANTS_HELP} (default noise)")
    iso.add_argument("--identify", action="store_true", help="identify the payload first, and tell the controller")
    iso.add_argument("--cycles", type=int, default=30, help="of the five poses (default 30)")
    iso.add_argument("--timestep", help="the tick, s (default the model's)")
    simulate = command("simulate", _simulate, "hold the motors at constant controls")
    simulate.add_argument("--ctrl", nargs="+", required=True, metavar="N", help="one control a motor; torque = gear x control")
    simulate.add_argument("--seconds", default="2", help="how long, s (default 2)")
    simulate.add_argument("--plot", type=Path, metavar="PATH", help="draw the run: a picture, or a folder for it")
    view = command("view", _view, "drag the target in the browser, and the arm follows")
    view.add_argument("--controller", default="computed-torque", help="the one to begin with (default computed-torque)")
    view.add_argument("--port", type=int, default=8080, help="where to serve; the next free one if taken (default 8080)")
    view.add_argument("--host", help="serve other machines too, at this address; wants --token")
    view.add_argument("--token", help="what visitors from other machines must know, at least 8 characters")
    view.add_argument("--native", action="store_true", help="MuJoCo's own viewer instead of the browser")
    for sub in (chains, info, reach, compare, iso, simulate):
        sub.add_argument("--json", action="store_true", help="print JSON instead of text")
    for sub in (reach, compare):
        sub.add_argument("--save", type=Path, metavar="DIR", help="write logs, figures and plots into this folder")
    return parser


def _robots(args: argparse.Namespace) -> int:
    from armctl.loading.catalog import robots

    known = robots()
    width = max(map(len, known))
    for name, text in known.items():
        print(f"{name:{width}}  {text}")
    return OK


def _chains(args: argparse.Namespace) -> int:
    from dataclasses import asdict

    from armctl.analysis.describe import describe_chains
    from armctl.loading.load import chains

    found = chains(args.robot)
    _print(args, describe_chains(args.robot, found), [asdict(chain) for chain in found])
    return OK


def _info(args: argparse.Namespace) -> int:
    from armctl.analysis.describe import describe, facts

    arm = _load(args)
    print(json.dumps(facts(arm), indent=2) if args.json else describe(arm))
    return OK


def _reach(args: argparse.Namespace) -> int:
    from armctl.analysis.report import Report
    from armctl.render import film_path
    from armctl.sim.simulation import Simulation

    if args.video:
        film_path(args.video)
    simulation = Simulation(_load(args), args.controller)
    result = simulation.move_to(simulation.target if args.target is None else _target(args.target))
    if result.log is None:
        _print(args, str(result), {"ok": False, "verdict": str(result), "robot": args.robot, "controller": args.controller})
        return NOT_REACHED
    report = Report.from_log(result.log)
    _print(args, str(report), report.to_dict())
    if args.save:
        _save(report, args.save, "")
    if args.video:
        _say(simulation.record(args.video))
    return OK if result.ok and report.ok else NOT_REACHED


def _compare(args: argparse.Namespace) -> int:
    from armctl.analysis.comparison import compare, out_and_back, remarks
    from armctl.analysis.comparison_html import write_comparison
    from armctl.analysis.report import table
    from armctl.cli.plants import plant_by_name
    from armctl.control import CONTROLLERS
    from armctl.core.progress import progress_bar

    arm, timestep = _load(args), _numbers("timestep", [args.timestep])[0] if args.timestep else None
    controllers = list(CONTROLLERS) if args.controllers == "all" else _names(args.controllers)
    for name in controllers:
        if name not in CONTROLLERS:
            raise UnknownNameError.of("controller", name, CONTROLLERS)
    plants = [plant_by_name(name, arm, timestep) for name in _names(args.plants)]
    for folder in filter(None, (args.report, args.save)):
        folder.mkdir(parents=True, exist_ok=True)
    workers = min(args.workers, len(plants) * len(controllers) // _RUNS_A_WORKER + 1)
    with progress_bar("compare", len(plants) * len(controllers), "runs") as bar:
        reports = compare(arm, controllers, out_and_back(arm), plants, workers=workers, progress=lambda *_: bar.update())
    _print(args, "\n".join([*remarks(reports), table(reports)]), [r.to_dict() for r in reports])
    if args.save:
        for report in reports:
            _save(report, args.save, f"{report.controller}-" if len(plants) == 1 else f"{report.controller}-{report.plant}-")
    for path in write_comparison(reports, args.report, "All joints out and back") if args.report else []:
        _say(path)
    return OK


def _names(text: str | None) -> list[str]:
    return [word for word in (text or "").replace(" ", ",").split(",") if word]


def _iso9283(args: argparse.Namespace) -> int:
    from armctl.analysis.iso9283 import iso9283_cycles
    from armctl.cli.plants import plant_by_name
    from armctl.control import controller_by_name
    from armctl.design.identification import excitation, identify_payload
    from armctl.sim.simulation import simulate

    arm, known = (_load(args),) * 2
    plant = plant_by_name(args.plant, arm, _numbers("timestep", [args.timestep])[0] if args.timestep else None)
    if args.identify:
        found = identify_payload(arm, simulate(arm, args.controller, excitation(arm), plant))
        print(f"armctl: {found}", file=sys.stderr)
        known = found.applied_to(arm)
    figures = iso9283_cycles(arm, controller_by_name(args.controller, known), plant, cycles=args.cycles)
    _print(args, str(figures), figures.to_dict())
    return OK if figures.ok else NOT_REACHED


def _simulate(args: argparse.Namespace) -> int:
    from armctl.analysis.describe import describe_end
    from armctl.analysis.plot import ENDINGS, four_panels
    from armctl.sim.simulation import Simulation

    log = Simulation(_load(args)).apply_ctrl(_numbers("ctrl", args.ctrl), _numbers("seconds", [args.seconds])[0])
    columns = {"q": log.q, "v": log.v, "tau": log.tau}
    joints = {k: dict(zip(log.joint_names, column[-1].round(6).tolist(), strict=True)) for k, column in columns.items()}
    last = {"t": log.t[-1], **joints, "tip": log.tip[-1].round(6).tolist()}
    _print(args, describe_end(log), {"ok": not log.failure, **last, "failure": log.failure})
    if args.plot:
        picture = args.plot if args.plot.suffix in ENDINGS else args.plot / f"{args.robot.replace('/', '_')}.png"
        four_panels(log, picture)
        _say(picture)
    return NOT_REACHED if log.failure else OK


def _view(args: argparse.Namespace) -> int:
    from armctl import viewer as live
    from armctl.loading import catalog as source

    if args.host and not args.token:
        raise InputError("host: whoever finds the page could drive the arm; choose a --token for those who may")
    if args.token and not args.host:
        raise InputError("token: without --host only this machine can reach the page, and it wants no token")
    if args.native:
        live.view_natively(_load(args), args.controller)
    else:
        source.locate(args.robot)  # a wrong name is said before a browser opens
        live.view(lambda: _load(args), args.controller, port=args.port, host=args.host, token=args.token)
    return OK


def _load(args: argparse.Namespace) -> Arm:
    from armctl.loading.load import load

    return load(args.robot, tip=args.tip, base=args.base, tool=args.tool, scene=args.scene, hold_base=args.hold_base)


def _target(words: list[str]):
    from armctl.core.pose import Pose

    numbers = _numbers("target", words)
    if len(numbers) not in (3, 6):
        raise InputError(f"target: {len(numbers)} numbers given, x y z or x y z roll pitch yaw wanted")
    if abs(angle := max(numbers[3:], key=abs, default=0.0)) > math.tau:
        raise LimitError(f"target: {angle:g} rad is more than a turn; {angle:g} degrees are {math.radians(angle):.4f} rad")
    return Pose(numbers[:3], rpy=numbers[3:]) if len(numbers) == 6 else numbers


def _numbers(what: str, words: list[str]) -> list[float]:
    from armctl.core.validation import vector

    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{what}: {' '.join(words)} is no list of numbers; write them with spaces between") from None
    return vector(what, numbers).tolist()


def _print(args: argparse.Namespace, text: str, figures: object) -> None:
    print(json.dumps(figures, indent=2) if args.json else text)


def _save(report: Report, folder: Path, prefix: str) -> None:
    paths = [report.log.save(folder / f"{prefix}log.npz"), report.log.save(folder / f"{prefix}log.csv")]
    paths.append(folder / f"{prefix}report.json")
    paths[-1].write_text(json.dumps(report.to_dict(), indent=2) + "\n")
    paths.append(folder / f"{prefix}plot.png")
    report.plot(paths[-1])
    for path in paths:
        _say(path)


def _say(path: Path) -> None:
    print(f"wrote {path}", file=sys.stderr)


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    print(f"armctl: note: {message}", file=sys.stderr)
