"""The peers of `planning.py`: OMPL and roboplan on the same problems; None where they are not installed.

OMPL's RRT-Connect checks states with armctl's own distances, through Python, at a resolution of 0.5 % of the space. roboplan
gets the same geometry as a URDF: every geom as the mesh of its hull, round ones as polyhedra, with the same pairs.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

import armctl
from armctl._core import ShapeKind
from armctl.collision.checker import CollisionChecker
from armctl.collision.geometry import Shape

RESOLUTION = 0.005  # of the extent of the joint space, OMPL
STEP_RAD = 0.05  # between the checks of roboplan, its default
SECONDS = 10.0
Planner = Callable[[np.ndarray, np.ndarray], "np.ndarray | None"]  # from start and goal to the points of a path


def ompl_planner(arm: armctl.Arm, checker: CollisionChecker, clearance: float) -> Planner | None:
    """RRT-Connect and `simplifySolution` of OMPL."""
    try:
        from ompl import base, geometric, util
    except ImportError:
        return None
    util.setLogLevel(util.LogLevel.LOG_ERROR)
    n = arm.n

    def plan(start: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        space = base.RealVectorStateSpace(n)
        bounds = base.RealVectorBounds(n)
        for i in range(n):
            bounds.setLow(i, float(arm.limits.q_min[i]))
            bounds.setHigh(i, float(arm.limits.q_max[i]))
        space.setBounds(bounds)
        setup = geometric.SimpleSetup(space)
        q = np.empty(n)

        def is_valid(state) -> bool:
            for i in range(n):
                q[i] = state[i]
            return checker.hit(q, clearance) < 0

        setup.setStateValidityChecker(is_valid)
        setup.getSpaceInformation().setStateValidityCheckingResolution(RESOLUTION)
        ends = []
        for numbers in (start, goal):
            state = space.allocState()
            for i in range(n):
                state[i] = float(numbers[i])
            ends.append(state)
        setup.setStartAndGoalStates(ends[0], ends[1])
        setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
        if not setup.solve(SECONDS):
            return None
        setup.simplifySolution()
        states = setup.getSolutionPath().getStates()
        return np.array([[state[i] for i in range(n)] for state in states])

    return plan


def roboplan_planner(arm: armctl.Arm, checker: CollisionChecker) -> Planner | None:
    """RRT-Connect and shortcuts of roboplan."""
    try:
        from roboplan.core import (
            JointConfiguration,
            PathShortcutter,
            PathShortcuttingOptions,
            Scene,
            loadUrdfSceneDescription,
        )
        from roboplan.rrt import RRT, RRTOptions
    except ImportError:
        return None
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arm.urdf"
        file.write_text(_urdf(arm, checker, Path(folder)))
        scene = Scene("arm", loadUrdfSceneDescription(str(file)))
    geometry = checker.geometry
    count = len(geometry.geom_ids)
    wanted = {tuple(sorted(pair)) for pair in geometry.pairs.tolist()}
    names = [f"g{i}" for i in range(count)]
    off = [(names[a], names[b]) for a in range(count) for b in range(a + 1, count) if (a, b) not in wanted]
    scene.setCollisions(off, False)
    joints = [f"j{i}" for i in range(arm.n)]
    scene.addGroup("arm", joints)
    reference = geometry.frames.references
    planner = RRT(scene, RRTOptions("arm", max_nodes=20_000, rrt_connect=True, collision_check_step_size=STEP_RAD))
    planner.setRngSeed(0)
    shortcutter = PathShortcutter(scene, PathShortcuttingOptions("arm", max_step_size=STEP_RAD))

    def plan(start: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        try:
            path = planner.plan(JointConfiguration(joints, start - reference), JointConfiguration(joints, goal - reference))
            return np.array(shortcutter.shortcut(path).positions) + reference
        except RuntimeError:
            return None

    return plan


def _urdf(arm: armctl.Arm, checker: CollisionChecker, folder: Path) -> str:
    """The arm and its scene: frames parallel to the world at the reference configuration, a link for each geom."""
    geometry = checker.geometry
    mass = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    parts = [f'<link name="f0">{mass}</link>']
    anchors = [np.zeros(3)]
    frames = geometry.frames
    for i, parent in enumerate(frames.parents):
        anchors.append(frames.anchors[i])
        low = arm.limits.q_min[i] - frames.references[i]
        high = arm.limits.q_max[i] - frames.references[i]
        parts.append(
            f'<link name="f{i + 1}">{mass}</link><joint name="j{i}" type="revolute"><parent link="f{parent}"/>'
            f'<child link="f{i + 1}"/><origin xyz="{_numbers(anchors[i + 1] - anchors[parent])}"/>'
            f'<axis xyz="{_numbers(frames.axes[i])}"/>'
            f'<limit lower="{low}" upper="{high}" effort="100" velocity="2"/></joint>'
        )
    for g, shape in enumerate(geometry.shapes):
        frame = shape.frame
        file = folder / f"g{g}.stl"
        _write_stl(file, _vertices(shape) - anchors[frame])
        parts.append(
            f'<link name="g{g}"><collision><geometry><mesh filename="{file}"/></geometry></collision></link>'
            f'<joint name="to_g{g}" type="fixed"><parent link="f{frame}"/><child link="g{g}"/></joint>'
        )
    return f'<robot name="arm">{"".join(parts)}</robot>'


def _vertices(shape: Shape) -> np.ndarray:
    """(V, 3) m, the vertices of a geom or of a polyhedron inside a round one."""
    i = np.arange(200) + 0.5
    polar = np.arccos(1.0 - 2.0 * i / 200)
    turn = np.pi * (1.0 + np.sqrt(5.0)) * i
    sphere = np.column_stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])
    if shape.kind in (ShapeKind.HULL, ShapeKind.BOX):
        if shape.inflation == 0.0:
            return shape.vertices
        return (shape.vertices[:, None] + shape.inflation * sphere).reshape(-1, 3)
    if shape.kind == ShapeKind.ELLIPSOID:
        return shape.position + (sphere * shape.size) @ shape.rotation.T
    if shape.kind == ShapeKind.PLANE:
        raise armctl.ModelError("a plane has no mesh")
    radius, half_length = shape.size[:2]
    angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    ring = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    rims = [np.column_stack([ring, np.full(len(ring), side * half_length)]) for side in (-1, 1)]
    return shape.position + np.vstack(rims) @ shape.rotation.T


def _write_stl(file: Path, vertices: np.ndarray) -> None:
    hull = ConvexHull(vertices)
    triangles = vertices[hull.simplices]
    normals = hull.equations[:, :3]
    turned = np.einsum("ij,ij->i", np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), normals) < 0
    triangles[turned] = triangles[turned][:, ::-1]
    record = np.zeros(len(triangles), [("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attribute", "<u2")])
    record["normal"] = normals
    record["vertices"] = triangles
    file.write_bytes(b"\0" * 80 + np.uint32(len(triangles)).tobytes() + record.tobytes())


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.12g}" for value in values)
