"""ISO 9283: performance criteria of industrial robots, measured in simulation.

ISO 9283:1998, "Manipulating industrial robots - Performance criteria and related test methods". `iso9283_figures` computes the
figures; here are the test cycles.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from math import nan

import numpy as np

from armctl.control import controller_by_name
from armctl.control.interface import Controller, traits
from armctl.core.errors import PlanError
from armctl.core.json_values import json_value
from armctl.core.log import Log
from armctl.core.pose import Pose, computed_pose
from armctl.core.result import Verdict
from armctl.core.validation import Array, integer, number
from armctl.lab.iso9283_figures import (
    PLANES_OF_WHOLE,
    accuracy,
    cornering,
    deviations_in_planes,
    distance,
    drift,
    orientation,
    path_speed,
    posing_time,
    stabilisation,
    turn_between,
)
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.collision.checkers import collision_checker
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.move_cartesian import move_l, move_path
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.run.sim.plant import NOMINAL, Plant, Push
from armctl.run.sim.simulate import simulate
from armctl.run.sim.simulation import Simulation

_EDGES = 0.4 * 0.8 ** np.arange(12)  # m, of the test cube: the largest that the arm can work in
_CORNERS = np.array([[1, 1, 1], [1, -1, -1], [-1, -1, -1], [-1, 1, 1]])  # of the cube's inclined plane C1-C2-C7-C8
_INSET = 0.8  # the poses are a tenth of the diagonal inside the corners
_IK_TOLERANCE = 1e-9  # m, rad
_ORDER = (0, 4, 3, 2, 1, 0)  # P1 P5 P4 P3 P2 P1
_CORNER_BLEND = 0.1  # of the edge of the cube
_CRUISE_RATIO = 0.5  # of the largest speed on the line: below it the speed is constant on most of the line
_POSING_DISTANCES_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
_COMPLIANCE_SETTLING_S = 1.0
_DWELL_S = 0.5  # at each pose before it is measured
_BAND_M = 1e-4  # the tip is stable while its distance from the attained position is at most this
_LOAD_N = 10.0  # at the tip, for the static compliance
_Triple = tuple[float, float, float]
_NO_TRIPLE: _Triple = (nan, nan, nan)


@dataclass(frozen=True)
class Iso9283(Verdict):
    """The figures of one arm under one controller, each the worst of the five poses or of the path.

    Attributes:
        ok: Whether all cycles were run.
        reason: The reason if it is not ok; empty if it is.
        plant: The differences of the plant from the model.
        cycles: Number of cycles through the five poses.
        path_cycles: Number of cycles along the path.
        speed: Fraction of the maximum speed.
        cube_m: Edge of the test cube.
        band_m: The tip is stable while its distance from the attained position is at most this.
        pose_accuracy_m: 7.2, AP, the distance of the mean attained position from the commanded one.
        pose_repeatability_m: 7.2, RP, mean distance from the mean attained position plus three standard deviations.
        orientation_accuracy_rad: 7.2, AP_a, AP_b, AP_c about the world's x, y and z.
        orientation_repeatability_rad: 7.2, RP_a, RP_b, RP_c.
        distance_accuracy_m: 7.3, AD, of the distance between P2 and P4.
        distance_repeatability_m: 7.3, RD.
        stabilisation_time_s: 7.4, time from the first entry into the band to the last.
        overshoot_m: 7.5, the largest distance from the attained position after the first entry, if the tip leaves
            the band again.
        drift_m: 7.6, the change of AP from the first to the last third of the cycles.
        path_accuracy_m: 8.2, AT, the distance of the mean path from the commanded line, in ten planes normal to it, at 5, 15,
            ... 95 % of the line.
        path_repeatability_m: 8.3, RT, as RP, in these planes.
        whole_path_accuracy_m: As AT, in 1000 planes from start to stop: no placement of planes gives more.
        whole_path_repeatability_m: As RT, in these planes.
        corner_round_off_m: 8.5, CR, at a corner of 90 degrees that is rounded within a tenth of the cube's edge.
        corner_overshoot_m: 8.5, CO, behind that corner.
        path_speed_m_s: The commanded constant speed on the line, for the next three figures.
        speed_accuracy: 8.6, AV, as a fraction of the commanded speed, as are the next two.
        speed_repeatability: 8.6, RV.
        speed_fluctuation: 8.6, FV.
        posing_times: 9, pairs of distance, m, and the time until the tip stays within the band, s.
        compliance_m_per_N: 10, static displacement by force along the world's x, y and z.
    """

    ok: bool
    reason: str
    robot: str
    controller: str
    plant: str
    cycles: int
    path_cycles: int
    speed: float
    cube_m: float
    band_m: float
    pose_accuracy_m: float = nan
    pose_repeatability_m: float = nan
    orientation_accuracy_rad: _Triple = _NO_TRIPLE
    orientation_repeatability_rad: _Triple = _NO_TRIPLE
    distance_accuracy_m: float = nan
    distance_repeatability_m: float = nan
    stabilisation_time_s: float = nan
    overshoot_m: float = nan
    drift_m: float = nan
    path_accuracy_m: float = nan
    path_repeatability_m: float = nan
    whole_path_accuracy_m: float = nan
    whole_path_repeatability_m: float = nan
    corner_round_off_m: float = nan
    corner_overshoot_m: float = nan
    path_speed_m_s: float = nan
    speed_accuracy: float = nan
    speed_repeatability: float = nan
    speed_fluctuation: float = nan
    posing_times: tuple[tuple[float, float], ...] = ()
    compliance_m_per_N: _Triple = _NO_TRIPLE

    def to_dict(self) -> dict[str, object]:
        """Every attribute by name, for JSON: NaN becomes None."""
        return json_value(asdict(self))

    def __str__(self) -> str:
        done = f"{self.cycles} cycles of 5 poses, {self.path_cycles} of the path" if self.ok else f"failed: {self.reason}"
        speeds = (self.speed_accuracy, self.speed_repeatability, self.speed_fluctuation)
        times = ", ".join(f"{time:.3f} s for {1e3 * distance:.0f} mm" for distance, time in self.posing_times)
        return "\n".join(
            [
                f"ISO 9283, {self.robot}, {self.controller}: {done}",
                f"  conditions              cube of {1e3 * self.cube_m:.0f} mm, {100 * self.speed:.0f} % speed, {self.plant}",
                f"  7.2 pose accuracy AP          {1e6 * self.pose_accuracy_m:.3g} um",
                f"  7.2 pose repeatability RP     {1e6 * self.pose_repeatability_m:.3g} um",
                f"  7.2 orientation accuracy      {_listed(1e6, self.orientation_accuracy_rad)} urad (AP_a, b, c)",
                f"  7.2 orientation repeatability {_listed(1e6, self.orientation_repeatability_rad)} urad (RP_a, b, c)",
                f"  7.3 distance accuracy AD      {1e6 * self.distance_accuracy_m:.3g} um",
                f"  7.3 distance repeatability RD {1e6 * self.distance_repeatability_m:.3g} um",
                f"  7.4 stabilisation time        {self.stabilisation_time_s:.3f} s into {1e6 * self.band_m:.0f} um",
                f"  7.5 overshoot                 {1e6 * self.overshoot_m:.3g} um",
                f"  7.6 drift of AP               {1e6 * self.drift_m:.3g} um",
                f"  8.2 path accuracy AT          {1e6 * self.path_accuracy_m:.3g} um in 10 planes at 5 to 95 % of the line, "
                f"{1e6 * self.whole_path_accuracy_m:.3g} um anywhere",
                f"  8.3 path repeatability RT     {1e6 * self.path_repeatability_m:.3g} um, "
                f"{1e6 * self.whole_path_repeatability_m:.3g} um anywhere",
                f"  8.5 corner round-off CR       {1e3 * self.corner_round_off_m:.3g} mm",
                f"  8.5 corner overshoot CO       {1e6 * self.corner_overshoot_m:.3g} um",
                f"  8.6 path velocity AV, RV, FV  {_listed(100, speeds)} % of {1e3 * self.path_speed_m_s:.0f} mm/s",
                f"  9   minimum posing time       {times or 'none'}",
                f"  10  static compliance x, y, z {_listed(1e6, self.compliance_m_per_N)} um/N",
            ]
        )


def iso9283_cycles(
    arm: Arm,
    controller: Controller | str = "computed-torque-observer",
    plant: Plant = NOMINAL,
    *,
    cycles: int = 30,
    path_cycles: int = 10,
    speed: float = 1.0,
) -> Iso9283:
    """Runs the standard's cycles: five poses on the inclined plane of a cube, a line, a corner, and loads at the tip.

    The centre of the cube is the tip's position at home. The cube is as large as the arm can work in, at most 0.4 m. Arms of
    six or more joints keep the tip's orientation. Without noise in the plant, repeatability means little.

    Args:
        cycles: Number of cycles through the poses; 30 in the standard.
        path_cycles: Number of cycles along the path; 10 in the standard.
        speed: Fraction of the maximum speed that the limits allow, in [0.001, 1].

    Returns:
        The figures; if a run fails, `ok` is False and `reason` says why.

    Raises:
        PlanError: The arm cannot work in any cube around its home.
        UnknownNameError: There is no such controller.
    """
    check_arm(arm)
    cycles = integer("cycles", cycles, 2)
    path_cycles = integer("path_cycles", path_cycles, 2)
    speed = number("speed", speed, 1e-3, 1.0)
    controller = controller_by_name(controller, arm) if isinstance(controller, str) else controller
    edge, points, q = _poses(arm)
    legs = [move_j(arm, q[a], q[b]).scaled(speed) for a, b in pairwise(_ORDER)]
    line = move_l(arm, q[1], _target(arm, points[3])).scaled(speed)
    back = move_j(arm, line(line.duration).q, q[1])

    simulation = Simulation(arm, controller, plant)
    tests = _Tests(simulation=simulation, points=points, q=q, line=line, back=back)
    figures: dict[str, object] = {}
    try:
        figures |= tests.poses(legs, cycles)
        figures |= tests.path(path_cycles)
        figures |= tests.corner(0.5 * _INSET * edge, path_cycles, speed)
        figures |= tests.path_velocity(path_cycles, speed)
        figures |= tests.posing(speed)
        figures |= compliance(arm, controller, plant)
        reason = ""
    except _RunFailed as failed:
        figures = {}
        reason = str(failed)
    return Iso9283(
        ok=not reason,
        reason=reason,
        robot=arm.name,
        controller=traits(controller).name,
        plant=str(plant),
        cycles=cycles,
        path_cycles=path_cycles,
        speed=speed,
        cube_m=edge,
        band_m=_BAND_M,
        **figures,  # type: ignore[arg-type]
    )


class _RunFailed(Exception):
    """A run of a test ended early."""


@dataclass(frozen=True)
class _Tests:
    """The test cycles of one arm: five points (5, 3) m, q (5, n) rad there, and the line from P2 to P4 and back."""

    simulation: Simulation
    points: Array
    q: Array
    line: JointTrajectory
    back: JointTrajectory

    def poses(self, legs: list[JointTrajectory], cycles: int) -> dict[str, object]:
        """Clauses 7.2 to 7.6."""
        logs = _runs(self.simulation, self.q[0], legs * cycles)
        shape = (cycles, len(_ORDER) - 1, -1)
        attained = np.array([log.tip[-1] for log in logs]).reshape(shape)
        turned = np.array([turn_between(log.tip_ref_quat[-1], log.tip_quat[-1]) for log in logs])
        offsets = attained - self.points[list(_ORDER[1:])]
        pose = accuracy(offsets)
        angles = orientation(turned.reshape(shape))
        at_p2 = attained[:, _ORDER[1:].index(1)]
        at_p4 = attained[:, _ORDER[1:].index(3)]
        apart = distance(at_p2, at_p4, float(np.linalg.norm(self.points[1] - self.points[3])))
        stable = np.max([stabilisation(log, _BAND_M) for log in logs], axis=0)
        return {
            "pose_accuracy_m": pose.accuracy,
            "pose_repeatability_m": pose.repeatability,
            "orientation_accuracy_rad": angles[0],
            "orientation_repeatability_rad": angles[1],
            "distance_accuracy_m": apart.accuracy,
            "distance_repeatability_m": apart.repeatability,
            "stabilisation_time_s": float(stable[0]),
            "overshoot_m": float(stable[1]),
            "drift_m": drift(offsets),
        }

    def path(self, cycles: int) -> dict[str, object]:
        """Clauses 8.2 and 8.3."""
        logs = _runs(self.simulation, self.q[1], [self.line, self.back] * cycles)[::2]
        ends = self.points[1], self.points[3]
        duration = self.line.duration
        spread = accuracy(np.array([deviations_in_planes(log, *ends, duration) for log in logs]))
        whole = accuracy(np.array([deviations_in_planes(log, *ends, duration, PLANES_OF_WHOLE) for log in logs]))
        return {
            "path_accuracy_m": spread.accuracy,
            "path_repeatability_m": spread.repeatability,
            "whole_path_accuracy_m": whole.accuracy,
            "whole_path_repeatability_m": whole.repeatability,
        }

    def corner(self, half_edge: float, cycles: int, speed: float) -> dict[str, object]:
        """Clause 8.5, around P3; no figures if the arm cannot follow the lines to it."""
        arm = self.simulation.arm
        blend = 2 * _CORNER_BLEND * half_edge
        lines = [_target(arm, point) for point in self.points[2:4]]
        try:
            around = move_path(arm, self.q[1], lines, blend=blend).scaled(speed)
            back = move_j(arm, around(around.duration).q, self.q[1])
        except PlanError:
            return {}
        logs = _runs(self.simulation, self.q[1], [around, back] * cycles)[::2]
        found = cornering(logs, self.points[2], self.points[3], blend)
        return {"corner_round_off_m": found.round_off, "corner_overshoot_m": found.overshoot}

    def path_velocity(self, cycles: int, speed: float) -> dict[str, object]:
        """Clause 8.6, on the line from P2 to P4 at a constant speed."""
        arm = self.simulation.arm
        length = float(np.linalg.norm(self.points[3] - self.points[1]))
        cruise = _CRUISE_RATIO * length / self.line.duration
        line = move_l(arm, self.q[1], _target(arm, self.points[3]), tip_speed=cruise / speed).scaled(speed)
        logs = _runs(self.simulation, self.q[1], [line, self.back] * cycles)[::2]
        found = path_speed(logs, self.points[1], self.points[3], line.duration, cruise)
        return {
            "path_speed_m_s": cruise,
            "speed_accuracy": found.accuracy,
            "speed_repeatability": found.repeatability,
            "speed_fluctuation": found.fluctuation,
        }

    def posing(self, speed: float) -> dict[str, object]:
        """Clause 9, from P2 toward P4."""
        arm = self.simulation.arm
        way = self.points[3] - self.points[1]
        length = float(np.linalg.norm(way))
        times = []
        for apart in _POSING_DISTANCES_M:
            if apart > length:
                break
            there = move_l(arm, self.q[1], _target(arm, self.points[1] + apart / length * way)).scaled(speed)
            log = _runs(self.simulation, self.q[1], [there])[0]
            times.append((apart, posing_time(log, _BAND_M)))
        return {"posing_times": tuple(times)}


def compliance(arm: Arm, controller: Controller, plant: Plant) -> dict[str, object]:
    """Clause 10, at home: displacement by a force along each axis, in both directions, after it has settled."""
    hold = move_j(arm, arm.limits.clamp(arm.home), arm.limits.clamp(arm.home))
    compliance = []
    for direction in np.eye(3):
        ends = []
        for sign in (1.0, -1.0):
            push = Push(0.0, 10 * _COMPLIANCE_SETTLING_S, force=sign * _LOAD_N * direction)
            log = simulate(arm, controller, hold, replace(plant, pushes=(*plant.pushes, push)), _COMPLIANCE_SETTLING_S)  # type: ignore[misc]
            if log.failure:
                raise _RunFailed(log.failure)
            ends.append(log.tip[-len(log) // 10 :].mean(axis=0))
        compliance.append(float((ends[0] - ends[1]) @ direction / (2 * _LOAD_N)))
    return {"compliance_m_per_N": tuple(compliance)}


def _listed(scale: float, values: _Triple) -> str:
    return ", ".join("<0.001" if abs(scale * value) < 1e-3 else f"{scale * value:.3g}" for value in values)


def _poses(arm: Arm) -> tuple[float, Array, Array]:
    """The cube's edge, the five commanded points (5, 3), and where the joints are there (5, n)."""
    center = arm.fk(arm.home).position
    for edge in _EDGES:
        points = center + 0.5 * _INSET * edge * np.vstack([np.zeros(3), _CORNERS])
        q = [arm.limits.clamp(arm.home)]
        for point in points[1:]:
            found = solve_ik(
                arm,
                _target(arm, point),
                q[0],
                position_tolerance=_IK_TOLERANCE,
                orientation_tolerance=_IK_TOLERANCE,
                nearest=True,
                avoid=True,
            )
            if not found.ok:
                break
            q.append(found.q)
        if len(q) == len(points):
            ways = [a + share * (b - a) for a, b in pairwise([q[k] for k in _ORDER]) for share in np.linspace(0, 1, 20)]
            if not collision_checker(arm).along(np.array(ways)):
                return float(edge), points, np.array(q)
    raise PlanError(f"{arm.name}: it cannot work in a cube of {1e3 * _EDGES[-1]:.0f} mm around its tip at home")


def _target(arm: Arm, point: Array) -> Pose | Array:
    """A point with the orientation of home, for arms that can have both."""
    home = arm.fk(arm.home)
    return computed_pose(point, home.rotation) if arm.n >= 6 else point


def _runs(simulation: Simulation, q: Array, motions: list[JointTrajectory]) -> list[Log]:
    simulation.reset(q)
    logs: list[Log] = []
    for motion in motions:
        logs.append(simulation.run(motion, _DWELL_S))
        if logs[-1].failure:
            raise _RunFailed(logs[-1].failure)
    return logs
