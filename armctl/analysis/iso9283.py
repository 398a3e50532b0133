"""ISO 9283: pose accuracy and repeatability, stabilisation time and path accuracy, measured in simulation.

ISO 9283:1998, "Manipulating industrial robots - Performance criteria and related test methods", clauses 7.2 (pose accuracy and
repeatability), 7.4 (stabilisation time), 7.5 (overshoot) and 8.2 (path accuracy and repeatability).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import pairwise

import numpy as np

from armctl.collision.checkers import collision_checker
from armctl.control import Controller, controller_by_name, controller_name
from armctl.core.errors import PlanError
from armctl.core.log import Log
from armctl.core.pose import Pose
from armctl.core.validation import Array, integer, number
from armctl.ik import solve_ik
from armctl.motion import JointTrajectory, move_j, move_l
from armctl.robot.arm import Arm
from armctl.sim.plant import NOMINAL, Plant
from armctl.sim.simulation import Simulation

_EDGES = 0.4 * 0.8 ** np.arange(12)  # m, of the test cube: the largest that the arm can work in
_CORNERS = np.array([[1, 1, 1], [1, -1, -1], [-1, -1, -1], [-1, 1, 1]])  # of the cube's inclined plane C1-C2-C7-C8
_INSET = 0.8  # the poses are a tenth of the diagonal inside the corners
_IK_TOLERANCE = 1e-9  # m, rad
_ORDER = (0, 4, 3, 2, 1, 0)  # P1 P5 P4 P3 P2 P1
_FIGURES = (
    "pose_accuracy_m",
    "pose_repeatability_m",
    "stabilisation_time_s",
    "overshoot_m",
    "path_accuracy_m",
    "path_repeatability_m",
)


@dataclass(frozen=True)
class Iso9283:
    """The figures of one arm under one controller, each the worst of the five poses or of the path.

    Attributes:
        ok: Whether all cycles were run.
        reason: Why not, in words; empty if `ok`.
        robot: The arm's name.
        controller: The controller's name.
        plant: How the plant differed from the model, in words.
        cycles: Number of cycles through the five poses.
        path_cycles: Number of cycles along the path.
        speed: Fraction of the maximum speed.
        cube_m: Edge of the test cube.
        band_m: The tip is stable while its distance from the attained position is at most this.
        pose_accuracy_m: AP, the distance of the mean attained position from the commanded one.
        pose_repeatability_m: RP, mean distance from the mean attained position plus three standard deviations.
        stabilisation_time_s: Time from the first entry into the band to the last.
        overshoot_m: The largest distance from the attained position after the first entry, if the tip leaves the band again.
        path_accuracy_m: AT, the distance of the mean path from the commanded line, in planes normal to it.
        path_repeatability_m: RT, as RP, in these planes.
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
    pose_accuracy_m: float
    pose_repeatability_m: float
    stabilisation_time_s: float
    overshoot_m: float
    path_accuracy_m: float
    path_repeatability_m: float

    def __bool__(self) -> bool:
        return self.ok

    def to_dict(self) -> dict[str, object]:
        """The figures by name, for JSON: NaN becomes None.

        Returns:
            Every attribute.
        """
        return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in asdict(self).items()}

    def __str__(self) -> str:
        done = f"{self.cycles} cycles of 5 poses, {self.path_cycles} of the path" if self.ok else f"failed: {self.reason}"
        return "\n".join(
            [
                f"ISO 9283, {self.robot}, {self.controller}: {done}",
                f"  conditions              cube of {1e3 * self.cube_m:.0f} mm, {100 * self.speed:.0f} % speed, {self.plant}",
                f"  pose accuracy AP        {1e6 * self.pose_accuracy_m:.3g} um",
                f"  pose repeatability RP   {1e6 * self.pose_repeatability_m:.3g} um",
                f"  stabilisation time      {self.stabilisation_time_s:.3f} s into {1e6 * self.band_m:.0f} um",
                f"  overshoot               {1e6 * self.overshoot_m:.3g} um",
                f"  path accuracy AT        {1e6 * self.path_accuracy_m:.3g} um",
                f"  path repeatability RT   {1e6 * self.path_repeatability_m:.3g} um",
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
    dwell: float = 0.5,
    band: float = 1e-4,
) -> Iso9283:
    """Runs the standard's cycles: five poses on the inclined plane of a cube, and the line across it.

    The centre of the cube is the tip's position at home. The cube is as large as the arm can work in, at most 0.4 m. Arms of
    six or more joints keep the tip's orientation. Without noise in the plant, repeatability means little.

    Args:
        arm: The arm.
        controller: A controller or the name of one.
        plant: The simulated plant.
        cycles: Number of cycles through the poses; 30 in the standard.
        path_cycles: Number of cycles along the path; 10 in the standard.
        speed: Fraction of the maximum speed that the limits allow, in [0.001, 1].
        dwell: s at each pose before it is measured, at least 0.05.
        band: m; the tip is stable while its distance from the attained position is at most this.

    Returns:
        The figures; if a run fails, `ok` is False and `reason` says why.

    Raises:
        InputError: An argument is out of its bounds.
        PlanError: The arm cannot work in any cube around its home.
        UnknownNameError: There is no such controller.
    """
    cycles = integer("cycles", cycles, 2)
    path_cycles = integer("path_cycles", path_cycles, 2)
    speed = number("speed", speed, 1e-3, 1.0)
    dwell = number("dwell", dwell, 0.05)
    band = number("band", band, 1e-9)
    controller = controller_by_name(controller, arm) if isinstance(controller, str) else controller
    edge, points, q = _poses(arm)
    legs = [move_j(arm, q[a], q[b]).scaled(speed) for a, b in pairwise(_ORDER)]
    line = move_l(arm, q[1], _target(arm, points[3])).scaled(speed)
    back = move_j(arm, line(line.duration).q, q[1])

    simulation = Simulation(arm, controller, plant)
    stops = _runs(simulation, q[0], legs * cycles, dwell)
    paths = _runs(simulation, q[1], [line, back] * path_cycles, dwell)[::2]
    reason = next((log.failure for log in [*stops, *paths] if log.failure), "")
    figures = dict.fromkeys(_FIGURES, float("nan")) if reason else _figures(stops, paths, points, line.duration, band)
    return Iso9283(
        ok=not reason,
        reason=reason,
        robot=arm.name,
        controller=controller_name(controller),
        plant=str(plant),
        cycles=cycles,
        path_cycles=path_cycles,
        speed=speed,
        cube_m=edge,
        band_m=band,
        **figures,
    )


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
                avoid_collisions=True,
            )
            if not found.ok:
                break
            q.append(found.q)
        if len(q) == len(points) and _is_free(arm, q):
            return float(edge), points, np.array(q)
    raise PlanError(f"{arm.name}: it cannot work in a cube of {1e3 * _EDGES[-1]:.0f} mm around its tip at home")


