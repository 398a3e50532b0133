"""`armctl study FILE.toml`: many runs over payloads, friction, delays and controllers, here or on a Dask cluster."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from armctl.cli import common, outputs
from armctl.core.errors import InputError, import_extra

if TYPE_CHECKING:
    from armctl.lab.study.study_result import StudyResult

_CONNECT_TIMEOUT_S = 30

_EXAMPLES = (
    "study.toml --out out",
    "study.toml --dask tcp://10.0.0.1:8786",
)


def add(commands: common.Commands) -> None:
    parser = common.add_command(
        commands, "study", run, "simulate many runs over factors and controllers; a second start continues", _EXAMPLES
    )
    parser.add_argument("file", type=Path, help="the study, a .toml file with the arguments of armctl.Study")
    parser.add_argument(
        "--folder", type=Path, default=Path(), metavar="DIR", help="folder of NAME.sqlite (default the current one)"
    )
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--threads", type=int, metavar="N", help="number of threads (default one per processor core)")
    place.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster, such as tcp://10.0.0.1:8786")
    parser.add_argument("--metric", default="tip_rms_m", help="the metric of the table and the plots (default %(default)s)")
    outputs.add_out(parser, "the table (Parquet) and plots")
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    from armctl.lab.study.study import Study

    if args.threads is not None and args.threads < 1:
        raise InputError(f"--threads: expected at least 1, got {args.threads}")
    study = Study.from_file(args.file)
    try:
        with _executor(args.dask, args.threads) as executor:
            result = study.run(executor, folder=args.folder)
    except KeyboardInterrupt:
        finished = len(study.result(args.folder))
        print(f"{finished} of {len(study.runs)} runs are finished; the same command makes the others", file=sys.stderr)
        raise
    summary = result.summary([args.metric])
    reason = "" if summary.ok else f"{summary.reason}\n\n"
    common.print_result(args, f"{reason}{summary.table().text()}", summary.to_dict(), result.reason)
    outputs.write_outputs(args, _outputs(result, args.metric))
    return common.DONE if result else common.NOT_REACHED


def _outputs(result: StudyResult, metric: str) -> list[outputs.Output]:
    """The table, and the plots that its factors allow."""
    name = result.study.name
    files = [outputs.Output(f"{name}.parquet", (), result.save)]
    numeric = result.numeric_factors
    if numeric:
        files += outputs.plot_outputs(lambda path: result.plot_quantiles(path, metric), f"{name}-quantiles")
        files += outputs.plot_outputs(lambda path: result.plot_tornado(path, metric), f"{name}-tornado")
    if len(numeric) > 1:
        files += outputs.plot_outputs(result.plot_success, f"{name}-success")
    return files


@contextmanager
def _executor(address: str | None, threads: int | None) -> Iterator[Executor | None]:
    """The executor of a Dask cluster, some threads of this process, or None for one on each processor."""
    if threads is not None:
        with ThreadPoolExecutor(threads) as executor:
            yield executor
        return
    if address is None:
        yield None
        return
    dask = import_extra("dask.distributed", "--dask needs Dask", "study")
    try:
        client = dask.Client(address, timeout=_CONNECT_TIMEOUT_S)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"--dask: {address:.80}: {error!s:.160}") from None
    with client:
        # Without pure=False Dask would take two equal chunks for one.
        yield client.get_executor(pure=False)
