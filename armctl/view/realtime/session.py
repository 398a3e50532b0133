"""RealTimeSession: an arm whose tips follow targets in real time, in its own thread, under commands of other threads."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from armctl.control import controller_by_name
from armctl.control.interface import Controller
from armctl.core.defaults import AT_REST_SPEED
from armctl.core.errors import ModelError, UnknownNameError
from armctl.core.log import SimulationError
from armctl.core.pose import Pose
from armctl.core.target import TOLERANCE
from armctl.core.validation import Array, frozen, instance, number, vector
from armctl.model.arm.arm import Arm
from armctl.model.collision.checkers import collision_checker
from armctl.model.mjmodel.queries import contact_forces
from armctl.model.mjmodel.target_marker import find_target, target_pose
from armctl.plan.ik.solve import solve_ik
from armctl.run.execution.drive import hold_reference
from armctl.run.execution.obstacles import Obstacles, touched_at_home
from armctl.run.sim.gripper.gripper import Gripper
from armctl.run.sim.plant import Plant
from armctl.run.sim.stepper import Stepper
from armctl.view.realtime.clock import RealTimeClock
from armctl.view.realtime.history import History
from armctl.view.realtime.status import Activity, Status
from armctl.view.realtime.target_follower import TargetFollower

UPDATE_INTERVAL_S = 0.01
_REFERENCE_ARRIVED = 1e-6  # rad
_MIN_SPEED_OVERRIDE = 0.01
_JOIN_TIMEOUT_S = 1.0

_log = logging.getLogger("armctl.run.sim")


class RealTimeSession:
    """An arm in real time.

    Commands are queued and executed between control updates; a newer command of the same kind replaces an older one. Other
    threads read `status` and `history` only.
    """

    def __init__(self, arm: Arm, controller: str = "computed-torque", payload: float = 0.0):
        """A session with the arm at home, and so many kg at the tip. Time stands still until `start`."""
        self.arm = arm
        self.keyframes = tuple(arm.model.key(i).name or f"keyframe {i}" for i in range(arm.model.nkey))
        self._controller_name = controller
        self._controller: Controller = controller_by_name(controller, arm)
        self._payload = number("payload", payload, 0.0)
        self._stepper = Stepper(arm, Plant(payload=self._payload))
        self._ticks = max(1, round(UPDATE_INTERVAL_S / self._stepper.dt))
        self._interval = self._ticks * self._stepper.dt
        self._follower = TargetFollower(arm, self._stepper.dt, self._obstacles())
        # The velocity at which a hand moves a target now, m/s and rad/s in world axes; None if none does.
        self.hand: Callable[[], tuple[Array, Array] | None] = lambda: None
        self.hand_tip = _highest_tip(arm)  # whose target that is
        self._speed_override = 1.0
        self._clock = RealTimeClock()
        self.history = History(arm.n, self._interval)  # errors and torques of the last seconds
        self._grippers = self._grippers_of(self._stepper)
        self.gripper_width_max = {tip: gripper.width_max for tip, gripper in self._grippers.items()}  # m, by tip
        self._commands: dict[str, Callable[[], None]] = {}
        self._commands_lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._paused = False
        self.is_standing_by = False
        self._elapsed = 0.0
        self._failure = ""
        self._restart()
        self._status = self._observed(arm.home)

    @property
    def status(self) -> Status:
        """The session after its last update."""
        return self._status

    def aim(self, target: Pose, *, tip: str | None = None, held: bool = False) -> None:
        """Moves a tip, by default the first one, to a target, T_world_tip.

        While it is held, as when dragged, no path around obstacles is planned. Targets of other tips stay as they are.
        """
        instance("target", target, Pose, "give Pose(position, quat)")
        name = self._tip(tip)
        self._command(f"target of {name}", lambda: self._follower.aim(target, name, held))

    def move_joints(self, q: Array) -> None:
        """Moves the joints to q (n,) rad, clamped to their limits; the targets follow the tips."""
        q = self.arm.limits.clamp(vector("q", q, self.arm.n))
        self._command("joints", lambda: self._follower.move_joints(q))

    def set_oriented(self, oriented: bool, tip: str | None = None) -> None:
        """Chooses whether the orientation of a tip's target is part of the goal; by default of the first one."""
        name = self._tip(tip)
        self._command(f"orientation of {name}", lambda: self._follower.set_oriented(name, bool(oriented)))

    def set_avoiding(self, avoiding: bool) -> None:
        """Chooses whether the arm avoids contact with itself and the scene."""
        self._command("avoiding", lambda: self._follower.set_avoiding(bool(avoiding)))

    def set_speed_override(self, share: float) -> None:
        """Changes the share of the full speed, in [0.01, 1], also during a motion; the limits of the joints hold throughout."""
        share = number("share", share, _MIN_SPEED_OVERRIDE, 1.0)

        def change() -> None:
            self._follower.reference.set_speed(share)
            self._speed_override = share

        self._command("speed override", change)

    def set_controller(self, name: str) -> None:
        """Changes the controller, by its name, while the arm moves."""
        controller = controller_by_name(name, self.arm)

        def change() -> None:
            self._controller = controller
            self._controller_name = name

        self._command("controller", change)

    def set_payload(self, payload: float) -> None:
        """Changes the mass at the tip, kg. The controller's model does not include it."""
        payload = number("payload", payload, 0.0)
        stepper = Stepper(self.arm, Plant(payload=payload))

        def change() -> None:
            stepper.reset(self._stepper.state.q, self._stepper.state.v)
            stepper.data.qpos[:] = self._stepper.data.qpos
            self._stepper = stepper
            self._payload = payload
            self._grippers = self._grippers_of(stepper)
            self._follower.avoidance.obstacles = self._obstacles()

        self._command("payload", change)

    def grip(self, width: float, tip: str | None = None) -> None:
        """Moves the gripper at a tip, by default the first one, to a width between the pads, m, clamped to its range.

        The arm holds its position meanwhile.
        """
        width = number("width", width)
        name = self._tip(tip)

        def move() -> None:
            gripper = self._grippers.get(name)
            if gripper is not None and not self._paused:
                gripper.move(min(max(width, 0.0), gripper.width_max))

        self._command(f"gripper of {name}", move)

    def set_speed(self, speed: float) -> None:
        """Changes how many simulated seconds pass in a second, in [0.001, 1000]."""
        self._clock.speed = speed

    def pause(self, paused: bool) -> None:
        """Stops simulated time, or lets it continue."""

        def change() -> None:
            self._paused = bool(paused)

        self._command("pause", change)

    def reset(self, keyframe: str = "") -> None:
        """Puts everything at home, at rest, with the first target, or at one of `keyframes`, with the targets at the tips.

        It also ends DIVERGED and FAILED.
        """
        if keyframe and keyframe not in self.keyframes:
            raise UnknownNameError.from_known("keyframe", keyframe, self.keyframes)

        def restart() -> None:
            self._restart(keyframe)
            self._status = self._observed(self._follower.reference.q)

        self._command("reset", restart)

    def stand_by(self, standing_by: bool) -> None:
        """Stops the session, which still takes commands, or lets it go on."""

        def change() -> None:
            self.is_standing_by = bool(standing_by)

        self._command("stand by", change)

    def prepare(self) -> None:
        """Loads what the first motion needs, which takes up to some seconds."""
        self._follower.prepare()

    def start(self) -> None:
        self._thread = threading.Thread(target=self._run, name="armctl session", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._follower.close()
        if self._thread is not None:
            self._thread.join(timeout=_JOIN_TIMEOUT_S)

    def advance(self) -> bool:
        """Executes the queued commands and simulates one update interval; False while paused or after a failure.

        No exception leaves this method: a failure appears in the status, and the session stands until `reset`.
        """
        try:
            advanced = self._advance()
        except _StoppedError:
            advanced = False
        except SimulationError:
            advanced = False  # the stepper says why
        except Exception as error:
            _log.exception("the real-time session failed")
            self._fail(error)
            advanced = False
        if not advanced:
            self._refresh_status()
        return advanced

    def _advance(self) -> bool:
        with self._commands_lock:
            commands = self._commands
            self._commands = {}
        for command in commands.values():
            command()
        if self._paused or self.is_standing_by or self._failure or self._stepper.failure:
            return False
        self._follower.jog(self.hand_tip, self.hand(), self._interval * self._speed_override)
        reference = self._follower.advance(self._ticks, self._held_bodies())
        self._stepper.run(self._controller, reference, self._stepper.recorder())  # each record is thrown away
        self._elapsed += self._interval
        self._status = self._observed(self._follower.reference.q)
        return True

    def _run(self) -> None:
        try:
            self._clock.restart()
            while not self._stopping.is_set():
                if self.advance():
                    self._clock.wait(self._interval)
                else:
                    time.sleep(UPDATE_INTERVAL_S)
                    self._clock.restart()
        except BaseException as error:  # the thread ends, and the status must not say otherwise
            _log.exception("the thread of the real-time session ended")
            self._fail(error)
            self._refresh_status()

    def _fail(self, error: BaseException) -> None:
        self._failure = f"{type(error).__name__}: {error}"[:200]

    def _refresh_status(self) -> None:
        """Renews what a session that stands can change."""
        self._status = replace(
            self._status,
            activity=self._activity(self._status.position_error, at_rest=False, arrived=False),
            **self._settings(),
        )

    def _settings(self) -> dict[str, Any]:
        """The attributes of the status that change without time."""
        return {
            "failure": self._failure or self._stepper.failure,
            "targets": self._follower.targets,
            "aimed": self._follower.aimed,
            "oriented": self._follower.oriented,
            "joint_control": self._follower.joint_control,
            "avoiding": self._follower.avoidance.is_on,
            "speed_override": self._speed_override,
            "controller": self._controller_name,
            "payload": self._payload,
            "paused": self._paused,
            "speed": self._clock.speed,
        }

    def _command(self, kind: str, command: Callable[[], None]) -> None:
        with self._commands_lock:
            self._commands.pop(kind, None)
            self._commands[kind] = command

    def _tip(self, tip: str | None) -> str:
        """A tip's name, checked; the first tip's if none is given."""
        if tip is not None and tip not in self.arm.tips:
            raise UnknownNameError.from_known("tip", tip, self.arm.tips)
        return self.arm.tip if tip is None else tip

    def _obstacles(self) -> Obstacles:
        return Obstacles(self.arm, self._stepper.data, touched_at_home(self.arm))

    def _grippers_of(self, stepper: Stepper) -> dict[str, Gripper]:
        """The grippers by tip."""
        found = {}
        for tip in self.arm.tips:
            with contextlib.suppress(ModelError):
                found[tip] = Gripper(self.arm, stepper, self._hold, tip)
        return found

    def _held_bodies(self) -> dict[str, int]:
        """The loose bodies that grippers hold, and which body of the arm each goes with."""
        held = {gripper.held: self.arm.tip_frames[self.arm.tips.index(tip)].body for tip, gripper in self._grippers.items()}
        held.pop("", None)
        return held

    def _hold(self, seconds: float) -> None:
        if self._stopping.is_set():
            raise _StoppedError
        self._stepper.run(self._controller, hold_reference(self._stepper, seconds), self._stepper.recorder())
        self._status = self._observed(self._stepper.q_ref)
        if self._thread is threading.current_thread():
            self._clock.wait(seconds)

    def _restart(self, keyframe: str = "") -> None:
        arm = self.arm
        for gripper in self._grippers.values():
            gripper.reset()
        stepper = self._stepper
        self._failure = ""
        if keyframe:
            self._rest_at(arm.model.key_qpos[self.keyframes.index(keyframe)])
            return
        stepper.reset(arm.home, np.zeros(arm.n))
        if arm.further_tips:
            self._follower.stand(arm.home, arm.home)
            return
        tip = stepper.tip_pose(arm)
        start = target_pose(stepper.model, stepper.data).position if find_target(stepper.model) is not None else tip.position
        if self._follower.oriented:
            start = (start + tip.position) / 2  # nearer to home there is room to drag it without turning the tool
        goal = solve_ik(arm, Pose(start, quat=tip.quat), arm.home).q  # the tool is held as at home, as nearly as possible
        if collision_checker(arm).at(goal):
            goal = solve_ik(arm, start, arm.home).q
        self._follower.stand(arm.home, goal)

    def _rest_at(self, qpos: Array) -> None:
        """Puts the whole model at positions (nq,), at rest, with the targets at the tips."""
        arm = self.arm
        stepper = self._stepper
        q = arm.limits.clamp(qpos[arm.qpos_adr])
        stepper.reset(q, np.zeros(arm.n))
        stepper.data.qpos[:] = qpos
        arm.joint_map.set_positions(stepper.data.qpos, q)
        mujoco.mj_forward(stepper.model, stepper.data)
        self._follower.stand(q, q)

    def _observed(self, q_ref: Array) -> Status:
        """The status now; adds a sample to the history."""
        stepper = self._stepper
        state = stepper.state
        tips = {tip: stepper.tip_pose(self.arm, tip) for tip in self.arm.tips}
        follower = self._follower
        position_error = max(follower.errors(tips).values())
        reference_error = max(
            float(np.linalg.norm(pose.position - self.arm.fk(q_ref, tip).position)) for tip, pose in tips.items()
        )
        self.history.add(position_error, reference_error, stepper.motor_torque / self.arm.motor_torque_limits)
        return Status(
            activity=self._activity(
                position_error,
                at_rest=bool(np.abs(state.v).max() < AT_REST_SPEED),
                arrived=bool(np.abs(q_ref - follower.joint_goal).max() < _REFERENCE_ARRIVED) and follower.reference.is_at_rest,
            ),
            position_error=position_error,
            reach_errors=follower.task.reach_errors,
            refusal=follower.task.refusal,
            path=follower.task.path,
            contacts=frozen(contact_forces(stepper.model, stepper.data)),
            q=frozen(state.q.copy()),
            qpos=frozen(stepper.data.qpos.copy()),
            gripper_widths={tip: gripper.width for tip, gripper in self._grippers.items()},
            elapsed=self._elapsed,
            real_time_factor=self._clock.real_time_factor,
            **self._settings(),
        )

    def _activity(self, position_error: float, *, at_rest: bool, arrived: bool) -> Activity:
        if self._failure:
            return Activity.FAILED
        if self._stepper.failure:
            return Activity.DIVERGED
        if self._paused:
            return Activity.PAUSED
        if self._follower.is_planning:
            return Activity.PLANNING
        if self._follower.task.refusal:
            return Activity.BLOCKED
        if self._follower.task.reach_errors and arrived:
            return Activity.OUT_OF_REACH
        if position_error <= TOLERANCE and at_rest:
            return Activity.AT_TARGET
        if arrived and at_rest:
            return Activity.SAGGING
        return Activity.FOLLOWING


def _highest_tip(arm: Arm) -> str:
    """The tip that is highest at home: lower ones may be feet."""
    heights = {tip: round(float(arm.fk(arm.home, tip).position[2]), 3) for tip in arm.tips}
    return max(arm.tips, key=heights.__getitem__)


class _StoppedError(Exception):
    """The session ends while the gripper moves."""
