"""RealTimeSession: an arm that follows a target in real time, in a thread of its own, while others watch and interfere."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from armctl.control import controller_by_name
from armctl.core.errors import ModelError
from armctl.core.log import SimulationError
from armctl.core.pose import Pose
from armctl.core.target import TOLERANCE, Target
from armctl.core.validation import Array
from armctl.ik import DifferentialIk, solve_ik
from armctl.mjmodel.target_marker import find_target, target_pose
from armctl.robot.arm import Arm
from armctl.sim.clock import RealTimeClock
from armctl.sim.gripper import Gripper
from armctl.sim.history import History
from armctl.sim.online_reference import OnlineReference
from armctl.sim.plant import Plant
from armctl.sim.recorder import Recorder
from armctl.sim.stepper import Stepper

INTERVAL = 0.01  # s between looks at the target
_STILL = 1e-3  # rad/s
_EASE = 0.3  # share of the acceleration that a hand's jerky target is followed with; its square for the jerk
_SETTLED = 1e-2  # rad/s: the goal of the joints has arrived
_WORTH_IT = 0.01  # m by which another posture must be nearer to a target out of reach, to be taken


class RealTimeSession:
    """An arm in real time. What others order is done between two looks at the target; the latest of its kind wins.

    Attributes:
        arm: The arm.
        history: The last seconds.
        pace: Its clock.
        controller: The name of the controller.
        payload: kg at the tip.
        paused: Whether it stands.
        shown: (nq,) the model's positions, for those who draw.
        target: T_world_tip that is wanted.
        oriented: Whether the target's orientation counts.
        steered: Whether the joints are steered by hand, and the target follows the tip.
        gripper: The one behind the tip; None where there is none.
        elapsed: s of simulated time since the session began, whatever was reset meanwhile.
    """

    def __init__(self, arm: Arm, controller: str = "computed-torque", payload: float = 0.0):
        """A session with the arm at home. It stands until `start`.

        Args:
            arm: The arm.
            controller: The name of one.
            payload: kg at the tip.

        Raises:
            UnknownNameError: There is no such controller.
            InputError: The payload is negative.
        """
        self.arm, self.payload, self.controller = arm, payload, controller
        self._law = controller_by_name(controller, arm)
        self._stepper = Stepper([arm], Plant(payload=payload))
        self._ticks = max(1, round(INTERVAL / self._stepper.dt))
        self.history, self.pace = History(arm.n, self._ticks * self._stepper.dt), RealTimeClock()
        self._guide = OnlineReference(arm, self._stepper.dt, arm.home, acceleration_scale=_EASE)
        self._ik = DifferentialIk(arm)
        self._orders: dict[str, Callable[[], None]] = {}
        self._lock, self._stopping, self._thread = threading.Lock(), threading.Event(), None
        self.paused, self.oriented, self.elapsed = False, arm.n >= 6, 0.0
        self.gripper = self._gripper_of(self._stepper)
        self._restart()

    def aim(self, target: Pose) -> None:
        """Sends the tip to a target.

        Args:
            target: T_world_tip.
        """
        self._order("goal", lambda: self._aim(target))

    def steer(self, q: Array) -> None:
        """Sends the joints somewhere; the target goes where the tip will be.

        Args:
            q: (n,) rad; clamped to the limits.
        """
        self._order("goal", lambda: self._steer(self.arm.limits.clamp(q)))

    def orient(self, oriented: bool) -> None:
        """Says whether the target's orientation counts.

        Args:
            oriented: Whether it does.
        """

        def change() -> None:
            self.oriented = oriented
            self._aim(self.target)

        self._order("orient", change)

    def control_by(self, controller: str) -> None:
        """Changes the controller while the arm moves.

        Args:
            controller: The name of one.

        Raises:
            UnknownNameError: There is none of that name.
        """
        law = controller_by_name(controller, self.arm)

        def change() -> None:
            self._law, self.controller = law, controller

        self._order("controller", change)

    def carry(self, payload: float) -> None:
        """Changes what hangs at the tip; the controller is not told.

        Args:
            payload: kg.

        Raises:
            InputError: It is negative or not finite.
        """
        stepper = Stepper([self.arm], Plant(payload=payload))

        def change() -> None:
            stepper.reset(self._stepper.state.q, self._stepper.state.v)
            stepper.data.qpos[:] = self._stepper.data.qpos
            self._stepper, self.payload, self.gripper = stepper, payload, self._gripper_of(stepper)

        self._order("payload", change)

    def grip(self, width: float) -> None:
        """Moves the gripper; the arm holds its place meanwhile.

        Args:
            width: m between the pads.
        """

        def move() -> None:
            if self.gripper is not None and not self.paused:
                self.gripper.move(min(max(width, 0.0), self.gripper.width_max))

        self._order("grip", move)

    def pause(self, paused: bool) -> None:
        """Holds time, or lets it go on.

        Args:
            paused: Whether it stands.
        """
        self.paused = paused

    def reset(self) -> None:
        """The arm at home again, at rest, and the target where it was at first."""
        self._order("reset", self._restart)

    @property
    def status(self) -> str:
        """What the arm does, in words."""
        if self._stepper.failure:
            return f"{self._stepper.failure}: reset"
        if self.paused:
            return "paused"
        millimetres = 1e3 * self._to_target
        if self._refusal and self._arrived:
            return self._refusal
        if self._to_target <= TOLERANCE and self._still:
            return f"at the target, {max(millimetres, 1e-3):.2g} mm off"
        if self._arrived and self._still:
            burden = f" under {self.payload:g} kg" if self.payload else ""
            return f"{millimetres:.1f} mm off: {self.controller} does not hold it there{burden}"
        return f"following, {millimetres:.0f} mm to go" + (f"; {self._refusal}" if self._refusal else "")

    @property
    def real_time_factor(self) -> float:
        """1 where the simulation keeps up with the clock."""
        return self.pace.real_time_factor

    def start(self) -> None:
        """Starts the clock."""
        self._thread = threading.Thread(target=self._run, name="armctl session", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stops it for good."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)

    def _run(self) -> None:
        self._ik.step(self.arm.home, self.target, INTERVAL)  # what waits for its first use is loaded now
        self.pace.restart()
        while not self._stopping.is_set():
            if self.advance():
                self.pace.wait(self._ticks * self._stepper.dt)
            else:
                time.sleep(INTERVAL)
                self.pace.restart()

    def advance(self) -> bool:
        """Obeys, and goes on by one look at the target.

        Returns:
            Whether time went by: not so while paused, or after the arm ran away.
        """
        with self._lock:
            orders, self._orders = self._orders, {}
        try:
            for order in orders.values():
                order()
        except SimulationError:
            return False
        if self.paused or self._stepper.failure:
            return False
        if not self._decided:
            self._follow()
        reference = self._guide.toward(self._goal, self._ticks)
        try:
            self._stepper.run(self._law, reference, Recorder(self._stepper.model, self._stepper.actuation))
        except SimulationError:
            return False
        self._look(self._guide.q)
        self.elapsed += self._ticks * self._stepper.dt
        return True

    def _order(self, kind: str, order: Callable[[], None]) -> None:
        with self._lock:
            self._orders.pop(kind, None)
            self._orders[kind] = order

    def _gripper_of(self, stepper: Stepper) -> Gripper | None:
        try:
            return Gripper(self.arm, stepper, self._hold)
        except ModelError:
            return None

    def _hold(self, seconds: float) -> None:
        """Holds the arm while the gripper moves."""
        recorder = Recorder(self._stepper.model, self._stepper.actuation)
        self._stepper.run(self._law, self._stepper.hold_reference(seconds), recorder)
        self._look(self._stepper.q_ref)
        if self._thread is threading.current_thread():
            self.pace.wait(seconds)

    def _restart(self) -> None:
        arm = self.arm
        if self.gripper is not None:
            self.gripper.reset()
        self._stepper.reset(arm.home, np.zeros(arm.n))
        self._guide.stand(arm.home)
        stepper = self._stepper
        has_target = find_target(stepper.model) is not None
        start = target_pose(stepper.model, stepper.data).position if has_target else stepper.tip.position
        self._steer(solve_ik(arm, start, arm.home).q)
        self.steered = False
        self._look(arm.home)

    def _aim(self, target: Pose) -> None:
        self.target, self.steered, self._refusal, self._decided = target, False, "", False

    def _follow(self) -> None:
        """Moves the joints' goal after the target by differential IK; where that comes to rest, IK has the last word."""
        wanted, interval = self.target if self.oriented else self.target.position, self._ticks * self._stepper.dt
        rate = self._ik.step(self._goal, wanted, interval)
        self._goal = self.arm.limits.clamp(self._goal + interval * rate)
        if np.abs(rate).max() > _SETTLED:
            return
        self._decided = True
        answer = solve_ik(self.arm, wanted, self._goal)
        short = answer.position_error
        nearest = Target.read(wanted).distance(self.arm.fk(self._goal))[0]
        if answer.ok or short < nearest - _WORTH_IT:
            self._goal = answer.q
        if not answer.ok:
            self._refusal = f"out of reach by {1e3 * short:.0f} mm" if short >= TOLERANCE else "cannot turn that way there"

    def _steer(self, q: Array) -> None:
        self._aim(self.arm.fk(q))
        self._goal, self.steered, self._decided = q, True, True

    def _look(self, q_ref: Array) -> None:
        """Notes where things are now."""
        tip, reference, stepper = self._stepper.tip_pose(self.arm), self.arm.fk(q_ref), self._stepper
        goal = Target(self.target.position, self.target if self.oriented else None)
        self._to_target = goal.distance(tip)[0]
        self._still = bool(np.abs(stepper.state.v).max() < _STILL)
        self._arrived = bool(np.abs(q_ref - self._goal).max() < 1e-6)
        shares = (
            stepper.data.qfrc_actuator[self.arm.actuation.torque_adr]
            * self.arm.actuation.torque_share
            / self.arm.limits.tau_max
        )
        self.history.add(self._to_target, float(np.linalg.norm(tip.position - reference.position)), shares)
        self.shown = stepper.data.qpos.copy()
        self.q = stepper.state.q.copy()
