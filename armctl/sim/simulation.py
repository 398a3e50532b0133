"""Simulation: the only object that changes in time. An arm in its scene, commanded in three lines."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.control import ComputedTorque, Controller, State, controller_by_name
from armctl.core import hooks
from armctl.core.errors import InputError, LimitError
from armctl.core.log import Log
from armctl.core.pose import Pose
from armctl.core.trajectory import TickReference, Trajectory, check_motion
from armctl.core.validation import Array, instance, number, vector
from armctl.loading.load import load
from armctl.mjmodel.target_marker import TARGET
from armctl.robot.arm import Arm, check_arm
from armctl.sim.gripper import Gripper
from armctl.sim.moves import Moves
from armctl.sim.plant import NOMINAL, Plant
from armctl.sim.recorder import Recorder, ticks_for
from armctl.sim.stepper import ConstantTorque, Stepper

_IDLE = 4  # steppers kept for the next run


class Simulation(Moves):
    """An arm in its scene, with a controller, commanded in Cartesian or joint targets.

    Attributes:
        arm: The arm as its controller knows it.
        controller: What makes the torques.
        plant: How the simulated arm differs.
        model: The plant's MuJoCo model.
        data: Its MjData; read it freely.
        log: The last run, or None.
        viewer: The page it is seen on, or None.
    """

    def __init__(
        self, robot: Arm | str, controller: Controller | str | None = None, plant: Plant | None = None, *, viewer: bool = False
    ):
        """A simulation with the arm at home, at rest.

        Args:
            robot: An arm, or a name for `armctl.load`.
            controller: A controller or the name of one; computed torque if left out.
            plant: How reality differs from the model; in nothing if left out.
            viewer: Whether a page in the browser shows all that it does, in real time.

        Raises:
            InputError: The controller has no method `torque`.
            UnknownNameError: There is no such robot or controller.
            ModelError: The robot's model is no arm.
        """
        self.arm = robot if isinstance(robot, Arm) else load(robot)
        if isinstance(controller, str):
            controller = controller_by_name(controller, self.arm)
        self.controller = ComputedTorque(self.arm) if controller is None else controller
        self.plant = _checked(self.controller, plant)
        self.log: Log | None = None
        self.viewer = hooks.open_viewer(self.arm) if viewer and hooks.open_viewer is not None else None
        self._stepper = Stepper(self.arm, self.plant, self.viewer)
        self._gripper: Gripper | None = None
        self.model, self.data = self._stepper.model, self._stepper.data

    @property
    def dt(self) -> float:
        """The tick, s: the plant's step and the control period."""
        return self._stepper.dt

    @property
    def state(self) -> State:
        """The arm's state now."""
        return self._stepper.state

    @property
    def tip(self) -> Pose:
        """Where the simulated tip is now, T_world_tip."""
        return self._stepper.tip

    @property
    def target(self) -> Array:
        """(3,) m, where the green target is now."""
        return self.data.xpos[mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, TARGET)].copy()

    @property
    def gripper(self) -> Gripper:
        """The gripper behind the arm's tip, found when it is first asked for."""
        self._gripper = self._gripper or Gripper(self._stepper, lambda seconds: self._stepper.hold(self.controller, seconds))
        return self._gripper

    def reset(self, q: ArrayLike | None = None, v: ArrayLike | None = None) -> None:
        """Starts afresh at t = 0.

        Args:
            q: (n,) rad where the arm is; home if left out.
            v: (n,) rad/s how it moves; at rest if left out.

        Raises:
            InputError: A wrong length or a number that is not finite.
        """
        if self._gripper is not None:
            self._gripper.reset()
        self._stepper.reset(self.arm.home if q is None else q, np.zeros(self.arm.n) if v is None else v)

    def run(self, trajectory: Trajectory, settle: float = 0.0) -> Log:
        """Follows a trajectory, starting now.

        Args:
            trajectory: The motion; it should start where the arm is.
            settle: s to go on holding its end.

        Returns:
            Every tick of it. A run that diverges ends early, and `log.failure` says why.

        Raises:
            InputError: It is no motion, or the settling time is negative.
            SimulationError: The controller failed; `error.log` holds what there was until then.
        """
        check_motion(trajectory, self.arm.joint_names)
        self.log = _run(self._stepper, self.controller, trajectory, settle)
        return self.log

    def apply_ctrl(self, ctrl: ArrayLike, seconds: float) -> Log:
        """Holds the arm's motors at constant controls, without a controller.

        Args:
            ctrl: (n,) controls, in the units of the model's motors: torque = gear x ctrl.
            seconds: How long, s.

        Returns:
            Every tick of it; its references are NaN.

        Raises:
            InputError: A wrong length, a number that is not finite, or a negative time.
            LimitError: A control outside its motor's range.
        """
        ctrl, bound = vector("ctrl", ctrl, self.arm.n), self.arm.limits.tau_max / np.abs(self.arm.gear)
        outside = np.abs(ctrl) > bound * (1 + 1e-9)
        if outside.any():
            i = int(outside.argmax())
            raise LimitError(f"ctrl: {self.arm.joint_names[i]}: {ctrl[i]:g} is outside [{-bound[i]:g}, {bound[i]:g}]")
        nothing = np.full((ticks_for(number("seconds", seconds, 0.0), self.dt), self.arm.n), np.nan)
        recorder, started, constant = Recorder(self.arm), time.perf_counter(), ConstantTorque(ctrl * self.arm.gear)
        self._stepper.follow(constant, TickReference(*[nothing] * 5), recorder)
        return self._logged(recorder, seconds, np.full(7, np.nan), started, constant)

    def record(self, path: str | os.PathLike[str], **options: Any) -> Path:
        """Films the last run: the arm, the target, and the way of the tip.

        Args:
            path: The film, .mp4 or .gif; its folder is made.
            **options: width, height, quality and speed, as for `armctl.render.record`.

        Returns:
            The path.

        Raises:
            InputError: Nothing has run yet, or the path has another ending.
        """
        if self.log is None:
            raise InputError("log: nothing has run yet, so there is nothing to film; move first")
        from armctl.render.video import record  # cameras and encoders are loaded when a film is made

        return record(self.log, self.arm, path, **options)


