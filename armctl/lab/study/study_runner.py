"""StudyRunner: everything that the runs of a study share, and a run. Workers make it from plain data and keep it."""

import hashlib
import importlib
import json
import math
import sys
import threading
import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pinocchio

from armctl.control import CONTROLLERS
from armctl.control.interface import Controller
from armctl.core.errors import ArmctlError, ArmctlWarning, InputError, ModelError, UnknownNameError
from armctl.core.log import Log
from armctl.core.validation import Array, number
from armctl.lab.comparison import out_and_back
from armctl.lab.study.factors import Point
from armctl.model.arm.arm import Arm
from armctl.model.loading.load import load
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.report.report import Report
from armctl.run.sim.mujoco_library import release_loading_memory
from armctl.run.sim.plant import PLANT_ATTRIBUTES, Plant
from armctl.run.sim.plant_attribute import Kind
from armctl.run.sim.simulate import simulate

FIGURES = (
    "joint_rms_rad",
    "joint_max_rad",
    "joint_rms_m",
    "joint_max_m",
    "tip_rms_m",
    "tip_max_m",
    "final_tip_error_m",
    "final_orientation_error_rad",
    "settling_time_s",
    "overshoot_m",
    "peak_torque_ratio",
    "saturated_fraction",
    "chatter_nm",
    "duration_s",
)
CONTROLLER_FACTOR = "controller."  # begins the name of a factor that is an argument of the controllers
PLANT_FACTORS = tuple(name for name, attribute in PLANT_ATTRIBUTES.items() if attribute.is_factor)
_NOISE_RAD = 1e-5  # of encoders, for noise = 1
_NOISE_RAD_S = 1e-3
OTHER_FACTORS = {
    "friction": "Coulomb friction as a fraction of the torque limits, and half as much viscous friction per rad/s",
    "noise": "noise of measurements, times 1e-5 rad and 1e-3 rad/s",
    "speed": "fraction of the full speed of the motion",
    "target": "tip position, m, and for 7 numbers orientation, wxyz, for motion = 'reach'",
}
_KEPT_MOTIONS = 256
_KEPT_CONTROLLERS = 64
# What physics depends on; meshes and textures do not enter.
_MODEL_ARRAYS = ("body_", "jnt_", "dof_", "geom_", "tendon_", "eq_", "actuator_", "qpos0")


class StudyRun(NamedTuple):
    """One run as plain data."""

    key: str  # identifies the run and the versions it is made with
    controller: str  # the label of the controller
    point: Point  # the values of the factors
    repeat: int  # the number of the repetition, from 0
    seed: int  # the seed of its noise. It does not depend on the controller.


Outcome = dict[str, Any]  # "ok", "reason", "completed", the figures, "contacts", "digest"


