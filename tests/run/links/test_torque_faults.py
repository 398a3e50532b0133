"""An arm under a law when something goes wrong: it rests in time, keeps the bounds, and does not start again by itself."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arms import HELPERS, arm_of, some_of

import armctl
from armctl.control.interface import State
from armctl.core.trajectory import Setpoint
from armctl.run.links.link import Reading
from armctl.run.links.plant_link import PlantLink
from armctl.run.links.torque_interface import TorqueInterface

DT = 1e-3
RATE = 2000.0  # N m/s
LAWS = ["pd-gravity", "pd-feedforward", "computed-torque", "computed-torque-observer", "impedance"]
DAMPED_S = 0.5
FOLLOWED_S = 0.1  # in which a law is where the reference came to rest
REST_SPEED = 1e-2  # rad/s, as of a controller of positions that holds the arm
LOCK_BANDWIDTH = 100.0  # rad/s, of a joint that is blocked


class Broken:
    """A law that does something else after some ticks of a motion."""

    def __init__(self, arm: armctl.Arm, name: str, what: Callable[[np.ndarray], object], after: int):
        self._inner: Any = armctl.control.controller_by_name(name, arm)
        self._what = what
        self._after = after
        self._calls = 0

    def torque(self, state: State, setpoint: Setpoint) -> object:
        tau = self._inner.torque(state, setpoint)
        self._calls += bool(np.abs(setpoint.v).max() > 0.0)
        return self._what(tau) if self._calls > self._after else tau


class Watched(PlantLink):
    """A robot that keeps what it is sent and how fast it is, and does something at a row."""

    def __init__(self, arm: armctl.Arm, row: int, event: Callable[["Watched"], None] | None = None, **options: Any):
        super().__init__(arm, torque=TorqueInterface(arm.limits.tau_max, rate_max=RATE, delay=0.0), **options)
        self.row = row
        self.event = event
        self.blind = False  # whether its encoders fail
        self.is_damped: Callable[[], bool] = lambda: False  # whether the law has been ended
        self.damped = 0  # rows since then
        self.torques: list[np.ndarray] = []
        self.speeds: list[float] = []

    def wait(self) -> tuple[int, Reading]:
        event = self.event
        if self.sent == self.row and event is not None:
            self.event = None
            event(self)
        ticks, reading = super().wait()
        self.speeds.append(float(np.abs(reading.v).max()))
        return ticks, reading._replace(q=np.full_like(reading.q, np.nan)) if self.blind else reading

    def send_torques(self, tau: np.ndarray, last: bool) -> None:
        self.torques.append(np.array(tau))
        self.damped += self.is_damped()
        super().send_torques(tau, last)


def raises(tau: np.ndarray) -> object:
    raise ZeroDivisionError("nothing to divide by")


LAWS_THAT_BREAK: dict[str, Callable[[np.ndarray], object]] = {
    "raises": raises,
    "is not a number": lambda tau: np.where(np.arange(len(tau)) == 1, np.nan, tau),
    "is too strong": lambda tau: tau + 1e6,
    "turns": lambda tau: -tau,
    "is nothing": lambda tau: None,
}
KINDS = ["stop", "Ctrl-C", "blocked", "pushed", "encoders", "reflex", "lost", "interrupted", *LAWS_THAT_BREAK]


def blocked(arm: armctl.Arm, joint: int, t0: float) -> Callable[[np.ndarray, np.ndarray, float], np.ndarray]:
    """The torque of a stop that takes a joint where it is at t0, s."""
    inertia = np.diag(arm.mass_matrix(arm.home))[joint]
    place: list[float] = []

    def torque(q: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        tau = np.zeros(arm.n)
        if t >= t0:
            place.append(q[joint])
            tau[joint] = inertia * (LOCK_BANDWIDTH**2 * (place[0] - q[joint]) - 2.0 * LOCK_BANDWIDTH * v[joint])
        return tau

    return torque


def interrupt(link: Watched) -> None:
    raise KeyboardInterrupt


def lose_encoders(link: Watched) -> None:
    link.blind = True


def ramp(robot: armctl.Robot, speed: float) -> float:
    """s, in which a plan within the robot's limits brakes from a speed of rad/s."""
    limits = robot.arm.limits
    return float((speed / limits.a_max).max() + (limits.a_max / limits.j_max).max())


def speed_later(link: Watched) -> float:
    """rad/s, after 0.3 s, in which a maker may stop the arm by itself."""
    link._pass(300)
    q = link.read().q
    link._pass(10)
    return float(np.abs(link.read().q - q).max() / (11 * DT))


def robot_with(kind: str, rng: np.random.Generator, row: int) -> tuple[armctl.Robot, Watched, np.ndarray]:
    """A robot under a law, to which something happens at a row; its link, and a goal."""
    arm = arm_of("robot_arm_3dof")
    law: Any = str(rng.choice(LAWS))
    error_max = 0.1 if law == "impedance" else None
    plant = armctl.Plant(continuous=True, timestep=DT)
    events = {"Ctrl-C": interrupt, "encoders": lose_encoders}
    options: dict[str, Any] = {}
    joint = int(rng.integers(3))
    goal = arm.home + np.array([0.9, 0.4, -0.6]) * rng.choice([-1.0, 1.0], 3)
    if kind in LAWS_THAT_BREAK:
        law = Broken(arm, law, LAWS_THAT_BREAK[kind], row)
    elif kind == "blocked":
        plant = replace(plant, joint_torque=blocked(arm, joint, DT * row))
        goal[joint] = arm.home[joint] + np.sign(goal[joint] - arm.home[joint]) * 0.9
    elif kind == "pushed":
        plant = replace(plant, pushes=(armctl.Push(start=DT * row, duration=0.4, force=tuple(rng.choice([-250, 250], 3))),))
    elif kind == "reflex":
        options["faults"] = {row: "cartesian_reflex"}
    elif kind in ("lost", "interrupted"):
        options["lost"] = {row: int(rng.integers(16, 20)) if kind == "lost" else 60}
    link = Watched(arm, row, events.get(kind), plant=plant, **options)
    robot = armctl.Robot(arm, link, controller=law, speed=0.5, tip_speed=1.0, error_max=error_max)
    link.is_damped = lambda: bool(robot._host._torques.fault)
    if kind == "stop":
        link.event = lambda link: robot._host.stop("enough")
    return robot, link, goal


