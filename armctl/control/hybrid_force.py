"""Hybrid force/motion control: forces along some axes of the tip, motion along the others."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypedDict

import numpy as np

from armctl import _core
from armctl.control.gain_attribute import Gain, choice_gain, optional_gain, scalar_gain
from armctl.control.interface import ArmController
from armctl.control.task_space import task_rows
from armctl.core.defaults import DEFAULT_BANDWIDTH
from armctl.core.errors import InputError, UnknownNameError
from armctl.core.validation import Array, IntArray, number, shown
from armctl.model.arm.arm import Arm

AXES = ("x", "y", "z", "rx", "ry", "rz")
FRAMES = ("world", "tip")


class _ForceAxes(TypedDict):
    """Arguments of the compiled law."""

    is_force: IntArray  # (6,) 1 for a force axis
    targets: Array  # (6,) N and N m


class HybridForce(ArmController):
    """Hybrid force/motion control with contact transition.

        tau = ID(q, v, a_ref + posture + J# a_task) + J^T (A^T f - w)

    After Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation"
    (1987). Along a force axis the tip approaches slowly until it measures a contact. The commanded force then rises from the
    measured to the target force, with integral action and damping. Along all other axes the tip follows its reference like
    operational space control, and the measured wrench w on motion axes, such as friction on a surface, is compensated. The
    reference along a force axis is ignored, so the position of the wall need not be known. An axis with target 0 yields from
    the beginning.

    It needs `state.wrench`. Arms of less than six joints control the position of the tip, not its orientation.
    """

    name = "hybrid-force"
    needs_wrench = True
    yields = True
    frame: Gain[str] = choice_gain(FRAMES)
    bandwidth: Gain[float] = scalar_gain()
    damping_ratio: Gain[float] = scalar_gain()
    approach_speed: Gain[float | None] = optional_gain(1e-6, 10.0)
    contact_force: Gain[float | None] = optional_gain(1e-6, math.inf)

    def __init__(
        self,
        arm: Arm,
        force: Mapping[str, float],
        *,
        frame: str = "world",
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        approach_speed: float | None = None,
        contact_force: float | None = None,
    ):
        """A hybrid force controller for an arm.

        Args:
            force: The target force, N along "x", "y", "z" and N m about "rx", "ry", "rz"; all other axes follow the motion.
                `{"z": -20.0}` presses down with 20 N.
            frame: "world" for axes of the world, "tip" for axes that turn with the tip.
            bandwidth: rad/s, of the tip's error along motion axes.
            damping_ratio: 1 is critically damped.
            approach_speed: m/s (rad/s about an axis) until the tip touches. By default the impact on a wall ten times stiffer
                than MuJoCo's default is weaker than the target; at most 0.05 m/s.
            contact_force: N, the measured force that counts as a contact; a tenth of the target by default. Choose it above
                the noise and the bias of the sensor.

        Raises:
            UnknownNameError: There is no such axis or frame.
        """
        super().__init__(arm)
        self.frame = frame
        self.bandwidth = bandwidth
        self.damping_ratio = damping_ratio
        self.approach_speed = approach_speed
        self.contact_force = contact_force
        self.force = force

    @property
    def force(self) -> dict[str, float]:
        """The target forces along the force axes, N and N m. It can be replaced during a run; other axes move."""
        return dict(self._force)

    @force.setter
    def force(self, force: Mapping[str, float]) -> None:
        if not isinstance(force, Mapping) or not force:
            raise InputError(f"force: expected a table of axes, got {shown(force)}; {{'z': -20.0}} presses down with 20 N")
        targets = {}
        for name, target in force.items():
            if name not in AXES:
                raise UnknownNameError.from_known("axis", name, AXES)
            if AXES.index(name) >= task_rows(self._arm).stop:
                raise InputError(f"force: an arm of {self.n} joints controls no moments, so {name} cannot be a force axis")
            targets[name] = number(f"force along {name}", target)
        self._force = targets
        if isinstance(self._law, _core.HybridForce):
            self._law.set_axes(**self._axes())  # an axis that comes back later begins with an approach

    @property
    def in_contact(self) -> bool:
        """Whether every force axis is in contact."""
        if isinstance(self._law, _core.HybridForce):
            return self._law.in_contact
        return not any(self._force.values())

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        return _core.HybridForce(
            self._model(dt, continuous),
            bandwidth=self.bandwidth,
            damping_ratio=self.damping_ratio,
            in_tip_frame=self.frame == "tip",
            approach_speed=self.approach_speed or 0.0,
            contact_force=self.contact_force or 0.0,
            dt=dt,
            **self._axes(),
        )

    def _axes(self) -> _ForceAxes:
        """Of each axis whether it is a force axis, (6,), and its target, (6,) N and N m."""
        is_force = np.array([name in self._force for name in AXES], dtype=np.int64)
        return {"is_force": is_force, "targets": np.array([self._force.get(name, 0.0) for name in AXES])}
