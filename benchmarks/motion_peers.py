"""The peers of `motion.py` for timing along a path: TOPP-RA of toppra, Drake and roboplan; None where they are not installed.

All get the same points of a joint path and the same limits on speed and acceleration, and none of them limits the jerk. toppra
and Drake take the same cubic spline and the same grid. roboplan joins the points by lines and blends the corners; through many
points its splines are up to 28 times slower.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

import armctl

GRID = 1000  # points
SAMPLE_S = 1e-3

Array = np.ndarray


class Timed(NamedTuple):
    """A timed path.

    Attributes:
        q: (k, n) rad, at every millisecond.
        duration: s.
        seconds: s of CPU that it took.
    """

    q: Array
    duration: float
    seconds: float


Timer = Callable[[Array, Array], Timed]


def toppra_timer(arm: armctl.Arm) -> Timer | None:
    """Times points (k, n) at places (k,) along a path with toppra."""
    try:
        import toppra
        from toppra.algorithm import TOPPRA
        from toppra.constraint import DiscretizationType, JointAccelerationConstraint, JointVelocityConstraint
    except ImportError:
        return None
    v = arm.limits.v_max
    a = arm.limits.a_max
    constraints = [
        JointVelocityConstraint(np.column_stack([-v, v])),
        JointAccelerationConstraint(np.column_stack([-a, a]), discretization_scheme=DiscretizationType.Interpolation),
    ]

    def timed(q: Array, s: Array) -> Timed:
        began = time.process_time()
        path = toppra.SplineInterpolator(s, q)
        grid = np.linspace(s[0], s[-1], GRID)
        found = TOPPRA(constraints, path, gridpoints=grid, solver_wrapper="seidel").compute_trajectory(0, 0)
        seconds = time.process_time() - began
        return Timed(np.array(found(np.arange(0.0, found.duration, SAMPLE_S))), float(found.duration), seconds)

    return timed


def drake_timer(arm: armctl.Arm) -> Timer | None:
    """As `toppra_timer`, with Drake; its plant only counts the joints."""
    try:
        from pydrake.multibody.optimization import Toppra
        from pydrake.multibody.plant import MultibodyPlant
        from pydrake.multibody.tree import RevoluteJoint, SpatialInertia
        from pydrake.trajectories import PiecewisePolynomial
    except ImportError:
        return None
    plant = MultibodyPlant(0.0)
    parent = plant.world_body()
    for i in range(arm.n):
        body = plant.AddRigidBody(f"link{i}", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        frames = (parent.body_frame(), body.body_frame())
        plant.AddJoint(RevoluteJoint(f"joint{i}", *frames, [0.0, 0.0, 1.0]))
        parent = body
    plant.Finalize()

    def timed(q: Array, s: Array) -> Timed:
        began = time.process_time()
        path = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(s, q.T, False)
        problem = Toppra(path, plant, np.linspace(s[0], s[-1], GRID))
        problem.AddJointVelocityLimit(-arm.limits.v_max, arm.limits.v_max)
        problem.AddJointAccelerationLimit(-arm.limits.a_max, arm.limits.a_max)
        place = problem.SolvePathParameterization()
        seconds = time.process_time() - began
        times = np.arange(place.start_time(), place.end_time(), SAMPLE_S)
        samples = path.vector_values(place.vector_values(times)[0]).T
        return Timed(samples, place.end_time() - place.start_time(), seconds)

    return timed


def roboplan_timer(arm: armctl.Arm) -> Timer | None:
    """As `toppra_timer`, with roboplan; the places along the path are its own."""
    try:
        from roboplan.core import JointPath, Scene, loadJointLimitsConfig, loadUrdfSceneDescription
        from roboplan.toppra import PathParameterizerTOPPRA, SplineFittingMode, TOPPRAOptions
    except ImportError:
        return None
    names = [f"joint{i}" for i in range(arm.n)]
    rows = zip(names, arm.limits.v_max, arm.limits.a_max, strict=True)
    limits = "".join(f"  {name}:\n    max_velocity: [{v}]\n    max_acceleration: [{a}]\n" for name, v, a in rows)
    with tempfile.TemporaryDirectory() as folder:
        urdf = Path(folder) / "arm.urdf"
        urdf.write_text(_urdf(arm, names), encoding="utf-8")
        config = Path(folder) / "limits.yaml"
        config.write_text(f"joint_limits:\n{limits}", encoding="utf-8")
        scene = Scene("arm", loadUrdfSceneDescription(str(urdf)))
        scene.importJointLimitsFromConfig(loadJointLimitsConfig(str(config)))
    scene.addGroup("arm", names)
    assert np.allclose(scene.getVelocityLimitVectors("arm")[1], arm.limits.v_max)
    assert np.allclose(scene.getAccelerationLimitVectors("arm")[1], arm.limits.a_max)
    planner = PathParameterizerTOPPRA(scene, "arm")

    def timed(q: Array, s: Array) -> Timed:
        path = JointPath()
        path.joint_names = names
        path.positions = list(q)
        began = time.process_time()
        found = planner.generate(path, TOPPRAOptions(dt=SAMPLE_S, mode=SplineFittingMode.LinearBlend))
        seconds = time.process_time() - began
        return Timed(np.array(found.positions), float(found.times[-1]), seconds)

    return timed


def _urdf(arm: armctl.Arm, names: list[str]) -> str:
    """A chain of links without geometry, whose joints have the arm's limits."""
    inertial = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    parts = [f'<link name="link0">{inertial}</link>']
    for i, name in enumerate(names):
        parts.append(
            f'<link name="link{i + 1}">{inertial}</link><joint name="{name}" type="revolute"><parent link="link{i}"/>'
            f'<child link="link{i + 1}"/><axis xyz="0 0 1"/><limit lower="{arm.limits.q_min[i]}" '
            f'upper="{arm.limits.q_max[i]}" effort="100" velocity="{arm.limits.v_max[i]}"/></joint>'
        )
    return f'<robot name="arm">{"".join(parts)}</robot>'


TIMERS: dict[str, Callable[[armctl.Arm], Timer | None]] = {
    "toppra": toppra_timer,
    "Drake": drake_timer,
    "roboplan": roboplan_timer,
}