@pytest.mark.parametrize("seed", some_of(range(100), few=(0, 2, 4), full=range(20)))
def test_whatever_happens_the_arm_rests_in_time_within_the_bounds_and_the_fault_stays(seed: int):
    rng = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    row = int(rng.integers(60, 500))
    robot, link, goal = robot_with(kind, rng, row)
    reason = ""
    try:
        reason = robot.move_j(goal).reason
    except KeyboardInterrupt:
        assert kind == "Ctrl-C"
    assert speed_later(link) < REST_SPEED
    torques = np.array(link.torques)
    assert np.abs(np.diff(torques, axis=0)).max() <= RATE * DT
    assert (np.abs(torques) <= robot.arm.limits.tau_max).all()
    if kind in ("stop", "Ctrl-C"):
        assert robot.log is not None
        speeds = np.abs(np.diff(robot.log.q_ref, axis=0)).max(axis=1) / DT
        fastest = int(np.flatnonzero(speeds > 0.999 * speeds.max())[-1])  # after an acceleration that was not over
        at_rest = int(np.flatnonzero(np.array(link.speeds) > REST_SPEED)[-1])
        assert at_rest - max(fastest, row) <= (1.05 * ramp(robot, float(speeds.max())) + FOLLOWED_S) / DT
        assert robot.fault == ""
        assert robot.move_j(robot.arm.home), robot.fault
        return
    assert robot.fault
    assert robot.fault == reason
    assert link.damped <= DAMPED_S / DT
    assert (link.damped > 0) == (kind != "reflex")  # there the robot itself does what is left
    sent = link.sent
    assert robot.move_j(robot.arm.home).reason == f"{reason}; call robot.recover() when the robot may move again"
    assert link.sent == sent
    link.blind = False
    robot.recover()
    assert robot.fault == ""


PLANNER = f"""
import sys
sys.path.insert(0, {str(HELPERS)!r})
import numpy as np
import armctl
from recorded_plant import RecordedPlant
arm = armctl.load("robot_arm_3dof")
torque = armctl.links.TorqueInterface(arm.limits.tau_max, rate_max={RATE}, delay=0.0)
plant = armctl.Plant(timestep={{dt}}, continuous=True)
link = RecordedPlant(arm, sys.argv[1], torque=torque, plant=plant)
with armctl.Robot(arm, link, controller="computed-torque", speed=0.5, tip_speed=1.0) as robot:
    print("ready", flush=True)
    {{program}}
"""
PLANNER_DT = 2e-3  # s
GOAL = [1.2, 0.3, -1.0]
FOLLOWING = """
    import time
    center = robot.tip.position
    def target(t):
        time.sleep(0.7 if t > 0.3 else 0.0)
        return center + 0.1 * np.sin([0.0, 2.0 * t, t])
    robot.follow(target, duration=3.0)
"""


def recorded(path: Path) -> np.ndarray:
    """The rows of a record."""
    return np.fromfile(path).reshape(-1, 10) if path.exists() else np.zeros((0, 10))


@pytest.mark.full
@pytest.mark.parametrize("how", ["killed", "stopped", "slowed"])
def test_without_a_planner_a_law_follows_the_path_to_rest(tmp_path: Path, how: str):
    path = tmp_path / "rows"
    program = FOLLOWING if how == "slowed" else f"robot.move_j({GOAL})"
    text = PLANNER.format(dt=PLANNER_DT, program=program)
    with subprocess.Popen([sys.executable, "-c", text, str(path)], stdout=subprocess.PIPE, text=True) as planner:
        assert planner.stdout is not None
        assert planner.stdout.readline() == "ready\n"
        deadline = time.monotonic() + 30.0
        while len(recorded(path)) < 60 and time.monotonic() < deadline:
            time.sleep(0.01)
        if how != "slowed":
            planner.send_signal(signal.SIGKILL if how == "killed" else signal.SIGSTOP)
        count = -1
        while count != len(recorded(path)) and time.monotonic() < deadline:
            count = len(recorded(path))
            time.sleep(0.3)
        planner.kill()
    rows = recorded(path)
    ticks = np.rint(rows[:, 0] / PLANNER_DT)
    q = rows[:, 1:4]
    v = rows[:, 4:7]
    tau = rows[:, 7:]
    assert len(rows) == count > 60
    assert np.abs(v[-1]).max() < REST_SPEED
    assert np.abs(v).max() > 0.1
    assert (np.abs(np.diff(tau, axis=0)) <= RATE * PLANNER_DT * np.diff(ticks)[:, None]).all()
    if how != "slowed":
        start = arm_of("robot_arm_3dof").home
        way = np.array(GOAL) - start
        along = (q - start) @ way / (way @ way)
        assert 0.01 < along[-1] < 0.95
        assert np.abs(q - start - along[:, None] * way).max() < 5e-3
