"""--out: the files that a command writes, in a folder or by the ending of a name."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from armctl.report.report import Report

Writer = Callable[[Path], object]


class Output(NamedTuple):
    """Something that a command can write."""

    name: str  # of its file in a folder; empty if it is only written where a file is named
    endings: tuple[str, ...]  # of the files that hold it
    write: Writer


def add_out(parser: argparse.ArgumentParser, what: str, endings: Sequence[str] = ()) -> None:
    """Adds --out: a folder for everything, or files with some endings."""
    files = f", or a file that ends in {', '.join(endings)}; may be repeated" if endings else ""
    parser.add_argument(
        "--out", type=Path, metavar="PATH", action="append", default=[], help=f"a folder for {what.replace('%', '%%')}{files}"
    )
    parser.set_defaults(endings=tuple(endings))


def check_out(args: argparse.Namespace) -> None:
    """Makes the folders of --out; InputError for a file whose ending the command does not know, before anything runs."""
    from armctl.core.atomic import file_path

    for path in args.out:
        if not _is_folder(path, args):
            file_path("out", path, args.endings)


def make_folders(args: argparse.Namespace) -> list[Path]:
    """The folders of --out, which are made before anything runs."""
    check_out(args)
    folders = [path for path in args.out if _is_folder(path, args)]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    return folders


def write_outputs(args: argparse.Namespace, outputs: Sequence[Output]) -> None:
    """Writes to every path of --out: to a folder all that have a name, to a file what its ending stands for."""
    for path in args.out:
        if _is_folder(path, args):
            for output in outputs:
                if output.name:
                    _write(output, path / output.name)
        else:
            for output in outputs:
                if path.suffix in output.endings:
                    _write(output, path)


def report_outputs(report: Report, prefix: str = "") -> list[Output]:
    """The log of a run as numbers, its figures, and its plot as a picture and as vectors."""

    def write_figures(path: Path) -> None:
        from armctl.core.atomic import write_text

        write_text(path, json.dumps(report.to_dict(), indent=2) + "\n")

    return [
        Output(f"{prefix}log.npz", (".npz",), report.log.save),
        Output(f"{prefix}log.csv", (".csv",), report.log.save),
        Output(f"{prefix}report.json", (".json",), write_figures),
        *plot_outputs(report.plot, f"{prefix}plot"),
    ]


def plot_outputs(plot: Writer, name: str = "plot") -> list[Output]:
    """A plot as a picture and as vectors."""
    return [Output(f"{name}.png", (".png",), plot), Output(f"{name}.pdf", (".svg", ".pdf"), plot)]


def say_written(path: Path) -> None:
    """Names a file that was written, on stderr."""
    print(f"wrote {path}", file=sys.stderr)


def _is_folder(path: Path, args: argparse.Namespace) -> bool:
    return path.is_dir() or not path.suffix or not args.endings


def _write(output: Output, path: Path) -> None:
    output.write(path)
    say_written(path)
