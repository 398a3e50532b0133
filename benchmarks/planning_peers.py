"""The peers of `planning.py`: OMPL and roboplan on the same problems; None where they are not installed.

OMPL's RRT-Connect checks states with MuJoCo's contacts, through Python, at a resolution of 0.5 % of the space. roboplan gets
the same geometry as a URDF: every geom as the mesh of its hull, round ones as polyhedra, without the pairs that may touch.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

import armctl

RESOLUTION = 0.005  # of the extent of the joint space, OMPL
STEP_RAD = 0.05  # between the checks of roboplan, its default
SECONDS = 10.0
Planner = Callable[[np.ndarray, np.ndarray], "np.ndarray | None"]  # from start and goal to the points of a path


def ompl_planner(arm: armctl.Arm, is_free: Callable[[np.ndarray], bool]) -> Planner | None:
    """RRT-Connect and `simplifySolution` of OMPL, for states that are free."""
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
            return is_free(q)

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


def roboplan_planner(
    arm: armctl.Arm, allowed: set[tuple[int, int]], cubes: tuple[np.ndarray, float] | None = None
) -> Planner | None:
    """RRT-Connect and shortcuts of roboplan; `allowed` are the pairs of geoms that may touch.

    `cubes` are the centres (N, 3) m and the edge of occupied cubes, an octree.
    """
    try:
        from roboplan.core import (
            JointConfiguration,
            OcTree,
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
        file.write_text(_urdf(arm, Path(folder)))
        scene = Scene("arm", loadUrdfSceneDescription(str(file)))
    model = arm.model
    geoms = _colliding_geoms(model).tolist()
    moved_by = _frames(arm)
    off = [
        (f"g{a}", f"g{b}")
        for a in geoms
        for b in geoms
        if a < b and ((a, b) in allowed or not _are_tested(model, moved_by, a, b))
    ]
    scene.setCollisions(off, False)
    if cubes is not None:
        centres, edge = cubes
        occupied = np.column_stack([centres, np.tile([edge, 1.0, 0.5], (len(centres), 1))])
        scene.addOcTreeGeometry("cubes", "f0", OcTree(list(occupied), edge), np.eye(4, order="F"), np.ones(4))
    joints = [f"j{i}" for i in range(arm.n)]
    scene.addGroup("arm", joints)
    reference = arm.home
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


def _colliding_geoms(model: mujoco.MjModel) -> np.ndarray:
    """The geoms that can touch something, without planes, which have no mesh."""
    can_touch = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return np.flatnonzero(can_touch & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE)))


def _frames(arm: armctl.Arm) -> np.ndarray:
    """(nbody,) the last joint of the arm above each body, counted from 1; 0 where none is."""
    model = arm.model
    of_body = np.zeros(model.nbody, int)
    for body in range(1, model.nbody):
        of_body[body] = of_body[model.body_parentid[body]]
        for i, joint in enumerate(arm.joint_map.joints):
            if model.jnt_bodyid[joint] == body:
                of_body[body] = i + 1
    return of_body


def _are_tested(model: mujoco.MjModel, moved_by: np.ndarray, a: int, b: int) -> bool:
    """Whether MuJoCo tests a pair of geoms, and the arm moves one of them relative to the other."""
    first, second = model.body_weldid[model.geom_bodyid[[a, b]]].tolist()
    parents = model.body_weldid[model.body_parentid[[first, second]]].tolist()
    if first > 0 and second > 0 and (first == parents[1] or second == parents[0]):
        return False
    bits = (model.geom_contype[a] & model.geom_conaffinity[b]) | (model.geom_contype[b] & model.geom_conaffinity[a])
    return bool(bits) and moved_by[model.geom_bodyid[a]] != moved_by[model.geom_bodyid[b]]


def _urdf(arm: armctl.Arm, folder: Path) -> str:
    """The arm and its scene: frames parallel to the world at home, a link for each geom."""
    model = arm.model
    data = mujoco.MjData(model)
    data.qpos[:] = arm.qpos(arm.home)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mass = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    parts = [f'<link name="f0">{mass}</link>']
    anchors = [np.zeros(3), *data.xanchor[list(arm.joint_map.joints)]]
    for i, joint in enumerate(arm.joint_map.joints):
        low = arm.limits.q_min[i] - arm.home[i]
        high = arm.limits.q_max[i] - arm.home[i]
        parts.append(
            f'<link name="f{i + 1}">{mass}</link><joint name="j{i}" type="revolute"><parent link="f{i}"/>'
            f'<child link="f{i + 1}"/><origin xyz="{_numbers(anchors[i + 1] - anchors[i])}"/>'
            f'<axis xyz="{_numbers(data.xaxis[joint])}"/>'
            f'<limit lower="{low}" upper="{high}" effort="100" velocity="2"/></joint>'
        )
    moved_by = _frames(arm)
    for geom in _colliding_geoms(model).tolist():
        frame = moved_by[model.geom_bodyid[geom]]
        file = folder / f"g{geom}.stl"
        _write_stl(file, data.geom_xpos[geom] + _vertices(model, geom) @ data.geom_xmat[geom].reshape(3, 3).T - anchors[frame])
        parts.append(
            f'<link name="g{geom}"><collision><geometry><mesh filename="{file}"/></geometry></collision></link>'
            f'<joint name="to_g{geom}" type="fixed"><parent link="f{frame}"/><child link="g{geom}"/></joint>'
        )
    return f'<robot name="arm">{"".join(parts)}</robot>'


def _vertices(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """(V, 3) m, the vertices of a geom, or of a polyhedron inside a round one, in its own axes."""
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    size = model.geom_size[geom]
    i = np.arange(200) + 0.5
    polar = np.arccos(1.0 - 2.0 * i / 200)
    turn = np.pi * (1.0 + np.sqrt(5.0)) * i
    sphere = np.column_stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])
    ends = np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        return model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return size * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return size[0] * sphere
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return (ends[:, None] + size[0] * sphere).reshape(-1, 3)
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return size * sphere
    angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    ring = size[0] * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(48)])
    return (ends[:, None] + ring).reshape(-1, 3)


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
