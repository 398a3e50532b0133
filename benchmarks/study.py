"""Studies: CPU time per run and what of it is not simulation; and the file formats of a log. `python benchmarks/study.py`.

Times are CPU times of this process. Runs of the study are compared, bit by bit, with those of `simulate`, and every file is
read again and compared with the log.
"""

import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from markdown_table import markdown_table

import armctl

ROBOTS = ("panda", "ur5e", "robot_arm_3dof")
SAMPLES = 1024
CHECKED = 8
ROUNDS = 5
RESULTS = Path(__file__).parent / "results" / "study.md"


def cpu_ms(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return 1e3 * (time.process_time() - start)


def study_row(robot: str, folder: Path) -> list[str]:
    factors = {"payload": armctl.Range(0.0, 1.0), "friction": armctl.Range(0.0, 0.02), "noise": 1.0}
    study = armctl.Study("benchmark", robot=robot, controllers=["computed-torque"], factors=factors, samples=SAMPLES)
    study.runner.motion({})  # the plan is made once, however many runs there are
    log = study.runner.simulate(study.runs[0])
    without_simulation = armctl.Study.from_dict({**study.to_dict(), "name": "without-simulation"})
    without_simulation.runner.simulate = lambda run: log
    rest = cpu_ms(lambda: without_simulation.run(folder=folder)) / len(study.runs)
    runs = study.runs
    total = cpu_ms(lambda: study.run(folder=folder)) / len(runs)
    table = study.run(folder=folder).table()
    for k in range(CHECKED):
        log = armctl.simulate(study.runner.arm, "computed-torque", study.runner.motion({}), study.runner.plant(runs[k]))
        assert study.runner.figures(log)["digest"] == table["digest"][k], "a run differs from that of simulate"
    again = cpu_ms(lambda: study.run(folder=folder)) / len(runs)
    return [robot, f"{total:.1f}", f"{rest:.2f}", f"{again:.3f}", f"{10 * total:.0f}", f"{worker_megabytes(study, folder):.0f}"]


def worker_megabytes(study: armctl.Study, folder: Path) -> float:
    """The most memory of a process that makes runs."""
    few = armctl.Study.from_dict({**study.to_dict(), "name": "worker", "samples": 64})
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as executor:
        few.run(executor, folder=folder)
        return executor.submit(peak_megabytes).result()


def peak_megabytes() -> float:
    """By Linux; `getrusage` would give that of the process which started this one."""
    status = Path("/proc/self/status").read_text()
    return float(status.split("VmHWM:")[1].split()[0]) / 1024


def log_row(log: armctl.Log, path: Path) -> list[str]:
    log.save(path)
    writing = min(cpu_ms(lambda: log.save(path)) for _ in range(ROUNDS))
    size = path.stat().st_size / 1e6
    if path.suffix == ".mcap":
        return [path.suffix, f"{writing:.0f}", "", f"{size:.1f}"]
    reading = min(cpu_ms(lambda: armctl.Log.load(path)) for _ in range(ROUNDS))
    again = armctl.Log.load(path)
    assert all(np.array_equal(again.to_dict()[name], column, equal_nan=True) for name, column in log.to_dict().items())
    return [path.suffix, f"{writing:.0f}", f"{reading:.0f}", f"{size:.1f}"]


def ten_seconds() -> armctl.Log:
    arm = armctl.load("panda")
    motion = armctl.out_and_back(arm, speed=0.3)
    return armctl.simulate(
        arm, "computed-torque", motion, armctl.Plant(timestep=1e-3, encoder_noise=1e-5), 10.0 - motion.duration
    )


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        rows = [study_row(robot, Path(name) / robot) for robot in ROBOTS]
        header = [
            "robot",
            "a run, ms",
            "of it not simulation, ms",
            "found finished, ms",
            "10 000 runs, s",
            "worker process, MB",
        ]
        studies = markdown_table(header, rows)
        log = ten_seconds()
        files = [log_row(log, Path(name) / f"run{ending}") for ending in (".npz", ".parquet", ".csv", ".mcap")]
        formats = markdown_table(["file", "write, ms", "read, ms", "MB"], files)
    text = (
        f"CPU time per run of `Study.run()`: {SAMPLES} runs of computed torque, with payload, friction and noise;\n"
        "and the most memory of a worker of a `ProcessPoolExecutor`.\n\n"
        f"{studies}\n\nFiles of a log of the Panda, {len(log)} ticks at 1 kHz, {len(log.to_dict())} columns:\n\n{formats}\n"
    )
    print(text)
    if "--save" in sys.argv:
        RESULTS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