class StudyRunner:
    """The arm, the motions and the controllers of a study. Threads may share it."""

    def __init__(self, setup: Mapping[str, Any]):
        """Loads the arm of `Study.setup`. Raises ArmctlError if that fails, or another robot has its name here."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ArmctlWarning)  # they were shown when the study was defined
            self.arm: Arm = load(**setup["robot"])
        self.digest = model_digest(self.arm)
        if setup.get("versions", versions()) != versions():
            raise ModelError(
                f"a worker has {versions()}, but the study was started with {setup['versions']}; install the same there"
            )
        if setup.get("model", self.digest) != self.digest:
            raise ModelError(f"{self.arm.name}: its model on this machine differs from that of the study")
        self._motion = setup["motion"]
        self._controllers = setup["controllers"]
        self._dwell = setup["dwell"]
        self._tolerance = setup["tolerance"]
        self._motions: dict[tuple[Any, Any], JointTrajectory] = {}
        self._own = threading.local()  # controllers have a memory, so each thread has its own

    def simulate(self, run: StudyRun) -> Log:
        """All ticks of one run. Raises ArmctlError if a value of a factor is impossible, or the controller failed."""
        return simulate(self.arm, self.controller(run), self.motion(run.point), self.plant(run), self._dwell)

    def outcomes(self, runs: Sequence[StudyRun]) -> list[Outcome]:
        return [self.outcome(run) for run in runs]

    def outcome(self, run: StudyRun) -> Outcome:
        """Makes one run. A run that fails has an outcome with the reason."""
        try:
            log = self.simulate(run)
        except ArmctlError as error:
            return failed_outcome(str(error))
        except Exception as error:  # a caller's controller may raise anything when it is made
            return failed_outcome(f"{type(error).__name__}: {error!s:.200}")
        return self.figures(log)

    def figures(self, log: Log) -> Outcome:
        """The outcome of a run from its ticks. One that ended early has no figures: they would be of its beginning only."""
        if not len(log):
            return failed_outcome(log.failure)
        report = Report.from_log(log, self._tolerance)
        completed = not log.failure
        values = {name: float(getattr(report, name)) for name in FIGURES}
        return {
            "ok": report.ok,
            "completed": completed,
            "reason": report.reason,
            **{name: value if completed and math.isfinite(value) else None for name, value in values.items()},
            "contacts": len(report.contacts),
            "digest": hashlib.blake2b(log.q.tobytes() + log.tau_cmd.tobytes(), digest_size=8).hexdigest(),
        }

    def plant(self, run: StudyRun) -> Plant:
        values: dict[str, Any] = {name: value for name, value in run.point.items() if name in PLANT_FACTORS}
        if "friction" in run.point:
            friction = number("friction", run.point["friction"], 0.0) * self.arm.limits.tau_max
            values = {"coulomb_friction": friction, "viscous_friction": 0.5 * friction, **values}
        if "noise" in run.point:
            noise = number("noise", run.point["noise"], 0.0)
            values = {"encoder_noise": noise * _NOISE_RAD, "velocity_noise": noise * _NOISE_RAD_S, **values}
        return Plant(seed=run.seed, **values)

    def check_plant(self, run: StudyRun) -> None:
        """Raises InputError if a value of a factor is impossible for this arm."""
        plant = self.plant(run)
        for name, attribute in PLANT_ATTRIBUTES.items():
            given = np.size(getattr(plant, name))
            if attribute.kind is Kind.PER_JOINT and given not in (1, self.arm.n):
                raise InputError(f"{name}: expected 1 or {self.arm.n} numbers for {self.arm.name}, got {given}")

    def motion(self, point: Point) -> JointTrajectory:
        which = (point.get("target"), point.get("speed"))
        motion = self._motions.get(which)
        if motion is None:
            motion = self._planned(point)
            if len(self._motions) >= _KEPT_MOTIONS:
                self._motions.clear()
            self._motions[which] = motion
        return motion

    def _planned(self, point: Point) -> JointTrajectory:
        speed = number("speed", point.get("speed", 1.0), 1e-3, 1.0)
        kind = self._motion["kind"]
        if kind == "out-and-back":
            return out_and_back(self.arm, self._motion["distance"], speed=speed)
        if kind == "reach":
            target = np.asarray(point["target"])
            solution = solve_ik(self.arm, target)
            if not solution:
                raise InputError(f"target: {target.round(4).tolist()}: {solution.reason}")
            return move_j(self.arm, self.arm.home, solution.q, speed=speed)
        if tuple(self._motion["joint_names"]) != self.arm.joint_names:
            raise InputError(f"motion: it is for the joints {', '.join(self._motion['joint_names']):.120}")
        knots: Array = np.array(self._motion["knots"])
        coefficients: Array = np.array(self._motion["coefficients"])
        motion = JointTrajectory(
            knots=knots,
            coefficients=coefficients,
            joint_names=self.arm.joint_names,
            limits=self.arm.limits,
            units=self.arm.units,
        )
        return motion if speed == 1.0 else motion.scaled(speed)

    def controller(self, run: StudyRun) -> Controller:
        """The controller of a run, one for each thread."""
        arguments = {
            name.removeprefix(CONTROLLER_FACTOR): value
            for name, value in run.point.items()
            if name.startswith(CONTROLLER_FACTOR)
        }
        kept = vars(self._own)
        which = repr((run.controller, arguments))
        if which not in kept:
            if len(kept) >= _KEPT_CONTROLLERS:
                kept.clear()
            kept[which] = make_controller(run.controller, {**self._controllers[run.controller], **arguments}, self.arm)
        return kept[which]


def make_controller(label: str, spec: Mapping[str, Any], arm: Arm) -> Controller:
    """A controller: its name in `CONTROLLERS` or "module:Class" under "controller" in `spec`, the rest are arguments."""
    name = spec["controller"]
    make = _imported(name) if ":" in name else CONTROLLERS.get(name)
    if make is None:
        raise UnknownNameError.from_known("controller", name, CONTROLLERS)
    arguments = {key: value for key, value in spec.items() if key != "controller"}
    try:
        return make(arm, **arguments)
    except TypeError as error:
        raise InputError(f"controllers: {label}: {name} cannot be made with {arguments!r:.120}: {error!s:.120}") from None


def _imported(name: str) -> Any:
    module, _, attribute = name.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except Exception as error:  # a caller's module may raise anything
        raise InputError(f"controllers: {name!r:.80} cannot be imported ({type(error).__name__}: {error!s:.120})") from None


_runners_lock = threading.Lock()


@lru_cache(maxsize=2)
def _kept_runner(setup: str) -> StudyRunner:
    runner = StudyRunner(json.loads(setup))
    release_loading_memory()  # there may be many workers on a machine
    return runner


def run_chunk(setup: str, runs: Sequence[StudyRun]) -> list[Outcome]:
    """Makes runs, in a worker. Equal runs have equal bits, whichever worker makes them, in whichever order."""
    with _runners_lock:
        runner = _kept_runner(setup)
    return runner.outcomes(runs)


def failed_outcome(reason: str) -> Outcome:
    """The outcome of a run that was not completed."""
    figures = dict.fromkeys(FIGURES)
    return {"ok": False, "completed": False, "reason": reason, **figures, "contacts": 0, "digest": ""}


def versions() -> str:
    """The versions of everything that decides about the bits of a run; of armctl with a digest of its source."""
    armctl = sys.modules["armctl"]  # the package's own front, which imports from all layers, only has the number
    packages = {"mujoco": mujoco, "pinocchio": pinocchio, "numpy": np}
    others = [f"{name} {package.__version__}" for name, package in packages.items()]
    return " ".join([f"armctl {armctl.__version__} ({_source_digest()})", *others])


@lru_cache(maxsize=1)
def _source_digest() -> str:
    """Between two releases the version stays the same while the source changes."""
    digest = hashlib.blake2b(digest_size=4)
    package = Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def model_digest(arm: Arm) -> str:
    digest = hashlib.blake2b(digest_size=16)
    arrays = [getattr(arm.model, name) for name in sorted(dir(arm.model)) if name.startswith(_MODEL_ARRAYS)]
    for array in (*arrays, *vars(arm.limits).values(), arm.home):
        digest.update(array.tobytes())
    return digest.hexdigest()
