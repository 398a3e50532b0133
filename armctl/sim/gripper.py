"""Gripper: opens, closes and grasps while the arm holds its place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.errors import InputError
from armctl.core.validation import number
from armctl.mjmodel.queries import body_name
from armctl.robot.arm import Arm
from armctl.sim.gripper_model import find_gripper_model, make_servos, pad_distance
from armctl.sim.stepper import Stepper

_DEFAULT_FORCE = 10.0  # N
_SPEED = 0.1  # m/s between the pads
_CHUNK = 0.02  # s
_LEAST_WAIT, _SETTLE = 0.1, 1.0  # s
_STILL = 2e-4  # m/s between the pads
_TOLERANCE = 1e-3  # m
_TRIMS, _TRIMMED, _TRIMMED_FORCE = 20, 2e-4, 0.05  # corrections at most; m, and share of a force, that need none
_SERVO = ("actuator_gaintype", "actuator_gainprm", "actuator_biastype", "actuator_biasprm")
_SERVO_RANGES = ("actuator_ctrllimited", "actuator_ctrlrange", "actuator_forcelimited", "actuator_forcerange")


@dataclass(frozen=True)
class GripResult:
    """How a movement of the gripper ended.

    Attributes:
        ok: Whether it did what was asked for: grasped something, or reached its width.
        grasped: Whether something is held between the pads.
        held: The body that is held; empty if none.
        width: m between the pads.
        force: N that either side presses on what is held; the lesser of the two.
        duration: s of simulated time.
        reason: Why it is not ok, in words; empty if it is.
    """

    ok: bool
    grasped: bool
    held: str
    width: float
    force: float
    duration: float
    reason: str

    def __bool__(self) -> bool:
        return self.ok

    def __str__(self) -> str:
        if self.grasped:
            done = f"grasped {self.held!r} with {self.force:.3g} N, {1e3 * self.width:.3g} mm wide"
        else:
            done = f"open {1e3 * self.width:.3g} mm"
        return done if self.ok else f"{done}; {self.reason}" if self.grasped else self.reason


class Gripper:
    """The gripper behind an arm's tip. Made by `Simulation.gripper`.

    Until it is first used it is braked with all other joints outside the chain, so that the controller's model is exact; from
    then on it moves freely, as it does in reality.

    Attributes:
        jaws: What was found in the model.
    """

    def __init__(self, stepper: Stepper, hold: Callable[[float], None], arm: Arm | None = None):
        """The gripper of a simulated arm.

        Args:
            stepper: The simulated arm.
            hold: Runs the simulation for some seconds with the arm held in its place.
            arm: The arm, where the stepper moves several; the stepper's if left out.

        Raises:
            ModelError: Nothing moves behind the arm's tip, or it is a hand of many actuators.
        """
        self.jaws = find_gripper_model(stepper.arm if arm is None else arm)
        self._stepper, self._hold = stepper, hold
        self._actuators = list(self.jaws.actuators)
        self._ctrl = stepper.model.actuator_ctrladr[self._actuators]
        self._servo = {name: getattr(stepper.model, name).copy() for name in (*_SERVO, *_SERVO_RANGES)}

    @property
    def width(self) -> float:
        """How far the pads are apart now, m."""
        mujoco.mj_kinematics(self._stepper.model, self._stepper.data)
        return pad_distance(self._stepper.model, self._stepper.data, self.jaws.pads)

    @property
    def width_max(self) -> float:
        """How far the pads are apart when open, m."""
        return float(self.jaws.width[-1])

    def open(self) -> GripResult:
        """Opens as wide as it goes.

        Returns:
            How it ended.
        """
        return self.move(self.width_max)

    def move(self, width: float) -> GripResult:
        """Brings the pads to a distance, with the gripper's own servo.

        Args:
            width: m.

        Returns:
            How it ended; what is in the way is in its `reason`.

        Raises:
            InputError: A width that the gripper does not have.
        """
        begin = self._begin()
        number("width", width, 0.0, self.width_max + 1e-6)
        self._ramp(width, until_touch=False)
        self._settle()
        self._trim(width)
        held, force = self._touching()
        reached = abs(np.clip(self.width, self.jaws.width[0], self.width_max) - max(width, self.jaws.width[0])) <= _TOLERANCE
        reason = "" if reached else f"the pads stopped {1e3 * self.width:.3g} mm apart, {1e3 * width:.3g} mm were asked for"
        return self._result(reached, held if not reached else "", force, begin, reason)

    def close(self) -> GripResult:
        """Closes with a gentle force: 10 N, or half of what the gripper has if that is less.

        Returns:
            How it ended: ok where something is held, else it closed on nothing.
        """
        return self.grasp(min(_DEFAULT_FORCE, 0.5 * self.jaws.force_max))

    def grasp(self, force: float) -> GripResult:
        """Closes until both pads touch something, then presses with a force, and goes on pressing.

        Args:
            force: N between the pads.

        Returns:
            How it ended: ok where something is held, else it closed on nothing.

        Raises:
            InputError: More force than the gripper has.
        """
        number("force", force, 0.0)
        if force > self.jaws.force_max * (1 + 1e-9):
            raise InputError(f"force: {force:g} N is more than this gripper has, {self.jaws.force_max:.3g} N")
        begin = self._begin()
        self._ramp(0.0, until_touch=True)
        if not self._touching()[0]:
            self._settle()
        if self._touching()[0] or self.width > self.jaws.width[0] + _TOLERANCE:
            self._press(force)
            self._settle()
            self._trim_force(force)
        held, pressed = self._touching()
        return self._result(bool(held), held, pressed, begin, "" if held else "closed on nothing")

    def reset(self) -> None:
        """Gives the gripper back its servo, as before it was first used."""
        self._set_servo()

    def _begin(self) -> float:
        """Takes off the brake and gives the gripper back its servo; the time now."""
        self._stepper.loosen(self.jaws.dofs)
        self._set_servo()
        make_servos(self._stepper.model, self.jaws.actuators)
        return float(self._stepper.data.time)

    def _set_servo(self) -> None:
        for name, values in self._servo.items():
            index = self._ctrl if name.startswith("actuator_ctrl") else self._actuators
            getattr(self._stepper.model, name)[index] = values[index]

    def _press(self, force: float) -> None:
        """Makes the servo a motor of constant force; its damping stays."""
        model = self._stepper.model
        for actuator, push in zip(self._actuators, self.jaws.actuator_force(force), strict=True):
            model.actuator_gainprm[actuator] = 0.0
            model.actuator_biasprm[actuator, :2] = push, 0.0

    def _ramp(self, goal: float, until_touch: bool) -> None:
        """Moves the servo's reference at a steady speed from where the pads are."""
        start = self.width
        steps = max(1, round(abs(goal - start) / (_SPEED * _CHUNK)))
        for width in np.linspace(start, goal, steps + 1)[1:]:
            self._stepper.data.ctrl[self._ctrl] = self.jaws.ctrl_at(float(width))
            self._hold(_CHUNK)
            if self._stepper.failure or (until_touch and self._touching()[0]):
                return

    def _trim(self, goal: float) -> None:
        """Corrects the servo's reference by what the pads are off: linkages have springs, and friction that holds them back."""
        wanted = goal
        for _ in range(_TRIMS):
            error = goal - self.width
            if abs(error) < _TRIMMED or self._stepper.failure or self._touching()[0]:
                return
            wanted = float(np.clip(wanted + error, 0.0, self.width_max))
            self._stepper.data.ctrl[self._ctrl] = self.jaws.ctrl_at(wanted)
            self._hold(_LEAST_WAIT)

    def _trim_force(self, goal: float) -> None:
        """Corrects the push by what the pads press too much or too little: what is held need not touch them where they meet."""
        push = goal
        for _ in range(_TRIMS):
            held, pressed = self._touching()
            if self._stepper.failure or (held and abs(pressed - goal) < _TRIMMED_FORCE * goal):
                return
            if not held:  # it slips between jaws that are not parallel: close in on it again
                self._press(goal)
                return self._settle()
            push = float(np.clip(push + 0.5 * (goal - pressed), 0.0, self.jaws.force_max))
            self._press(push)
            self._hold(_LEAST_WAIT)

    def _settle(self) -> None:
        """Waits until the pads are at rest."""
        self._hold(_LEAST_WAIT)
        deadline, before = self._stepper.data.time + _SETTLE, self.width
        while not self._stepper.failure and self._stepper.data.time < deadline:
            self._hold(_CHUNK)
            now = self.width
            if abs(now - before) < _STILL * _CHUNK:
                return
            before = now

    def _touching(self) -> tuple[str, float]:
        """What both sides touch, and the force of the side that presses less."""
        model, data, wrench = self._stepper.model, self._stepper.data, np.zeros(6)
        pressed: list[dict[int, float]] = [{}, {}]
        own = self.jaws.sides[0] | self.jaws.sides[1]
        for index, contact in enumerate(data.contact):
            bodies = [int(model.geom_bodyid[g]) for g in contact.geom]
            for side, on in zip(self.jaws.sides, pressed, strict=True):
                for one, other in (bodies, bodies[::-1]):
                    if one in side and other not in own:
                        mujoco.mj_contactForce(model, data, index, wrench)
                        on[other] = on.get(other, 0.0) + abs(wrench[0])
        both = {body: min(pressed[0][body], pressed[1][body]) for body in pressed[0].keys() & pressed[1].keys()}
        if not both:
            return "", 0.0
        body = max(both, key=lambda b: both[b])
        return body_name(model, body), both[body]

    def _result(self, ok: bool, held: str, force: float, begin: float, reason: str) -> GripResult:
        ended = self._stepper.failure
        return GripResult(
            ok and not ended,
            bool(held),
            held,
            self.width,
            force if held else 0.0,
            float(self._stepper.data.time) - begin,
            ended or reason,
        )
