"""Simulation: an arm in its scene, commanded in Cartesian or joint targets."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.control.computed_torque import ComputedTorque
from armctl.control.interface import Controller, State, traits
from armctl.core import hooks
from armctl.core.errors import InputError, LimitError, UnknownNameError
from armctl.core.faces import named_after_itself
from armctl.core.log import Log
from armctl.core.other_names import with_hints
from armctl.core.pose import Pose
from armctl.core.trajectory import TickReference
from armctl.core.validation import flag, number, vector
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.model.loading.load import load
from armctl.model.mjmodel.queries import has_obstacles, is_loose
from armctl.model.mjmodel.target_marker import without_marker
from armctl.run.execution.contact_reaction import ContactReaction, check_reaction
from armctl.run.execution.hand_commands import GripperAtHand, HandCommands
from armctl.run.execution.move import RunPurpose, read_controller
from armctl.run.execution.recorder import ticks_for
from armctl.run.sim.plant import Plant, read_plant, with_tick
from armctl.run.sim.simulated_arm import ConstantTorque, SimulatedArm
from armctl.run.sim.stepper import Stepper

if TYPE_CHECKING:
    from armctl.plan.grasp.handling_scene import HandledBody
    from armctl.report.render.depth_camera import Camera, CameraImage, Eyes
    from armctl.run.sim.gripper.gripper import Gripper

_CONTROL_TOLERANCE = 1e-9  # relative, for controls at a limit of their motor


@named_after_itself
class Simulation(HandCommands):
    """An arm in its scene with a controller, commanded by Cartesian or joint targets.

    Every command starts where the last one ended. After Ctrl-C or a failing controller, `log` contains all ticks until then,
    and the next command continues from there. After a run that diverged, only `reset` helps.

    Attributes:
        arm: The model of the controller.
        plant: How the simulated arm differs.
        data: Its MjData, for reading.
        viewer: The page that shows the simulation, or None.
    """

    if not TYPE_CHECKING:
        __getattr__ = with_hints(
            {
                "q": "sim.state.q",
                "v": "sim.state.v",
                "qpos": "sim.state.q",
                "open_gripper": "sim.gripper.open()",
                "close_gripper": "sim.gripper.close()",
                "grasp": "sim.gripper.grasp(force)",
                "fk": "sim.tip, or sim.arm.fk(q)",
                "move": "sim.move_to(target)",
                "movel": "sim.move_l(target)",
                "plan": "armctl.move_free(arm, start, goal), and sim.run",
            }
        )

    def __init__(
        self,
        robot: Arm | str,
        controller: Controller | str | None = None,
        plant: Plant | None = None,
        *,
        dt: float | None = None,
        viewer: bool = False,
    ):
        """A simulation with the arm at home, at rest.

        Args:
            robot: An arm, or a name for `armctl.load`.
            controller: A controller or its name; computed torque by default.
            plant: How the simulated arm differs from the model; by default it does not.
            dt: s, the tick, as `Plant(timestep=dt)`; left out, that of the plant or of the model.
            viewer: Whether a page in the browser shows the simulation in real time.

        Raises:
            InputError: The tick is out of its bounds, or the plant has another one.
            UnknownNameError: There is no such robot or controller.
            ModelError: The robot's model is no arm.
        """
        arm = robot if isinstance(robot, Arm) else load(robot)
        law = ComputedTorque(arm) if controller is None else read_controller(controller, arm)
        self.plant = read_plant(plant) if dt is None else with_tick(read_plant(plant), dt)
        self.viewer = hooks.open_viewer(arm) if flag("viewer", viewer) and hooks.open_viewer is not None else None
        self._stepper = Stepper(arm, self.plant, self.viewer)
        self._controlled: SimulatedArm = SimulatedArm(arm, law, self._stepper)
        super().__init__(self._controlled)
        self._grippers: dict[str, Gripper] = {}
        self._eyes: Eyes | None = None

    def __repr__(self) -> str:
        law = traits(self.controller).name
        return f"Simulation({self.arm.name!r}, {law!r}, plant: {self.plant}, t = {self.data.time:.4g} s)"

    @property
    def controller(self) -> Controller:
        """The controller. It can be replaced between two commands."""
        return self._controlled.controller

    @controller.setter
    def controller(self, controller: Controller | str) -> None:
        self._controlled.controller = read_controller(controller, self.arm)

    @property
    def reaction(self) -> ContactReaction | None:
        """The reaction to contacts during motions; None for none. It can be replaced between two commands."""
        return self._controlled.reaction

    @reaction.setter
    def reaction(self, reaction: ContactReaction | None) -> None:
        if reaction is not None:
            check_reaction(reaction, self.arm)
        self._controlled.reaction = reaction

    @property
    def measured_state(self) -> State:
        """The state as the plant's sensors measure it now, with noise; the same until the next tick."""
        return self._stepper.measured_state

    @property
    def gripper(self) -> Gripper:
        """The gripper behind the arm's tip, of several the first one.

        Raises:
            ModelError: There is none, or it is a hand of many actuators.
        """
        return self.gripper_at(self.arm.tip)

    def gripper_at(self, tip: str) -> Gripper:
        """The gripper behind one of several tips.

        Args:
            tip: Its name.

        Raises:
            UnknownNameError: The arm has no such tip.
            ModelError: There is no gripper behind it, or it is a hand of many actuators.
        """
        if not isinstance(tip, str) or tip not in self.arm.tips:
            raise UnknownNameError.from_known(f"tip of {self.arm.name:.60}", tip, self.arm.tips)
        if tip not in self._grippers:
            from armctl.run.sim.gripper.gripper import Gripper

            self._grippers[tip] = Gripper(self.arm, self._stepper, self._controlled.hold, tip)
        return self._grippers[tip]

    def reset(self, q: ArrayLike | None = None, v: ArrayLike | None = None) -> None:
        """Sets time to 0, and everything to its initial state.

        Args:
            q: (n,) rad, the joint positions; home by default.
            v: (n,) rad/s, the joint velocities; at rest by default.

        Raises:
            LimitError: A position is half a turn (1 m) or more outside its limits, as degrees are.
        """
        for gripper in self._grippers.values():
            gripper.reset()
        self._controlled.reset(q, v)

    def camera(self, camera: str | Camera, size: tuple[int, int] = (320, 240)) -> CameraImage:
        """What a camera sees now: colour, depth and points, as a depth camera gives them.

        Args:
            camera: The name of a camera of the model; or an `armctl.Camera`, such as one at the wrist.
            size: Width and height in pixels, in [16, 8192].

        Returns:
            The picture, without the marker of `target`. Its `points` are in the world; those on the arm itself are among them.

        Raises:
            InputError: A size out of bounds, or a camera whose optical axis is not in the middle.
            UnknownNameError: The model has no such camera, or no body or site that carries it.
            NotInstalledError: OpenGL is missing.

        Example:
            >>> seen = sim.camera(armctl.Camera(armctl.Pose([0, 0, 1.5], rpy=[np.pi, 0, 0])))
            >>> seen.points
        """
        from armctl.report.render.depth_camera import Eyes
        from armctl.report.render.renderer import check_size

        if self._eyes is None:
            self._eyes = Eyes(without_marker(self._stepper.model))
        mujoco.mj_kinematics(self._stepper.model, self._stepper.data)
        mujoco.mj_camlight(self._stepper.model, self._stepper.data)
        return self._eyes.look(self._stepper.data, camera, check_size(size))

    def step(self, torque: ArrayLike | None = None) -> State:
        """Simulates one tick and measures, for control loops of the caller, such as MPC, teleoperation or learning.

        The torque is processed like that of a controller: limited by the motors, delayed and disturbed by the plant, recorded
        in `log` and shown by the viewer. A loop of `sim.step(controller.torque(sim.measured_state, setpoint))` gives the same
        bits as `run`.

        Args:
            torque: (n,) N m; None lets the controller hold the last reference. After a step with a torque, that is the
                position of the arm.

        Raises:
            SimulationError: The arm diverged, or the controller failed; `error.log` contains the steps until then.
        """
        return self._controlled.step(None if torque is None else vector("torque", torque, self.arm.n))

    def apply_ctrl(self, ctrl: ArrayLike, duration: float) -> Log:
        """Holds the arm's motors at constant controls, without a controller.

        Args:
            ctrl: (n,) controls, in the units of the model's motors: torque = gear x ctrl.
            duration: How long, s.

        Returns:
            Every tick of it; its references are NaN.

        Raises:
            LimitError: A control outside its motor's range.
        """
        arm = self.arm
        checked = vector("ctrl", ctrl, arm.n)
        bound = arm.motor_torque_limits / np.abs(arm.gear)
        outside = np.abs(checked) > bound * (1 + _CONTROL_TOLERANCE)
        if outside.any():
            i = int(outside.argmax())
            raise LimitError(f"ctrl: {arm.joint_names[i]}: {checked[i]:g} is outside [{-bound[i]:g}, {bound[i]:g}]")
        constant = ConstantTorque(checked * arm.gear)
        duration = number("duration", duration, 0.0)
        nothing = np.full((ticks_for(duration, self.dt), self.arm.n), np.nan)
        with self._controlled.recording(RunPurpose(duration), constant) as recorder:
            self._stepper.run(constant, TickReference(nothing, nothing, nothing, nothing, nothing), recorder)
        assert self.log is not None  # the run is over
        return self.log

    def _checker(self, avoid: bool, allow: Iterable[tuple[str, str]]) -> CollisionChecker | None:
        """As of all commands. With nothing around it, an arm whose links have no shape moves; the result names the links."""
        has_world = bool(self._obstacles.world) or has_obstacles(self.model, self.arm.joint_map.joints)
        is_alone = bool(self.arm.unchecked_links) and not has_world
        return super()._checker(flag("avoid", avoid) and not is_alone, allow)

    def _gripper_at_hand(self) -> GripperAtHand:
        gripper = self.gripper
        return GripperAtHand(gripper, gripper.model)

    def _held_body(self) -> str:
        gripper = self._grippers.get(self.arm.tip)
        return "" if gripper is None else gripper.held

    def _check_pickable(self, body: HandledBody) -> None:
        if not body.number:
            raise InputError(
                f"body: {body.name:.60} is only seen: the physics of a simulation does not contain what is in its world; "
                "give it a mass in a World, and load that with armctl.load(..., scene=world)"
            )

    def _measured_pose(self, name: str) -> Pose | None:
        return self._find(name).pose

    @property
    def _held(self) -> dict[str, int]:
        bodies = {frame.name: frame.body for frame in self.arm.tip_frames}
        held = {tip: gripper.held for tip, gripper in self._grippers.items()}
        # The handle of a door goes its own way, so it is an obstacle with which contact may be allowed.
        return {body: bodies[tip] for tip, body in held.items() if body and is_loose(self.model, self.model.body(body).id)}
