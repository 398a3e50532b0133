"""Hostile calls of the public API: each returns or raises an `ArmctlError` with a short message.

Every parameter gets a valid value, or one of `hostile_values`. Only calls that fit the signature are made, since Python itself
refuses the others. Gains are also assigned, and then the controller runs.
"""

import copy
import enum
import inspect
import json
import math
import os
import resource
import signal
import traceback
import typing
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="pip install -e '.[envs]'")
pytest.importorskip("jax", reason="pip install -e '.[jax]'")

from arms import arm_of
from synthetic import Shape, arm_with_gripper, serial_arm

import armctl
import armctl.envs

MAX_OTHER_ERRORS_SHARE = 0.001
MAX_MESSAGE_CHARACTERS = 400
MAX_CALL_S = 300  # a call that hangs; the first call of a compiled function takes some seconds
MAX_CALL_MB = 2000.0  # by which a call raises the peak of the memory
CALLS_IN_SUITE = 1500
CALLS_PER_WORLD = 250  # then all objects are made again, since a call may have moved or spoiled them

# Not called: what opens windows, or is Python's own: abstract classes, which Python itself refuses to make, and exceptions.
LEFT_OUT = {"Controller", "CFunctionLaw", "CompiledController", "ArmctlError", "ArmctlWarning"}
# Valid values cost seconds there, so that these are called with at least one hostile value and rarely.
SLOW = {
    "compare",
    "iso9283_cycles",
    "excitation",
    "Simulation.record",
    "record",
    "still",
    "overlay",
    "four_panels",
    "JointTrajectory.plot",
    "envs.save_demonstrations",
}
PACKAGES = {"": armctl, "envs.": armctl.envs, "jax.": armctl.jax, "links.": armctl.links}
# Given in every call: their defaults take long or open a page.
ALWAYS_GIVEN = {"threads", "width", "height", "viewer"}


@dataclass(frozen=True)
class Target:
    """A public function, constructor or method, and the probability weight of its calls."""

    name: str
    call: Callable
    signature: inspect.Signature
    weight: float


@dataclass(frozen=True)
class Fault:
    """An outcome of a call that is neither an answer nor a short ArmctlError."""

    kind: str
    where: str
    why: str


@cache
def costly_results() -> dict[str, object]:
    """Results that take long to make and cannot be changed, by the name of the class."""
    arm = arm_of("robot_arm_3dof")
    excited = armctl.excitation(arm, payload=0.2)
    log = armctl.simulate(arm, "computed-torque", excited, plant=armctl.Plant(payload=0.2))
    payloads = {"payload": armctl.Range(0.0, 0.2)}
    study = armctl.Study("fuzz", robot="robot_arm_3dof", controllers=["pd"], factors=payloads, samples=2)
    with TemporaryDirectory() as folder:
        result = study.run(folder=folder, progress=False)
    return {
        "ArmEstimate": armctl.identify(arm, log),
        "Excitation": excited,
        "Margins": armctl.margins(arm, "pd", configurations=1),
        "PayloadEstimate": armctl.identify_payload(arm, log),
        "Reachability": armctl.reachability(arm, spacing=0.3, orientations=4),
        "Study": study,
        "StudyResult": result,
        "Tuning": armctl.tune(arm, "pd", configurations=1),
    }


