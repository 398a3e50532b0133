"""SimulatedArm: an arm on a simulated plant, with what only a simulation can do."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.interface import Controller, State, traits
from armctl.core.errors import ArmctlWarning, InputError
from armctl.core.log import Log
from armctl.core.trajectory import Setpoint, TickReference, Trajectory, check_motion
from armctl.core.validation import Array, vector
from armctl.model.arm.arm import Arm
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.run.execution.contact_reaction import ContactReaction
from armctl.run.execution.move import ControlledArm, RunPurpose
from armctl.run.execution.recorder import Recorder, TickRows
from armctl.run.sim.stepper import Stepper

START_TOLERANCE = 1e-3  # rad (m), between the start of a motion and the arm; such a step is no more than a move's tolerance
START_SPEED_TOLERANCE = 1e-3  # rad/s (m/s), beside what the arm's acceleration changes in a tick
_STEP_ROWS = 1024  # ticks for which memory is allocated at once while a caller steps


class ConstantTorque:
    """A controller that returns the same torque, (n,) N m, at every tick, for open-loop runs."""

    name = "constant"

    def __init__(self, tau: Array):
        self.tau = tau

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        return self.tau


class SimulatedArm(ControlledArm):
    """An arm in a simulation, with a controller; it can react to contacts."""

    reaction: ContactReaction | None = None

    def __init__(self, arm: Arm, controller: Controller, stepper: Stepper):
        super().__init__(arm, controller, stepper)
        self.stepper = stepper
        self._steps: _StepRecording | None = None

    @property
    def log(self) -> Log | None:
        if self._steps is not None and self._steps.recorder.size != self._steps.logged:
            self._keep_step_log(self._steps)
        return self._log

    def reset(self, q: ArrayLike | None = None, v: ArrayLike | None = None) -> None:
        """Sets time to 0 and the joints to q and v; home and rest by default. LimitError far outside the limits."""
        if q is not None:
            q = vector("q", q, self.arm.n)
            self.arm.check_units("q", q)
        self.stepper.reset(q, v)
        if self._steps is not None:
            self._log = self.log
            self._steps = None

    def run(self, trajectory: Trajectory, dwell: float, until_rest: bool = False) -> Log:
        """As every run. InputError for a planned way that begins elsewhere, LimitError for one far outside the limits."""
        check_motion(trajectory, self.arm.joint_names)
        self._check_start(trajectory)
        if isinstance(trajectory, JointTrajectory):
            self._check_end(trajectory)
        return super().run(trajectory, dwell, until_rest)

    def _check_start(self, trajectory: Trajectory) -> None:
        """Compares the start of a motion with where the arm is, and where its last reference ended."""
        arm = self.arm
        start = trajectory(0.0)
        q = np.asarray(start.q, dtype=np.float64)
        arm.check_units("trajectory", q)
        v = np.asarray(start.v, dtype=np.float64)
        q_now = self.stepper.q
        v_now = self.stepper.v
        q_ref = self.stepper.q_ref
        if (q == q_now).all() and (q == q_ref).all() and (v == v_now).all():  # as after a reset to it
            return
        here = np.stack([q_now, q_ref])
        gap = _outside(q, here)
        if gap.max() > START_TOLERANCE:
            i = int(gap.argmax())
            _elsewhere(
                trajectory,
                f"trajectory: it begins with {arm.joint_names[i]} at {q[i]:.4g} {arm.units[i]}, {gap[i]:.2g} {arm.units[i]} "
                f"from where the arm is, {here[0, i]:.4g} {arm.units[i]}; plan it from sim.state.q, call sim.reset(q=start) "
                "before, or use armctl.simulate, which starts where the motion does",
            )
        speed = _outside(v, np.stack([v_now, np.zeros(arm.n)]))
        over = speed > arm.limits.a_max * self.stepper.dt + START_SPEED_TOLERANCE
        if over.any():
            i = int(over.argmax())
            _elsewhere(
                trajectory,
                f"trajectory: it begins with {arm.joint_names[i]} moving at {v[i]:.4g} {arm.units[i]}/s, but the arm moves at "
                f"{v_now[i]:.4g} {arm.units[i]}/s; plan it from the arm's state, or use armctl.simulate",
            )

    def _check_end(self, trajectory: JointTrajectory) -> None:
        """Warns of a motion that ends moving: its reference stops dead."""
        arm = self.arm
        v = np.abs(trajectory(trajectory.duration).v)
        over = v > arm.limits.a_max * self.stepper.dt + START_SPEED_TOLERANCE
        if over.any():
            i = int(over.argmax())
            warnings.warn(
                ArmctlWarning(
                    f"trajectory: it ends with {arm.joint_names[i]} moving at {v[i]:.3g} {arm.units[i]}/s, where the reference "
                    f"stops dead, beyond the limit of acceleration; end it at rest: motion.stopped_at(t), or motion.then(...) "
                    "with armctl.move_j(arm, motion(motion.duration), goal)"
                ),
                stacklevel=4,
            )

    def _run(self, trajectory: Trajectory, reference: TickReference, recorder: Recorder) -> None:
        if self.reaction is None:
            super()._run(trajectory, reference, recorder)
            return
        stepper = self.stepper
        contact = self.reaction.run(
            self.controller, trajectory, reference, recorder, stepper.run, lambda: stepper.motor_torque, stepper.state
        )
        stepper.failure = stepper.failure or contact

    def step(self, torque: Array | None) -> State:
        """The measured state after one tick, with a torque or with its controller at the last reference."""
        self.resume()
        if self._steps is None:
            self._log = None
            self._steps = _StepRecording(self.stepper)
        steps = self._steps
        controller = self.controller if torque is None else ConstantTorque(torque)
        try:
            self.stepper.step(controller, steps.next_rows(controller, holds=torque is None))
        except BaseException as error:
            self._keep_step_log(steps, error)
            raise
        return self.stepper.measured_state

    def _check_log(self, log: Log) -> None:
        """Warns if a link touched something in front of a sensor: its controller knows only a part of the force."""
        self._steps = None
        if log.unmeasured_bodies and self.stepper.plant.wrench_source == "flange":
            bodies = ", ".join(log.unmeasured_bodies)
            warnings.warn(
                f"{log.robot}: the flange sensor does not measure the force on {bodies:.80}, which touched something "
                "in front of the sensor; so the true force differs from the measured one",
                ArmctlWarning,
                stacklevel=2,
            )

    def _keep_step_log(self, steps: _StepRecording, error: BaseException | None = None) -> None:
        purpose = RunPurpose(steps.recorder.size * self.stepper.dt)
        info = self._run_info(steps.recorder, " + ".join(steps.controllers), purpose, error)
        self._log = steps.recorder.log(self.arm, info)
        steps.logged = steps.recorder.size
        self._give_log(error)


def _elsewhere(trajectory: Trajectory, sentence: str) -> None:
    """Refuses a planned motion that begins elsewhere; a step may be meant, and gets a warning.

    A step is a reference of the caller's own, or a plan that holds one configuration.
    """
    if isinstance(trajectory, JointTrajectory) and trajectory.coefficients[:, 1:].any():
        raise InputError(sentence)
    warnings.warn(ArmctlWarning(sentence), stacklevel=5)


def _outside(values: Array, ends: Array) -> Array:
    """How far values (n,) are outside the intervals between two rows (2, n)."""
    return np.maximum(np.maximum(ends.min(axis=0) - values, values - ends.max(axis=0)), 0.0)


class _StepRecording:
    """The ticks of a caller's own loop; memory is allocated for many of them at once."""

    def __init__(self, stepper: Stepper):
        self.recorder = stepper.recorder()
        self.controllers: list[str] = []
        self.logged = -1
        self._stepper = stepper
        self._rows: TickRows | None = None
        self._q = np.zeros((0, 0))
        self._rates = np.zeros((0, 0))
        self._held: Array | None = None  # (n,) rad, where the rows hold that have not been run

    def next_rows(self, controller: Controller, holds: bool) -> TickRows:
        """Rows whose next one has a reference: the last one if the controller holds it, else NaN."""
        rows = self._rows
        if rows is None or rows.count == len(self._q):
            self._q = np.empty((_STEP_ROWS, self._stepper.n))
            self._rates = np.empty((_STEP_ROWS, self._stepper.n))
            rows = self.recorder.begin(TickReference(self._q, self._rates, self._rates, self._rates, self._rates))
            self._rows = rows
            self._held = None
        if not holds:
            self._q[rows.count] = np.nan
            self._rates[rows.count] = np.nan
        elif self._held is None or not (self._held == self._stepper.q_ref).all():
            self._held = self._stepper.q_ref.copy()
            self._q[rows.count :] = self._held  # all of them: a controller may foresee its reference
            self._rates[rows.count :] = 0.0
        name = traits(controller).name if holds else "external"
        if name not in self.controllers:
            self.controllers.append(name)
        return rows