def simulate(
    arm: Arm, controller: Controller | str, trajectory: Trajectory, plant: Plant | None = None, settle: float = 0.25
) -> Log:
    """Follows a trajectory from its start, in a simulation of its own.

    Args:
        arm: The arm.
        controller: A controller or the name of one.
        trajectory: The motion.
        plant: How reality differs from the model; in nothing if left out.
        settle: s to go on holding its end.

    Returns:
        Every tick of it. A run that diverges ends early, and `log.failure` says why.

    Raises:
        InputError: An argument of the wrong kind.
        UnknownNameError: There is no such controller.
        SimulationError: The controller failed; `error.log` holds what there was until then.
    """
    check_arm(arm)
    controller = controller_by_name(controller, arm) if isinstance(controller, str) else controller
    plant = _checked(controller, plant)
    check_motion(trajectory, arm.joint_names)
    with _rig_for(arm, plant) as stepper:
        start = trajectory(0.0)
        stepper.reset(start.q, start.v)
        return _run(stepper, controller, trajectory, settle)


def _checked(controller: object, plant: Plant | None) -> Plant:
    """The plant, once controller and plant are what they should be."""
    if isinstance(controller, type) or not callable(getattr(controller, "torque", None)):
        raise InputError(f"controller: {controller!r} has no method torque(state, setpoint); armctl.PD(arm) has")
    plant = NOMINAL if plant is None else plant
    instance("plant", plant, Plant, "armctl.Plant(payload=1.0) is one")
    return plant


_idle: dict[tuple[Arm, Plant], Stepper] = {}


@contextmanager
def _rig_for(arm: Arm, plant: Plant) -> Iterator[Stepper]:
    """A stepper of an arm and a plant for one run. The last ones are kept: to copy a model takes as long as a second of it."""
    stepper = _idle.pop((arm, plant), None) or Stepper(arm, plant)
    try:
        yield stepper
    finally:
        _idle[arm, plant] = stepper
        for oldest in list(_idle)[:-_IDLE]:
            _idle.pop(oldest, None)


def _run(stepper: Stepper, controller: Controller, trajectory: Trajectory, settle: float) -> Log:
    recorder, started = Recorder(stepper.arm), time.perf_counter()
    ticks = ticks_for(trajectory.duration + number("settle", settle, 0.0), stepper.dt)
    stepper.follow(controller, stepper.reference(trajectory, ticks), recorder)
    return stepper.log(controller, recorder, trajectory.duration, np.full(7, np.nan), time.perf_counter() - started)