def world() -> dict[str, object]:
    """One object of every public class with methods, by the name of the class."""
    arm = arm_of("robot_arm_3dof")
    env = armctl.envs.ArmEnv(arm, action="joint_delta")
    envs = armctl.envs.ArmVectorEnv(arm, action="joint_delta", num_envs=2)
    env.reset(seed=0)
    envs.reset(seed=0)
    with TemporaryDirectory() as folder:
        gripping = armctl.Simulation(armctl.load(arm_with_gripper(Path(folder))))
    motion = armctl.move_j(arm, arm.home, arm.home + 0.05)
    sim = armctl.Simulation(arm, "pd")
    log = armctl.simulate(arm, "pd", motion)
    setpoint = armctl.Setpoint(arm.home, np.zeros(3), np.zeros(3))
    link = armctl.links.PlantLink(arm)
    dry_run = armctl.DryRun(link)
    dry_run.open()
    hand = armctl.links.PlantLink(gripping.arm)
    hand.open()
    return {
        "Actuation": arm.actuation,
        "Admittance": armctl.Admittance(arm),
        "Arm": arm,
        "Arc": armctl.Arc([0.3, 0.1, 0.5], [0.3, 0.2, 0.5]),
        "ComputedTorque": armctl.ComputedTorque(arm),
        "ComputedTorqueLearning": armctl.ComputedTorqueLearning(arm),
        "ComputedTorqueObserver": armctl.ComputedTorqueObserver(arm),
        "ComputedTorqueQP": armctl.ComputedTorqueQP(arm),
        "DifferentialIk": armctl.DifferentialIk(arm),
        "DryRun": dry_run,
        "ElasticFeedforward": armctl.ElasticFeedforward(arm, 1e4, 0.1),
        "Envelope": armctl.Envelope("a page", arm.limits),
        "Gripper": gripping.gripper,
        "HybridForce": armctl.HybridForce(arm, {"z": 1.0}),
        "IkResult": armctl.solve_ik(arm, arm.fk(arm.home)),
        "Impedance": armctl.Impedance(arm),
        "IterativeLearning": armctl.IterativeLearning(arm, motion),
        "JointTrajectory": motion,
        "LQR": armctl.LQR(arm),
        "Limits": arm.limits,
        "Line": armctl.Line([0.3, 0.1, 0.5]),
        "Log": log,
        "LowPass": armctl.LowPass(300.0),
        "Notch": armctl.Notch(50.0),
        "Loop": armctl.linearize(arm, "pd", arm.home),
        "OnlineMotion": armctl.OnlineMotion(arm, arm.home),
        "OperationalSpace": armctl.OperationalSpace(arm),
        "PD": armctl.PD(arm),
        "PDFeedforward": armctl.PDFeedforward(arm),
        "PDGravity": armctl.PDGravity(arm),
        "Plant": armctl.Plant(payload=0.1),
        "Pose": arm.fk(arm.home),
        "Push": armctl.Push(0.0, 0.1),
        "Range": armctl.Range(0.1, 1.0),
        "Report": armctl.Report.from_log(log),
        "Scene": armctl.World().add("ball", armctl.Ball(0.02), [0.5, 0.5, 0.1]),
        "Setpoint": setpoint,
        "Simulation": sim,
        "Robot": armctl.Robot(arm, armctl.links.PlantLink(arm)),
        "State": armctl.State(setpoint.q, setpoint.v),
        "Stream": armctl.Stream(arm, arm.home),
        "Target": armctl.Target.read(arm.fk(arm.home)),
        "TorqueFilter": armctl.TorqueFilter(arm, armctl.PD(arm), armctl.Notch(50.0)),
        "TorqueRateLimit": armctl.TorqueRateLimit(arm, armctl.PD(arm), 100.0),
        "envs.ArmEnv": env,
        "envs.ArmVectorEnv": envs,
        "envs.ExpertPolicy": armctl.envs.ExpertPolicy(env),
        "jax.ArmModel": armctl.jax.arm_model(arm),
        "jax.PDGains": armctl.jax.PDGains.from_controller(armctl.PD(arm), arm.dt),
        "jax.ComputedTorqueGains": armctl.jax.ComputedTorqueGains.from_controller(armctl.ComputedTorque(arm), arm.dt),
        "jax.OperationalSpaceGains": armctl.jax.OperationalSpaceGains.from_controller(armctl.OperationalSpace(arm)),
        "jax.Reference": armctl.jax.tick_reference(motion, arm.dt, ticks=2),
        "links.Franka": armctl.links.Franka("127.0.0.1"),
        "links.Hand": armctl.links.Hand(hand),
        "links.LinkCheck": armctl.Robot(arm, armctl.links.PlantLink(arm)).check(0.1),
        "links.PlantLink": link,
        "links.SO101": feetech_link(),
        "links.Reading": link.read(),
        "links.HandReading": hand.read_hand(),
    } | costly_results()


