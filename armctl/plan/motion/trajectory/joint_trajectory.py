"""JointTrajectory, the result of every planner: piecewise polynomials of degree five in time for every joint."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.atomic import file_path
from armctl.core.errors import InputError, LimitError
from armctl.core.limits import Limits
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, frozen, instance, number, shown, vector
from armctl.model.arm.arm import Arm, check_arm
from armctl.plan.motion.trajectory import files, piecewise
from armctl.plan.motion.trajectory.limit_check import QUANTITIES, LimitCheck, check_limits
from armctl.plan.motion.trajectory.path_stop import speed_changed, stopped
from armctl.plan.motion.trajectory.piecewise import JointSamples, Pieces, basis, join_gaps

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_TABLE_ROWS = 10_000_000  # of a CSV file; a longer one is taken for a mistake in dt
_PLOT_SAMPLES = 1000


@dataclass(frozen=True)
class Slowdown:
    """Where the motors made a motion slower than its limits on speed, acceleration and jerk allow."""

    factor: float  # how many times longer the motion takes
    joint: str  # the joint that would have needed the largest share of its torque limit
    torque_ratio: float  # that share

    def __str__(self) -> str:
        return f"{self.factor:.3f} times longer, since {self.joint} would need {100 * self.torque_ratio:.0f} % of its torque"


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """A motion of n joints, continuous in position, velocity and acceleration. Immutable; an `armctl.Trajectory`.

    In piece k, with u = t - knots[k]: q(t) = sum over i of coefficients[k, i] u^i. Constant jerk is a cubic, so the profiles of
    an online trajectory generator are represented exactly; curved paths use all five degrees.

    Attributes:
        knots: (m + 1,) s, from 0 to the duration, not decreasing.
        coefficients: (m, 6, n) rad/s^i.
        joint_names: The n joints. `Simulation.run` and `check_torque` reject a motion of other joints.
        limits: The limits it was planned for.
        slowed: The factor and the joint, if torque limits make it slower than the limits of speed, acceleration and jerk.
        units: The unit of each joint, "rad" or "m"; all in rad if left out.

    Raises:
        InputError: The arrays do not fit each other, a number is not finite, or the knots decrease or do not start at 0.
    """

    knots: Array
    coefficients: Array
    joint_names: tuple[str, ...]
    limits: Limits
    slowed: Slowdown | None = None
    units: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        instance("limits", self.limits, Limits, "give arm.limits")
        for name in ("knots", "coefficients"):
            instance(name, getattr(self, name), np.ndarray, "give an array of float64")
        object.__setattr__(self, "units", self.units or ("rad",) * len(self.joint_names))
        piecewise.check_pieces(self.knots, self.coefficients, len(self.joint_names))
        frozen(self.knots)
        frozen(self.coefficients)

    @property
    def duration(self) -> float:
        """How long it takes, s."""
        return self._knot_list[-1]

    @property
    def n(self) -> int:
        """The number of joints."""
        return len(self.joint_names)

    @property
    def pieces(self) -> Pieces:
        """Its knots and coefficients."""
        return Pieces(self.knots, self.coefficients)

    @cached_property
    def _knot_list(self) -> list[float]:
        return self.knots.tolist()

    def __call__(self, t: float) -> Setpoint:
        """The setpoint at a time: q, v, a, each (n,).

        Args:
            t: s, clamped to [0, duration]; outside it the arm stands still at the end.

        Raises:
            InputError: The time is not a number.
        """
        knots = self._knot_list
        try:
            t = float(t)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"t: {shown(t)} is not a number") from None
        inside = min(max(t, 0.0), knots[-1])
        if inside != inside:
            raise InputError("t: expected a number, got NaN")
        k = min(bisect_right(knots, inside), len(knots) - 1) - 1
        u = inside - knots[k]
        q, v, a = np.array(basis(u)) @ self.coefficients[k]
        return Setpoint(q, v, a) if inside == t else Setpoint(q, np.zeros_like(v), np.zeros_like(a))

    def sample(self, times: ArrayLike) -> Setpoint:
        """The setpoints at many times at once: q, v, a, each (T, n).

        Args:
            times: (T,) s, each clamped to [0, duration].
        """
        return Setpoint(*piecewise.sample(self.pieces, vector("times", times)))

    def jerk(self, times: ArrayLike) -> Array:
        """The jerk at many times.

        Args:
            times: (T,) s, each clamped to [0, duration].

        Returns:
            (T, n) rad/s^3; where it jumps, the value just after.
        """
        return piecewise.jerk(self.pieces, vector("times", times))

    def check_limits(self, limits: Limits | None = None) -> LimitCheck:
        """Compares the exact extremes of the motion, also those between samples, with limits.

        Args:
            limits: The limits; its own if left out.

        Raises:
            InputError: The limits are not `Limits`, or not those of n joints.
        """
        if limits is None:
            limits = self.limits
        instance("limits", limits, Limits, "give arm.limits")
        if len(limits.q_min) != self.n:
            raise InputError(f"limits: they are for {len(limits.q_min)} joints, but the motion has {self.n}")
        return check_limits(self.pieces, limits, self.joint_names, self.units)

    def stopped_at(self, t: float) -> JointTrajectory:
        """The motion with a stop on its path, which it never leaves, as soon as the limits allow after a time.

        Args:
            t: s, when the stop is requested; until then nothing changes.

        Raises:
            InputError: The time is outside the motion.
            PlanError: The motion does not end at rest, and its remaining part is too short to stop.
        """
        return self._with(stopped(self.pieces, self.limits, number("t", t, 0.0, self.duration)))

    def overridden(self, t: float, factor: float) -> JointTrajectory:
        """The motion with another speed on its path from a time on: a speed override that changes during the motion.

        The speed changes smoothly, as soon as the limits on position, speed, acceleration and jerk allow; the path stays. A
        greater speed is reduced to what the rest of the motion allows. A motion that is about to end may change its speed less,
        or not at all, because its joints brake at their limits. Torque limits are not considered; `check_torque` shows the
        torques.

        Args:
            t: s, when the change is requested; until then nothing changes.
            factor: Of the speed, greater than 0.

        Raises:
            InputError: The time is outside the motion, or the factor is not greater than 0.
        """
        factor = number("factor", factor, 1e-3, 1e3)
        return self._with(speed_changed(self.pieces, self.limits, number("t", t, 0.0, self.duration), factor))

    def until(self, t: float) -> JointTrajectory:
        """The motion up to a time, where it may be moving: `then` appends what was planned from its state there.

        Args:
            t: s.
        """
        t = number("t", t, 0.0, self.duration)
        k = max(1, int(np.searchsorted(self.knots, t, side="left")))
        return self._with(Pieces(np.append(self.knots[:k], t), self.coefficients[:k]))

    def scaled(self, factor: float) -> JointTrajectory:
        """The same path at another speed, as the speed override of a robot controller.

        Args:
            factor: Of the speed, greater than 0; 0.5 takes twice as long.

        Raises:
            InputError: The factor is not greater than 0.
            LimitError: It is greater than 1, and a joint would leave its limits.
        """
        factor = number("factor", factor, 1e-9, 1e9)
        changed = self._with(piecewise.time_scaled(self.pieces, factor))
        if factor > 1.0 and not (check := changed.check_limits()).ok:
            raise LimitError(f"factor: {factor:g} is too fast: {check.violations[0]}")
        return changed

    def then(self, other: JointTrajectory) -> JointTrajectory:
        """This motion, and after it another one.

        Args:
            other: A motion that starts as this one ends: same position, velocity and acceleration.

        Raises:
            InputError: No such motion, other joints, or it starts elsewhere.
        """
        if not isinstance(other, JointTrajectory):
            raise InputError(f"then: {shown(other)} is not a JointTrajectory")
        if other.joint_names != self.joint_names:
            names = (", ".join(motion.joint_names) for motion in (other, self))
            raise InputError("then: a motion of {:.120} cannot follow one of {:.120}".format(*names))
        for what, end, start in zip(QUANTITIES[:3], self(self.duration)[:3], other(0.0)[:3], strict=True):
            gaps = join_gaps(end, start)
            if (gaps > 1.0).any():
                i = int(gaps.argmax())
                raise InputError(
                    f"then: {self.joint_names[i]}: the first motion ends at {what} {end[i]:.6g}, the second starts at "
                    f"{start[i]:.6g}; plan it from where the first one ends"
                )
        return joined([self, other])

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the motion, exactly, as a NumPy archive that `JointTrajectory.load` reads.

        An existing file is replaced atomically.

        Args:
            path: The file; its folder is created. A name without a suffix gets .npz.

        Raises:
            InputError: The name has another suffix.
            ArmctlError: The file cannot be written.
        """
        return files.save(path, self._content)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> JointTrajectory:
        """Reads a motion that `save` wrote, and checks it: shapes, finite numbers, increasing times, no jumps.

        Raises:
            InputError: There is no such file, or it holds no motion.
        """
        content = files.load(path)
        slowed = None
        if content.slowed:
            factor, joint, ratio = content.slowed
            try:
                slowed = Slowdown(number("slowed", float(factor)), joint, number("slowed", float(ratio)))
            except ValueError:
                raise InputError(f"{os.fspath(path)!s:.160}: it holds no trajectory (slowed is not a number)") from None
        return JointTrajectory(*content.pieces, content.joint_names, content.limits, slowed=slowed, units=content.units)

    def to_csv(self, path: str | os.PathLike[str], dt: float = 1e-3) -> Path:
        """Writes samples as a table: t, then q, v and a of each joint, named in the first row.

        Args:
            path: The file; its folder is created. A name without a suffix gets .csv.
            dt: s, from sample to sample; the end is always one.

        Raises:
            InputError: dt is not greater than 0 or gives more than ten million rows, or the name has another suffix.
            ArmctlError: The file cannot be written.
        """
        times = self._table_times(dt)
        return files.save_table(path, self.joint_names, times, JointSamples(*self.sample(times)[:3]))

    @staticmethod
    def from_csv(path: str | os.PathLike[str], arm: Arm, *, speed: float = 1.0) -> JointTrajectory:
        """Reads a motion that `to_csv` wrote, a log as CSV, or a recording, which then plays as it was recorded.

        The motion passes through all rows with their velocities and accelerations, if there are any, and otherwise along a
        cubic spline that starts and ends at rest. Accelerations and jerks are not limited, since noise makes them:
        `check_limits` shows them, and `time_path` makes a motion within all limits on the same path.

        Args:
            path: The file: a column `t`, s, and for each joint `q_<joint>`, `q/<joint>`, or `<joint>`, in rad (m); if there
                are, `v_<joint>` and `a_<joint>`, or with `/`. Other columns are ignored.
            arm: The arm; the order of its joints in the file is arbitrary.
            speed: Factor on the speed at which it plays; 0.5 takes twice as long.

        Raises:
            InputError: The file cannot be read, or lacks a column, or its times do not increase.
            LimitError: A row is outside the position limits, or at this speed outside those of the velocity.
        """
        check_arm(arm)
        factor = number("speed", speed, 1e-3, 1e3)
        from armctl.plan.motion.trajectory import recorded, ros

        points = recorded.read_waypoints(file_path("path", path, (".csv", ".txt", ".tsv")), arm.joint_names)
        arm.check_units("path: positions", points.q, "a motion has rad and m")
        pieces = ros.pieces(points)
        speeds = piecewise.sample(pieces, pieces.knots).v
        recorded.check_recorded(points, speeds, arm.limits, arm.units, factor)
        if factor != 1.0:
            pieces = piecewise.time_scaled(pieces, factor)
        return JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units)

    def to_ros(self, path: str | os.PathLike[str], dt: float = 0.01) -> Path:
        """Writes samples as a ROS message of type trajectory_msgs/JointTrajectory, with velocities and accelerations.

        Args:
            path: The file, .json or .yaml; its folder is created.
            dt: s, from point to point; the end is always one.

        Raises:
            InputError: dt is not greater than 0 or gives more than ten million points, or the name has another suffix.
            NotInstalledError: YAML needs the extra `ros`.
            ArmctlError: The file cannot be written.
        """
        times = self._table_times(dt)
        from armctl.plan.motion.trajectory import ros

        return ros.save(path, ros.message(self.joint_names, times, JointSamples(*self.sample(times)[:3])))

    @staticmethod
    def from_ros(source: str | os.PathLike[str] | Mapping[str, Any], arm: Arm) -> JointTrajectory:
        """Reads a ROS message of type trajectory_msgs/JointTrajectory, for example of a motion that MoveIt planned.

        The motion passes through all points with their velocities and accelerations, and starts at the first one. What the
        message does not contain is chosen such that velocity and acceleration are continuous. The limits of the arm are checked
        by `check_limits`; here, only positions far outside, such as degrees, are refused, and velocities or accelerations whose
        sum over time is ten times the change of what they are the rate of.

        Args:
            source: The file, .json or .yaml, or the message as a dict; also a message around it, such as a RobotTrajectory.
                Times may be numbers, in s. A point that repeats the one before is left out.
            arm: The arm; the order of the joints in the message is arbitrary. Other joints in it must not move.

        Raises:
            InputError: The file cannot be read, it is no such message, or it is one for other joints.
            LimitError: A position is half a turn (1 m) or more outside the limits.
            NotInstalledError: YAML needs the extra `ros`.
        """
        check_arm(arm)
        if isinstance(source, JointTrajectory):
            raise InputError("message: it is a motion of armctl already; `to_ros` makes a message of it")
        if hasattr(source, "get_fields_and_field_types") or hasattr(source, "joint_names"):
            raise InputError(
                f"message: expected a dict, got an object {shown(source)}; "
                "rosidl_runtime_py.message_to_ordereddict makes a dict of it"
            )
        from armctl.plan.motion.trajectory import ros

        points = ros.waypoints(source if isinstance(source, Mapping) else ros.load(source))
        order = ros.joint_order(points, arm.joint_names)
        arm.check_units("message: positions", points.q[:, order], "messages of ROS have rad and m")
        ros.check_rates(points)
        pieces = ros.pieces(points)
        return JointTrajectory(
            knots=pieces.knots,
            coefficients=pieces.coefficients[:, :, order],
            joint_names=arm.joint_names,
            limits=arm.limits,
            units=arm.units,
        )

    def plot(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        size: tuple[float, float] | None = None,
        ax: Sequence[Axes] | None = None,
    ) -> object:
        """Draws position, velocity, acceleration and jerk of every joint, the last three as shares of their limits.

        Args:
            path: Where to save the picture; left out, it is not saved.
            size: Width and height in inches.
            ax: Four axes of matplotlib to draw into instead.

        Returns:
            Matplotlib's figure; that of the axes, if there are some.

        Raises:
            InputError: The path is not a file name, its suffix is not a format of a picture, or the axes are not four.
            ArmctlError: The file cannot be written.
        """
        times = self._times(max(self.duration / _PLOT_SAMPLES, 1e-9))
        return files.plot(self._content, times, JointSamples(*self.sample(times)[:3]), self.jerk(times), path, size, ax)

    @property
    def _content(self) -> files.TrajectoryContent:
        slowed = () if self.slowed is None else (self.slowed.factor, self.slowed.joint, self.slowed.torque_ratio)
        texts = tuple(str(value) for value in slowed)
        return files.TrajectoryContent(self.pieces, self.joint_names, self.units, self.limits, texts)

    def _table_times(self, dt: float) -> Array:
        """Times of the rows of a table, as many as are sensible in a file."""
        dt = number("dt", dt, 1e-9)
        if self.duration / dt > _MAX_TABLE_ROWS:
            raise InputError(f"dt: {dt:g} s gives more than {_MAX_TABLE_ROWS} rows for a motion of {self.duration:g} s")
        return self._times(dt)

    def _times(self, dt: float) -> Array:
        """Times dt apart, and the duration."""
        return np.append(np.arange(0.0, self.duration - 1e-9 * dt, dt), self.duration)

    def _with(self, pieces: Pieces) -> JointTrajectory:
        return replace(self, knots=pieces.knots, coefficients=pieces.coefficients)

    def __reduce__(self):
        return JointTrajectory, (self.knots, self.coefficients, self.joint_names, self.limits, self.slowed, self.units)

    def __repr__(self) -> str:
        return f"JointTrajectory({self.n} joints, {self.duration:.3f} s)"


def joined(parts: Sequence[JointTrajectory]) -> JointTrajectory:
    """Motions one after another, each known to start as the one before it ends.

    The slowdown is that of the whole motion, with the joint of the part that is slowed down most.
    """
    pieces = piecewise.joined([part.pieces for part in parts])
    slowed = [part.slowed for part in parts if part.slowed is not None]
    total = None
    if slowed:
        largest = max(slowed, key=lambda slowdown: slowdown.factor)
        free = sum(part.duration / (1.0 if part.slowed is None else part.slowed.factor) for part in parts)
        total = replace(largest, factor=float(pieces.knots[-1]) / free)
    return replace(parts[0], knots=pieces.knots, coefficients=pieces.coefficients, slowed=total)
