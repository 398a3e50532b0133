"""What an arm touches, and how far away it is: at a configuration, and proved over a whole motion."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache

import mujoco
import numpy as np

from armctl.collision import kernel
from armctl.collision.geometry import Geometry, build_geometry, colliding_pairs, frames_above, is_convex
from armctl.collision.interface import Approach, Hit, KeptAxis, MovingJoints, NearPairs
from armctl.core.errors import InputError, ModelError, UnknownNameError
from armctl.core.validation import Array, BoolArray, IntArray
from armctl.mjmodel.queries import geom_owner_name, is_below, last_joint_above, name_of

SAMPLES = 64
RESOLUTION_M = 2e-4  # of the closest approach: between the proved bound and a distance that is attained
_INTERVALS = 8192  # that wait in a proof, at most
_SAMPLES_OF_MOTION = 24  # from which the search for its closest approach starts
_UNIT_KNOTS = np.array([0.0, 1.0])
_OPEN_PAIRS_PER_PAIR = 400
_MIN_OPEN_PAIRS = 4096
_HALF_TURN = np.pi
_DEPTH_DIRECTIONS = 500


class _Memory(threading.local):
    """What queries overwrite; each thread has its own."""

    def __init__(self, geometry: Geometry):
        count = len(geometry.pairs)
        self.pairs = geometry.pairs.copy()
        self.frames = np.zeros((len(geometry.tree) + 1, 18))
        self.spheres = np.zeros((len(geometry.geoms), kernel.MOTION + geometry.depth))
        self.work = np.zeros((kernel.WORK_ROWS, 3))
        self.work[kernel.LAST_HIT, 0] = -1.0
        self.open_pairs = np.empty(_OPEN_PAIRS_PER_PAIR * count + _MIN_OPEN_PAIRS, np.int64)
        self.intervals = np.empty((_INTERVALS, kernel.INTERVAL_COLUMNS))
        self.q = np.empty(len(geometry.tree))
        self.delta = np.empty(len(geometry.tree))
        self.line = np.empty((1, 2, len(geometry.tree)))
        self.ranges = np.empty((1, 2, len(geometry.tree)))
        self.keep = np.zeros(kernel.KEEP_SIZE)
        self.trace = np.empty((kernel.MAX_GJK_STEPS, kernel.TRACE_COLUMNS))
        self.found = np.empty((count, kernel.GRADIENT + len(geometry.tree)))
        self.data: mujoco.MjData | None = None

    @property
    def proof_rows(self) -> tuple[Array | IntArray, ...]:
        """What every proof takes."""
        return self.open_pairs, self.intervals, self.q, self.delta, self.keep


class CollisionChecker:
    """Contacts and distances of an arm with itself and with its scene. Threads may share it.

    Everything outside the arm's chain stands where `qpos` has it. Left out are contacts that no motion of the arm changes,
    pairs that touch at every one of many random configurations, neighboring links that touch at home (their geoms overlap by
    design), and pairs that one joint alone moves and that are proved apart over its whole range.

    Attributes:
        geometry: The packed geoms and pairs.
        not_convex: Names of height fields and other geoms that no proof covers.
    """

    def __init__(
        self,
        arm: MovingJoints,
        qpos: Array | None = None,
        allow: Iterable[tuple[str, str]] = (),
        held: Mapping[int, int] | None = None,
    ):
        """Packs the geoms and learns which pairs always touch.

        Args:
            arm: The arm, or several as one.
            qpos: (nq,) where everything is; home if left out. The arm's own part matters only for what is held.
            allow: Pairs of names of bodies or geoms that may touch.
            held: Bodies that the arm carries, and the body that carries each.

        Raises:
            InputError: `allow` is no list of pairs.
            UnknownNameError: The model has no body or geom of a name in `allow`.
        """
        self._model = arm.model
        self._joint_map = arm.joint_map
        self._limits = arm.limits
        self._home = arm.home
        self._qpos = arm.home_qpos if qpos is None else np.array(qpos)
        is_plain = self._joint_map.is_plain
        self._ratio = np.eye(len(self._home)) if is_plain else np.array(self._joint_map.ratio)
        self._offset = np.zeros(len(self._ratio)) if is_plain else np.array(self._joint_map.offset)
        geometry = build_geometry(self._model, self._joint_map.joints, self._qpos, dict(held or {}))
        allowed = _allowed_geoms(self._model, allow)
        keep = [tuple(sorted(geometry.pair_geoms(p))) not in allowed for p in range(len(geometry.pairs))]
        self._set(geometry.with_pairs(np.array(keep, bool)))
        self._set(self.geometry.with_pairs(~self._touch_by_design()))
        self._set(self.geometry.with_pairs(~self._proved_by_one_joint()))
        self.not_convex = self._not_convex_geoms()

    @property
    def scene_rows(self) -> tuple[Array | IntArray, ...]:
        """The scene as the last nine arguments of the kernels, with the memory of this thread."""
        memory = self._memory
        geometry = self.geometry
        return (*self._rows, memory.pairs, geometry.groups, geometry.tree, memory.frames, memory.spheres, memory.work)

    def line_rows(self, keep: KeptAxis | None = None) -> tuple[object, ...]:
        """What the kernels of `armctl.planning` take before the scene: how all joints move, and memory for a proof.

        Args:
            keep: An axis that keeps its direction.

        Returns:
            The arrays.
        """
        memory = self._memory
        return (self._ratio, self._offset, _UNIT_KNOTS, memory.line, memory.ranges, self._proof_rows(keep))

    def _proof_rows(self, keep: KeptAxis | None) -> tuple[Array | IntArray, ...]:
        """What a proof takes, with the axis that keeps its direction."""
        memory = self._memory
        memory.keep[kernel.KEEP_FRAME] = -1.0
        if keep is not None:
            joints = sorted(self._joint_map.joints)
            last = last_joint_above(self._model, tuple(joints))[keep.body]
            kernel.locate_frames(self._moving(keep.q), self.geometry.tree, memory.frames)
            frame = memory.frames[last + 1, :9].reshape(3, 3)
            memory.keep[kernel.KEEP_FRAME] = last + 1
            memory.keep[kernel.KEEP_AXIS : kernel.KEEP_AXIS + 3] = frame.T @ keep.direction
            memory.keep[kernel.KEEP_DIRECTION : kernel.KEEP_DIRECTION + 3] = keep.direction
            memory.keep[kernel.KEEP_WITHIN] = keep.within
        return memory.proof_rows

    def tilts(self, hit: Hit) -> bool:
        """Whether a proof stopped because the kept axis tilts, and not because a pair is too near.

        Args:
            hit: Where it stopped.

        Returns:
            True if so.
        """
        return hit.pair == len(self.geometry.pairs)

    def _set(self, geometry: Geometry) -> None:
        self.geometry = geometry
        self._rows = (geometry.geoms, geometry.points, geometry.neighbors)
        self._memory = _Memory(geometry)

    def at(self, q: Array, clearance: float = 0.0) -> str:
        """What touches what at a configuration.

        Args:
            q: (n,) rad.
            clearance: m that counts as touching.

        Returns:
            Such as "link7 touches floor"; empty where nothing touches.
        """
        pair = self.hit(q, clearance)
        if pair >= 0:
            first, second = self.names(pair)
            return f"{second} touches {first}"
        return self._touches_not_convex(q) if self.not_convex else ""

    def along(self, path: Array) -> str:
        """The first contact at the points of a path.

        Args:
            path: (T, n) rad.

        Returns:
            As for `at`.
        """
        return next(filter(None, map(self.at, path)), "")

    def hit(self, q: Array, clearance: float = 0.0) -> int:
        """A pair that is not farther apart than the clearance at a configuration, or -1.

        Args:
            q: (n,) rad.
            clearance: m.

        Returns:
            The pair's row.
        """
        return kernel.first_hit(self._moving(q), clearance, *self.scene_rows)

    def nearest(self, q: Array) -> tuple[int, float]:
        """The pair that is nearest to touching, or -1 where there is no pair, and its distance.

        Args:
            q: (n,) rad.

        Returns:
            The pair's row, and m; zero or less if it overlaps, then not the depth.
        """
        return kernel.nearest_pair(self._moving(q), *self.scene_rows)

    def depth(self, q: Array, pair: int) -> float:
        """How deep a pair overlaps at a configuration: the shortest of many displacements that part it.

        Args:
            q: (n,) rad.
            pair: Its row.

        Returns:
            m, an upper bound; negative if the geoms are apart.
        """
        memory = self._memory
        kernel.locate_frames(self._moving(q), self.geometry.tree, memory.frames)
        return kernel.overlap_depth(pair, _directions(), *self._rows, memory.pairs, memory.frames)

    def near(self, q: Array, moves: Array, share: float, clearances: Array) -> NearPairs:
        """The pairs that a small motion can bring nearer by more than a share of what is free.

        What is free of a pair is its distance less its clearance. The result does not depend on earlier queries.

        Args:
            q: (n,) rad.
            moves: (n,) rad, how far each joint moves at most.
            share: From 0 to 1.
            clearances: (K,) m of each pair.

        Returns:
            The pairs, their distances and derivatives.
        """
        memory = self._memory
        geometry = self.geometry
        memory.pairs[:] = geometry.pairs
        memory.delta[:] = np.abs(self._ratio) @ moves
        q_all = self._moving(q)
        count = kernel.near_pairs(
            q_all, memory.delta, share, clearances, _directions(), memory.trace, memory.found, *self.scene_rows
        )
        found = memory.found[:count]
        gradient = found[:, kernel.GRADIENT :] @ self._ratio
        return NearPairs(found[:, kernel.PAIR].astype(np.int64), found[:, kernel.DISTANCE].copy(), gradient)

    def line_hit(self, start: Array, end: Array, clearance: float = 0.0, keep: KeptAxis | None = None) -> Hit | None:
        """Proves that the straight line between two configurations keeps more than a clearance.

        Args:
            start: (n,) rad.
            end: (n,) rad.
            clearance: m.
            keep: An axis that keeps its direction.

        Returns:
            None if it does; else the pair and where on the line, from 0 to 1, it is not known to be free.
        """
        return self.motion_hit(_UNIT_KNOTS, np.stack([start, end - start])[None], clearance, keep)

    def motion_hit(self, knots: Array, coefficients: Array, clearance: float = 0.0, keep: KeptAxis | None = None) -> Hit | None:
        """Proves that a motion of piecewise polynomials keeps more than a clearance at all times.

        Args:
            knots: (K + 1,) s.
            coefficients: (K, degree + 1, n), each piece's by powers of the time since its knot.
            clearance: m.
            keep: An axis that keeps its direction.

        Returns:
            None if it does; else the pair and the time at which it is not known to be free.
        """
        return self._motion_hit(knots, self._moving_coefficients(coefficients), clearance, keep=keep)

    def closest_approach(self, knots: Array, coefficients: Array, clearance: float, keep: KeptAxis | None = None) -> Approach:
        """Proves that a motion keeps more than a clearance, and how near it comes.

        Args:
            knots: As for `motion_hit`.
            coefficients: As for `motion_hit`.
            clearance: m.
            keep: An axis that keeps its direction.

        Returns:
            The closest approach.
        """
        moving = self._moving_coefficients(coefficients)
        bound, least, pair, time = kernel.closest_approach(
            knots.copy(),
            moving,
            clearance,
            RESOLUTION_M,
            _SAMPLES_OF_MOTION,
            np.empty((len(moving), 2, moving.shape[2])),
            self._proof_rows(keep),
            self.scene_rows,
        )
        return Approach(bound, least, Hit(pair, time))

    def names(self, pair: int) -> tuple[str, str]:
        """What a pair is called: bodies, or geoms that stand in the world.

        Args:
            pair: Its row.

        Returns:
            Both names.
        """
        first, second = self.geometry.pair_geoms(pair)
        return geom_owner_name(self._model, first), geom_owner_name(self._model, second)

    def require_provable(self) -> None:
        """Makes sure that proofs cover everything.

        Raises:
            ModelError: A geom that the arm could touch is not convex.
        """
        if self.not_convex:
            raise ModelError(
                f"{self.not_convex[0]}: a height field or signed distance field, for which no clearance can be proved; "
                "replace it by boxes or meshes"
            )

    def _motion_hit(
        self, knots: Array, coefficients: Array, clearance: float, pair: int = -1, keep: KeptAxis | None = None
    ) -> Hit | None:
        """As `motion_hit`, for polynomials of all joints that move, and for one pair or all."""
        ranges = np.empty((len(coefficients), 2, coefficients.shape[2]))
        knots = knots.copy()  # numba would compile the proof again for a read-only array
        found, time = kernel.prove_motion(knots, coefficients, pair, clearance, ranges, self._proof_rows(keep), self.scene_rows)
        return None if found < 0 else Hit(found, time)

    def _moving(self, q: Array) -> Array:
        """(m,) of all joints that move, those that follow others included."""
        q_all = self._memory.q
        q_all[:] = self._joint_map.positions(np.asarray(q, np.float64))
        return q_all

    def _moving_coefficients(self, coefficients: Array) -> Array:
        """(K, degree + 1, m) polynomials of all joints that move: only the constant has the offset."""
        moving = np.array(self._joint_map.speeds(coefficients), order="C")
        moving[:, 0] = self._joint_map.positions(coefficients[:, 0])
        return moving

    def _all_hits(self, q: Array) -> BoolArray:
        hits = np.zeros(len(self.geometry.pairs), bool)
        kernel.all_hits(self._moving(q), 0.0, hits, *self.scene_rows)
        return hits

    def _touch_by_design(self) -> BoolArray:
        """(K,) pairs that touch at home and at every sample, or at home between neighboring frames."""
        at_home = self._all_hits(self._home)
        always = at_home.copy()
        for q in self._limits.random(self._home, SAMPLES, np.random.default_rng(0)):
            always &= self._all_hits(q)
        are_neighbors = np.array([len(self._joints_between(p)) == 1 for p in range(len(at_home))], bool)
        return always | (at_home & are_neighbors)

    def _joints_between(self, pair: int) -> list[int]:
        """The rows of the tree that move one geom of a pair relative to the other."""
        row = self.geometry.pairs[pair]
        common = int(row[kernel.COMMON])
        joints = []
        for geom in (int(row[kernel.A]), int(row[kernel.B])):
            path = frames_above(self.geometry.tree, int(self.geometry.geoms[geom, kernel.FRAME]))
            joints += [frame - 1 for frame in path[: path.index(common)]]
        return joints

    def _proved_by_one_joint(self) -> BoolArray:
        """(K,) pairs that one joint alone moves, and that never touch over its whole range."""
        proved = np.zeros(len(self.geometry.pairs), bool)
        low = self._joint_map.positions(np.maximum(self._limits.q_min, self._home - _HALF_TURN))
        high = self._joint_map.positions(np.minimum(self._limits.q_max, self._home + _HALF_TURN))
        is_endless = ~np.isfinite(self._limits.q_max - self._limits.q_min)
        for pair in range(len(proved)):
            joints = self._joints_between(pair)
            if len(joints) != 1:
                continue
            row = self.geometry.tree[joints[0]]
            index = int(row[kernel.JOINT])
            if row[kernel.KIND] == kernel.SLIDE and is_endless.any():
                continue
            coefficients = np.zeros((1, 2, len(self.geometry.tree)))
            coefficients[0, 0] = self._joint_map.positions(self._home)
            coefficients[0, 0, index] = low[index]
            coefficients[0, 1, index] = high[index] - low[index]
            proved[pair] = self._motion_hit(_UNIT_KNOTS, coefficients, 0.0, pair) is None
        return proved

    def _not_convex_geoms(self) -> list[str]:
        """Geoms that collide with a link of the arm and are not convex."""
        pairs = colliding_pairs(self._model)
        owner = np.array(last_joint_above(self._model, tuple(sorted(self._joint_map.joints))), np.int64)[
            self._model.geom_bodyid
        ]
        moved = pairs[owner[pairs[:, 0]] != owner[pairs[:, 1]]]
        found = [int(geom) for geom in np.unique(moved) if not is_convex(self._model, int(geom))]
        return [name_of(self._model, mujoco.mjtObj.mjOBJ_GEOM, geom) for geom in found]

    def _touches_not_convex(self, q: Array) -> str:
        """Contacts with geoms that are not convex, by MuJoCo."""
        data = self._memory.data or mujoco.MjData(self._model)
        self._memory.data = data
        data.qpos[:] = self._qpos
        data.qpos[self._joint_map.qpos_adr] = self._joint_map.positions(q)
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_collision(self._model, data)
        for contact in data.contact:
            if contact.dist < 0.0 and not all(is_convex(self._model, int(geom)) for geom in contact.geom):
                first, second = sorted(contact.geom.tolist())
                return f"{geom_owner_name(self._model, second)} touches {geom_owner_name(self._model, first)}"
        return ""


def _allowed_geoms(model: mujoco.MjModel, allow: Iterable[tuple[str, str]]) -> set[tuple[int, int]]:
    """The pairs of geoms, the lesser first, that pairs of names allow to touch."""
    allowed = set()
    for pair in allow:
        names = list(pair) if isinstance(pair, Sequence) and not isinstance(pair, str) else []
        if len(names) != 2 or not all(isinstance(name, str) for name in names):
            raise InputError(f"allow: {pair!r:.80} is not a pair of names; allow=[('cube', 'table')] is one")
        first = _geoms_named(model, names[0])
        second = _geoms_named(model, names[1])
        allowed |= {(min(a, b), max(a, b)) for a in first for b in second}
    return allowed


def _geoms_named(model: mujoco.MjModel, name: str) -> list[int]:
    """The geoms of a body and of those below it, or the geom of that name."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body >= 0:
        return [geom for geom in range(model.ngeom) if is_below(model, int(model.geom_bodyid[geom]), body)]
    geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
    if geom < 0:
        bodies = [model.body(i).name for i in range(1, model.nbody)]
        raise UnknownNameError.of("body or geom in allow", name, [*bodies, *(model.geom(i).name for i in range(model.ngeom))])
    return [geom]


@lru_cache(maxsize=1)
def _directions() -> Array:
    """(D, 3) unit vectors, spread evenly over the sphere (Fibonacci lattice), with the axes of the world."""
    i = np.arange(_DEPTH_DIRECTIONS) + 0.5
    polar = np.arccos(1.0 - 2.0 * i / _DEPTH_DIRECTIONS)
    turn = np.pi * (1.0 + np.sqrt(5.0)) * i
    lattice = np.column_stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])
    return np.vstack([lattice, np.eye(3), -np.eye(3)])