def feetech_link() -> armctl.links.SO101:
    """A link to an arm that is not connected."""
    joints = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    rows = {name: {"id": i, "homing_offset": 0, "range_min": 0, "range_max": 4095} for i, name in enumerate(joints)}
    with TemporaryDirectory() as folder:
        file = Path(folder) / "arm.json"
        file.write_text(json.dumps(rows))
        shape = Shape(0.1, 0.3, 10.0, range="-1.9 1.9", joint='armature="0.02"', joints=5, home="0 0.3 0.6 0.3 0")
        return armctl.links.SO101(serial_arm(Path(folder), shape), "/dev/no-such-port", file)


def of_another_arm() -> list[object]:
    """Valid objects, but of an arm with another number of joints."""
    arm = arm_of("gantry")
    motion = armctl.move_j(arm, arm.home, arm.home + 0.01)
    return [arm, motion, armctl.PD(arm), armctl.simulate(arm, "pd", motion), armctl.Simulation(arm), motion(0.0), arm.limits]


def valid_values(objects: dict[str, object]) -> dict[str, list[object]]:
    """Valid values by the name of a parameter."""
    arm = arm_of("robot_arm_3dof")
    home = arm.home
    tip = arm.fk(home)
    controllers = ["pd", "computed-torque", objects["PD"]]
    names = {
        "arm": [arm],
        "arms": [[arm]],
        "robot": [arm],
        "controller": controllers,
        "controllers": [["pd"], None],
        "trajectory": [objects["JointTrajectory"]],
        "plant": [None, objects["Plant"]],
        "plants": [[objects["Plant"]]],
        "log": [objects["Log"]],
        "logs": [[objects["Log"]]],
        "reports": [[objects["Report"]]],
        "state": [objects["State"]],
        "setpoint": [objects["Setpoint"]],
        "target": [tip, tip.position, [5.0, 0.0, 0.0]],
        "targets": [[tip], [tip.position]],
        "via": [tip.position + 0.01],
        "path": ["out.npz", "out.csv", "out.png"],
        "name": ["robot_arm_3dof", "box"],
        "tips": [["end_effector"]],
        "ctrl": [[0.0, 0.0, 0.0]],
        "position": [[0.5, 0.5, 0.1]],
        "size": [[0.1, 0.1, 0.1]],
        "progress": [None],
        "viewer": [False],
        "width": [32],
        "height": [32],
        "at": [0.0],
        "cycles": [1],
        "path_cycles": [1],
        "waypoints": [[home, home + 0.1]],
        "angles": [[0.0, 0.0, 0.0]],
        "speed": [0.5, 1.0],
        "timeout": [0.1],
        "until": [lambda state: True],
        "action": [np.zeros(3)],
        "actions": [np.zeros((2, 3))],
        "episodes": [1],
        "num_envs": [1],
        "threads": [1],
        "env": [objects["envs.ArmEnv"]],
        "model": [objects["jax.ArmModel"]],
        "gains": [objects[f"jax.{law}Gains"] for law in ("PD", "ComputedTorque", "OperationalSpace")],
        "reference": [objects["jax.Reference"]],
    }
    joints = ["q", "q0", "q_start", "q_goal", "v", "qpos", "qvel", "posture", "tau", "q_current"]
    return names | {name: [home, list(home)] for name in joints}


class Odd:
    """An object whose conversions fail."""

    def __float__(self) -> float:
        raise RuntimeError("no float")

    def __array__(self, *_args, **_kwargs) -> np.ndarray:
        raise RuntimeError("no array")