def _is_free(arm: Arm, q: list[Array]) -> bool:
    """Whether nothing touches on the ways between the poses."""
    ways = [a + share * (b - a) for a, b in pairwise([q[k] for k in _ORDER]) for share in np.linspace(0, 1, 20)]
    return not collision_checker(arm).along(np.array(ways))


def _target(arm: Arm, point: Array) -> Pose | Array:
    """A point with the orientation of home, for arms that can have both."""
    home = arm.fk(arm.home)
    return Pose.from_rotation(point, home.rotation) if arm.n >= 6 else point


def _runs(simulation: Simulation, q: Array, motions: list[JointTrajectory], dwell: float) -> list[Log]:
    """The logs of motions one after another, as far as they go."""
    simulation.reset(q)
    logs: list[Log] = []
    for motion in motions:
        logs.append(simulation.run(motion, dwell))
        if logs[-1].failure:
            break
    return logs


def _figures(stops: list[Log], paths: list[Log], points: Array, duration: float, band: float) -> dict[str, float]:
    attained = np.array([log.tip[-1] for log in stops]).reshape(-1, len(_ORDER) - 1, 3)
    pose = _accuracy(attained - points[list(_ORDER[1:])])
    stable = np.max([_stabilisation(log, band) for log in stops], axis=0)
    line = points[3] - points[1]
    offsets = np.array([log.tip[log.t <= duration] - points[1] for log in paths])
    across = offsets - (offsets @ line)[..., None] * line / (line @ line)
    return dict(zip(_FIGURES, (*pose, *stable.tolist(), *_accuracy(across)), strict=True))


def _accuracy(offsets: Array) -> tuple[float, float]:
    """AP and RP, or AT and RT, from offsets (cycles, k, 3) m: the worst of the k."""
    mean = offsets.mean(axis=0)
    apart = np.linalg.norm(offsets - mean, axis=2)
    repeatability = apart.mean(axis=0) + 3 * apart.std(axis=0, ddof=1)
    return float(np.linalg.norm(mean, axis=1).max()), float(repeatability.max())


def _stabilisation(log: Log, band: float) -> tuple[float, float]:
    """Stabilisation time, s, and overshoot, m: from the first entry into the band around the attained position to the last."""
    distance = np.linalg.norm(log.tip - log.tip[-1], axis=1)
    inside = distance <= band
    first_inside = int(inside.argmax())
    last_outside = -1 if inside.all() else int(np.flatnonzero(~inside)[-1])
    if last_outside < first_inside:
        return 0.0, 0.0
    return (last_outside + 1 - first_inside) * log.dt, float(distance[first_inside:].max())
