"""Gripper: opens, closes and grasps while the arm holds its position."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from armctl.core.defaults import DEFAULT_GRIP_FORCE, SETTLE_TIMEOUT_S
from armctl.core.result import GripResult
from armctl.core.validation import instance, number
from armctl.model.arm.arm import Arm
from armctl.model.gripper.gripper_model import checked_force, find_gripper_model, make_usable
from armctl.model.mjmodel.queries import acts, body_name
from armctl.run.sim.stepper import Stepper

PAD_SPEED = 0.1  # m/s, of the pads relative to each other
_REST_CHECK_INTERVAL_S = 0.02
_MIN_WAIT_S = 0.1
_SETTLED_PAD_SPEED = 2e-4  # m/s
_WIDTH_TOLERANCE = 1e-3  # m
# Corrections of the commanded width or force, for springs and friction of the mechanism.
_MAX_CORRECTIONS = 20
_WIDTH_CORRECTION_TOLERANCE = 2e-4  # m
_FORCE_CORRECTION_TOLERANCE = 0.05  # relative
_SERVO_ARRAYS = ("actuator_gaintype", "actuator_gainprm", "actuator_biastype", "actuator_biasprm")
_SERVO_RANGES = ("actuator_ctrllimited", "actuator_ctrlrange", "actuator_forcelimited", "actuator_forcerange")


class Gripper:
    """The gripper behind one of an arm's tips. Made by `Simulation.gripper` and `Simulation.gripper_at`.

    Until its first use it is rigid like all other joints outside the chain, so that the controller's model is exact. After
    that its joints move freely.

    Attributes:
        model: The gripper as it was found in the MuJoCo model.
    """

    def __init__(self, arm: Arm, stepper: Stepper, hold: Callable[[float], None], tip: str | None = None):
        """The gripper of a simulated arm.

        Args:
            hold: Runs the simulation for some seconds while the arm holds its position.
            tip: Which of the arm's tips it is behind; the first one if left out.

        Raises:
            ModelError: Nothing moves behind the arm's tip, or it is a hand of many actuators.
        """
        instance("arm", arm, Arm, "armctl.load(name) returns one")
        instance("stepper", stepper, Stepper, "sim.gripper is a gripper that is ready to use")
        self.model = find_gripper_model(arm, tip)
        self._stepper = stepper
        self._hold = hold
        self._actuators = list(self.model.actuators)
        self._ctrl = stepper.model.actuator_ctrladr[self._actuators]
        self._servo = {name: getattr(stepper.model, name).copy() for name in (*_SERVO_ARRAYS, *_SERVO_RANGES)}
        overlapping = self.model.overlapping
        self._limited = stepper.model.jnt_limited[self.model.followers]
        self._contype = stepper.model.geom_contype[overlapping]
        self._conaffinity = stepper.model.geom_conaffinity[overlapping]

    def __repr__(self) -> str:
        held = f", holds {self.held}" if self.held else ""
        return f"Gripper({1e3 * self.width:.3g} mm wide, at most {1e3 * self.width_max:.3g} mm{held})"

    @property
    def width(self) -> float:
        """The distance between the pads now, m."""
        mujoco.mj_kinematics(self._stepper.model, self._stepper.data)
        return self.model.jaws.width(self._stepper.model, self._stepper.data)

    @property
    def width_max(self) -> float:
        """The distance between the pads when open, m."""
        return float(self.model.width[-1])

    @property
    def held(self) -> str:
        """The loose body that both sides touch now; empty if there is none."""
        return self._grasped()[0]

    def open(self) -> GripResult:
        """Opens the gripper completely."""
        return self.move(self.width_max)

    def move(self, width: float) -> GripResult:
        """Moves the pads to a distance, with the gripper's own servo.

        Args:
            width: m.

        Returns:
            The result; if an object stopped the pads, `reason` names it.

        Raises:
            SimulationError: The arm's controller failed.
        """
        width = number("width", width, 0.0, self.width_max + 1e-6)
        begin = self._begin()
        self._ramp(width, until_touch=False)
        self._settle()
        self._correct_width(width)
        held, force = self._grasped()
        narrowest = float(self.model.width[0])
        error = float(np.clip(self.width, narrowest, self.width_max)) - max(width, narrowest)
        if abs(error) <= _WIDTH_TOLERANCE:
            return self._result(True, "", force, begin, "")
        reason = f"the pads stopped {1e3 * self.width:.3g} mm apart, {1e3 * width:.3g} mm were asked for"
        return self._result(False, held, force, begin, reason)

    def command(self, width: float) -> None:
        """Gives the gripper's own servo a distance of the pads and does not wait: the pads move while the arm does.

        Args:
            width: m.

        Raises:
            InputError: A width outside the gripper's range.
        """
        width = number("width", width, 0.0, self.width_max + 1e-6)
        self._begin()
        self._stepper.data.ctrl[self._ctrl] = self.model.ctrl_at(width)

    def close(self) -> GripResult:
        """Grasps with a gentle force: 10 N, or half of the gripper's largest force if that is less.

        Raises:
            SimulationError: The arm's controller failed.
        """
        return self.grasp(min(DEFAULT_GRIP_FORCE, 0.5 * self.model.force_max))

    def grasp(self, force: float) -> GripResult:
        """Closes until both pads touch a body, then holds it with a force until the next command.

        Args:
            force: N between the pads.

        Raises:
            InputError: More force than the gripper has.
            SimulationError: The arm's controller failed.
        """
        force = checked_force(force, self.model.force_max)
        begin = self._begin()
        self._ramp(0.0, until_touch=True)
        if not self._grasped()[0]:
            self._settle()
        if self._grasped()[0] or self.width > self.model.width[0] + _WIDTH_TOLERANCE:
            self._press(force)
            self._settle()
            self._correct_force(force)
        held, pressed = self._grasped()
        return self._result(bool(held), held, pressed, begin, "" if held else "closed on nothing")

    def reset(self) -> None:
        """Restores the gripper's own servo, limits and contacts, as before its first use."""
        self._set_servo()
        self._stepper.model.jnt_limited[self.model.followers] = self._limited
        self._stepper.model.geom_contype[self.model.overlapping] = self._contype
        self._stepper.model.geom_conaffinity[self.model.overlapping] = self._conaffinity

    def _begin(self) -> float:
        """Releases the brake, restores the gripper's own servo, and returns the time now."""
        self._stepper.release(self.model.dofs)
        self._set_servo()
        make_usable(self._stepper.model, self.model)
        return float(self._stepper.data.time)

    def _set_servo(self) -> None:
        for name, values in self._servo.items():
            index = self._ctrl if name.startswith("actuator_ctrl") else self._actuators
            getattr(self._stepper.model, name)[index] = values[index]

    def _press(self, force: float) -> None:
        """Turns the servo into a motor of constant force; its damping stays."""
        model = self._stepper.model
        for actuator, push in zip(self._actuators, self.model.actuator_force(force), strict=True):
            model.actuator_gainprm[actuator] = 0.0
            model.actuator_biasprm[actuator, :2] = (push, 0.0)

    def _ramp(self, goal: float, until_touch: bool) -> None:
        """Moves the servo's reference at constant speed from the present width."""
        start = self.width
        steps = max(1, round(abs(goal - start) / (PAD_SPEED * _REST_CHECK_INTERVAL_S)))
        for width in np.linspace(start, goal, steps + 1)[1:]:
            self._stepper.data.ctrl[self._ctrl] = self.model.ctrl_at(float(width))
            self._hold(_REST_CHECK_INTERVAL_S)
            if self._stepper.failure or (until_touch and self._grasped()[0]):
                return

    def _correct_width(self, goal: float) -> None:
        """Corrects the servo's reference by the remaining error: springs and friction of a mechanism hold the pads back."""
        reference = goal
        for _ in range(_MAX_CORRECTIONS):
            error = goal - self.width
            if abs(error) < _WIDTH_CORRECTION_TOLERANCE or self._stepper.failure or self._grasped()[0]:
                return
            reference = float(np.clip(reference + error, 0.0, self.width_max))
            self._stepper.data.ctrl[self._ctrl] = self.model.ctrl_at(reference)
            self._hold(_MIN_WAIT_S)

    def _correct_force(self, goal: float) -> None:
        """Corrects the commanded force by the measured one: an object need not touch the pads where they meet."""
        push = goal
        for _ in range(_MAX_CORRECTIONS):
            held, pressed = self._grasped()
            if self._stepper.failure or (held and abs(pressed - goal) < _FORCE_CORRECTION_TOLERANCE * goal):
                return
            if not held:  # it slipped between pads that are not parallel: close again
                self._press(goal)
                self._settle()
                return
            push = float(np.clip(push + 0.5 * (goal - pressed), 0.0, self.model.force_max))
            self._press(push)
            self._hold(_MIN_WAIT_S)

    def _settle(self) -> None:
        self._hold(_MIN_WAIT_S)
        deadline = self._stepper.data.time + SETTLE_TIMEOUT_S
        before = self.width
        while not self._stepper.failure and self._stepper.data.time < deadline:
            self._hold(_REST_CHECK_INTERVAL_S)
            now = self.width
            if abs(now - before) < _SETTLED_PAD_SPEED * _REST_CHECK_INTERVAL_S:
                return
            before = now

    def _grasped(self) -> tuple[str, float]:
        """The body that moves and that both sides touch, and the force, N, of the side that presses less."""
        model = self._stepper.model
        data = self._stepper.data
        wrench = np.zeros(6)
        forces: list[dict[int, float]] = [{}, {}]
        own = self.model.jaws.sides[0] | self.model.jaws.sides[1]
        for index, contact in enumerate(data.contact):
            if not acts(contact):
                continue
            bodies = [int(model.geom_bodyid[g]) for g in contact.geom]
            for side, on in zip(self.model.jaws.sides, forces, strict=True):
                for one, other in (bodies, bodies[::-1]):
                    if one in side and other not in own and model.body_weldid[other] != 0:
                        mujoco.mj_contactForce(model, data, index, wrench)
                        on[other] = on.get(other, 0.0) + abs(wrench[0])
        both = {body: min(forces[0][body], forces[1][body]) for body in forces[0].keys() & forces[1].keys()}
        if not both:
            return "", 0.0
        body = max(both, key=lambda b: both[b])
        return body_name(model, body), float(both[body])

    def _result(self, ok: bool, held: str, force: float, begin: float, reason: str) -> GripResult:
        failure = self._stepper.failure
        return GripResult(
            ok=ok and not failure,
            grasped=bool(held),
            held=held,
            width=self.width,
            force=force if held else 0.0,
            duration=float(self._stepper.data.time) - begin,
            reason=failure or reason,
        )