def hostile_values() -> list[object]:
    numbers: list[object] = [
        math.nan,
        math.inf,
        -math.inf,
        1e308,
        -1e308,
        5e-324,
        -1.0,
        0,
        0.0,
        1,
        -1,
        2**63,
        10**400,
        1j,
        True,
        False,
    ]
    texts: list[object] = [
        "",
        "x",
        "0.1",
        "nan",
        "x" * 5000,
        "a\nb",
        "a\0b",
        "\ud800",
        "../x",
        "/nowhere/x.npz",
        "\u00e9\u4e2d",
        b"bytes",
        Path("nowhere.xml"),
    ]
    lists: list[object] = [
        [],
        [[]],
        [1],
        [1, 2],
        [1, 2, 3],
        [0.0] * 7,
        [math.nan] * 3,
        ["a", "b", "c"],
        [None] * 3,
        [[1, 2, 3]],
        (1e308,) * 3,
        [1, [2, 3]],
        [0.5] * 100_000,
    ]
    arrays: list[object] = [
        np.empty(0),
        np.zeros(3),
        np.zeros(3, int),
        np.full(3, np.nan),
        np.full(3, np.inf),
        np.zeros((3, 3)),
        np.zeros((2, 3)),
        np.eye(4),
        np.zeros((1, 1, 1)),
        np.float64(0.5),
        np.int8(1),
        np.array(1.0),
        np.array(["a", "b", "c"]),
        np.array([None, 1, "x"], object),
        np.zeros(3, complex),
        np.array(["2026-01-01"], "M8[D]"),
        np.ones(3, bool),
        np.zeros(100_000),
        np.zeros((100_000, 3)),
    ]
    objects: list[object] = [
        None,
        {},
        {"a": 1},
        set(),
        {1, 2},
        object(),
        Odd(),
        int,
        armctl.PD,
        len,
        (lambda: 1),
        range(3),
        iter([1, 2, 3]),
        slice(1),
        Ellipsis,
    ]
    return [*numbers, *texts, *lists, *arrays, *objects]


def targets(objects: dict[str, object]) -> list[Target]:
    """All public functions, constructors and methods."""
    found: list[Target] = []

    def add(name: str, call: Callable) -> None:
        slow = name in SLOW
        found.append(Target(name, call, inspect.signature(call), 0.05 if slow else 1.0))

    for prefix, package in PACKAGES.items():
        for name in package.__all__:
            value = getattr(package, name)
            if name in LEFT_OUT or not callable(value):
                continue
            if not inspect.isclass(value):
                add(prefix + name, value)
                continue
            # The options of a call and the words of an enumeration are checked by the call.
            if issubclass(value, Exception | enum.Enum) or typing.is_typeddict(value) or typing.Protocol in value.__bases__:
                continue
            add(prefix + name, value)
            owner = objects.get(prefix + name, value)
            for member in dir(value):
                defined = inspect.getattr_static(value, member)
                bound = owner is not value or isinstance(defined, classmethod | staticmethod)
                if member.startswith("_") or not bound or (issubclass(value, tuple) and member in ("count", "index")):
                    continue
                function = getattr(value, member)
                if callable(function) and not (getattr(function, "__module__", "") or "").startswith("gymnasium"):
                    add(f"{prefix}{name}.{member}", getattr(owner, member))
            if isinstance(owner, armctl.CompiledController):
                settable = [key for key in dir(value) if getattr(inspect.getattr_static(value, key), "fset", None)]
                for gain in [*(key for key in vars(owner) if not key.startswith("_")), *settable]:
                    add(f"{name}.{gain} =", assignment(owner, gain, objects["JointTrajectory"]))
    return found


def assignment(controller: armctl.CompiledController, gain: str, motion: object) -> Callable[[object], object]:
    """Assigns a gain to a copy of a controller, which then moves the arm."""

    def assign(value: object) -> object:
        other = copy.copy(controller)
        setattr(other, gain, value)
        return armctl.simulate(arm_of("robot_arm_3dof"), other, motion)

    return assign


def arguments(
    target: Target, rng: np.random.Generator, valid: dict[str, list[object]], hostile: list[object]
) -> tuple[list[object], dict[str, object]]:
    """Arguments that fit the signature; at least one of them is hostile if there is one."""
    args: list[object] = []
    kwargs: dict[str, object] = {}
    parameters = [p for p in target.signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    forced = int(rng.integers(len(parameters))) if parameters else -1
    skipped = False
    for i, parameter in enumerate(parameters):
        good = valid.get(parameter.name)
        required = parameter.default is parameter.empty and parameter.kind is not parameter.VAR_POSITIONAL
        if i != forced and not required and rng.random() < 0.7 and parameter.name not in ALWAYS_GIVEN:
            skipped = True
            continue
        if good and i != forced and rng.random() < 0.75:
            value = good[rng.integers(len(good))]
        else:
            value = hostile[rng.integers(len(hostile))]
        if parameter.kind is parameter.KEYWORD_ONLY or (skipped and parameter.kind is not parameter.VAR_POSITIONAL):
            kwargs[parameter.name] = value
        elif not (skipped and parameter.kind is parameter.VAR_POSITIONAL):
            args.append(value)
    return args, kwargs


class TooSlow(BaseException):
    """A call took longer than MAX_CALL_S."""


@contextmanager
def time_limit() -> Iterator[None]:
    """Raise TooSlow in the block after MAX_CALL_S."""

    def stop(*_: object) -> None:
        raise TooSlow

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, MAX_CALL_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def shown(target: Target, args: list[object], kwargs: dict[str, object]) -> str:
    """The call as text, shortened."""
    values = [f"{value!r:.40}" for value in args] + [f"{name}={value!r:.40}" for name, value in kwargs.items()]
    return f"{target.name}({', '.join(values)})".replace("\n", " ")


def fault_of(target: Target, args: list[object], kwargs: dict[str, object]) -> Fault | None:
    """What is wrong with a call's outcome."""
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        with warnings.catch_warnings(), time_limit():
            warnings.simplefilter("ignore")
            target.call(*args, **kwargs)
    except armctl.ArmctlError as error:
        if len(str(error)) > MAX_MESSAGE_CHARACTERS:
            return Fault("long message", target.name, f"{len(str(error))} characters: {error!s:.100}")
    except TooSlow:
        return Fault("slow", target.name, f"longer than {MAX_CALL_S} s")
    except Exception as error:
        place = ""
        for frame in traceback.extract_tb(error.__traceback__):
            if f"{os.sep}armctl{os.sep}" in frame.filename:
                place = f"{frame.filename.rpartition('armctl' + os.sep)[2]}:{frame.lineno}"
        return Fault("other error", f"{place} {type(error).__name__}", f"{error!s:.100}")
    grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb) / 1024
    if grown_mb > MAX_CALL_MB:
        return Fault("much memory", target.name, f"{grown_mb:.0f} MB")
    return None


@pytest.mark.usefixtures("no_windows")
def test_hostile_calls_raise_armctl_errors_with_short_messages(
    fuzz_cases: Callable[[int], Iterator[np.random.Generator]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    counts: Counter[str] = Counter()
    faults: dict[str, str] = {}
    for case, rng in enumerate(fuzz_cases(CALLS_IN_SUITE)):
        if case % CALLS_PER_WORLD == 0:
            objects = world()
            callables = targets(objects)
            valid = valid_values(objects)
            hostile = [*hostile_values(), *objects.values(), *of_another_arm()]
            weights = np.array([target.weight for target in callables])
        target = callables[rng.choice(len(callables), p=weights / weights.sum())]
        args, kwargs = arguments(target, rng, valid, hostile)
        fault = fault_of(target, args, kwargs)
        counts["calls"] += 1
        if fault:
            counts[fault.kind] += 1
            faults.setdefault(f"{fault.kind}: {fault.where}", f"{shown(target, args, kwargs)}: {fault.why}")
    listed = "\n".join(f"{fault}: {call}" for fault, call in sorted(faults.items()))
    summary = f"{dict(counts)}\n{listed}"
    assert counts["other error"] <= MAX_OTHER_ERRORS_SHARE * counts["calls"], summary
    assert counts["slow"] == 0, summary
    assert counts["long message"] == 0, summary
    assert counts["much memory"] == 0, summary
    print(summary)


@pytest.fixture
def no_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
