"""What an arm touches, and how far away it is: at a configuration, and proved over a whole motion."""

import copy
import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import Self

import mujoco
import numpy as np

from armctl._core import Approach, ClearanceProof, CollisionScene, Hit
from armctl.core.errors import InputError, ModelError, UnknownNameError, few_names
from armctl.core.validation import Array, BoolArray, IntArray
from armctl.model.arm.arm import Arm
from armctl.model.collision.collision_geometry import Geometry, build_geometry, colliding_pairs, is_convex
from armctl.model.collision.kept_region import KeptRegion
from armctl.model.collision.moving_joints import MovingJoints, NearPairs
from armctl.model.collision.world_geometry import add_world
from armctl.model.collision.world_snapshot import WorldSnapshot
from armctl.model.mjmodel.closed_loops import pinned_bodies
from armctl.model.mjmodel.queries import (
    acts,
    geom_owner_name,
    has_obstacles,
    is_below,
    last_joint_above,
    name_of,
    number_of,
    stands_alone,
)

SAMPLES = 64
_UNIT_KNOTS = np.array([0.0, 1.0])


class _QueryScratch(threading.local):
    """What queries overwrite; each thread has its own."""

    def __init__(self, geometry: Geometry):
        self.scene = CollisionScene(geometry.core)
        self.proof = ClearanceProof(self.scene)
        self.data: mujoco.MjData | None = None


class CollisionChecker:
    """Contacts and distances of an arm with itself and with its scene. Threads may share it.

    Everything outside the arm's chain stands where `qpos` has it. A pair touches where MuJoCo makes a contact of it: within the
    margins of its geoms. Left out are contacts that no motion of the arm changes, pairs that touch at every one of many random
    configurations, neighboring links that touch at home (their geoms overlap by design), and pairs that one joint alone moves
    and that are proved apart over its whole range. `load` takes those of neighbors out of the model, so that a simulation
    leaves them out, too; `left_out` names those whose contact a simulation keeps.
    """

    def __init__(
        self,
        arm: MovingJoints,
        qpos: Array | None = None,
        allow: Iterable[tuple[str, str]] = (),
        held: Mapping[int, int] | None = None,
    ):
        """Finds the geoms, and learns which pairs always touch.

        `qpos` (nq,) is where everything is, home if left out; the arm's own part matters only for what is `held`:
        bodies that the arm carries, and the body that carries each. `allow` has pairs of names that may touch.
        """
        self._model = arm.model
        self._joint_map = arm.joint_map
        self._limits = arm.limits
        self._home = arm.home
        self._qpos = arm.home_qpos if qpos is None else np.array(qpos)
        self._world_names: tuple[str, ...] = ()
        self.not_checkable = why_not_checkable(arm)  # one sentence; empty if contacts can be checked
        geometry = build_geometry(self._model, self._joint_map, self._qpos, dict(held or {}))
        allowed = allowed_geoms(self._model, allow)
        keep = [tuple(sorted(pair)) not in allowed for pair in geometry.geom_ids[geometry.pairs].tolist()]
        self._set(geometry.with_pairs(np.array(keep, bool)))
        by_design = self._touch_by_design()
        found = [self.names(int(pair)) for pair in np.flatnonzero(by_design)]
        self.left_out = tuple(dict.fromkeys(found))  # bodies that touch by design, and whose contacts a simulation keeps
        self._set(self.geometry.with_pairs(~by_design))
        self._set(self.geometry.with_pairs(~self._proved_by_one_joint()))
        self.not_convex = self._not_convex_geoms()  # names of height fields and other geoms that no proof covers

    def with_clearances(self, clearances: Array) -> Self:
        """A checker of the same pairs that counts each as touching where it is not farther apart than its clearance (K,), m."""
        checker = copy.copy(self)
        checker._set(self.geometry.with_margins(self.geometry.margins + clearances))
        return checker

    def with_world(self, arm: Arm, snapshot: WorldSnapshot) -> Self:
        """A checker of the same, and of the bodies of a world around the arm; made once for each snapshot."""
        known = snapshot.derived.get(self)
        if isinstance(known, type(self)):
            return known
        world = add_world(arm, self.geometry, self._qpos, snapshot)
        checker = copy.copy(self)
        checker._set(world.geometry)
        checker._world_names = world.names
        snapshot.derived[self] = checker
        return checker

    def proof(self, keep: KeptRegion | None = None) -> ClearanceProof:
        """The proofs of this thread, with a region in which the tip must stay."""
        memory = self._memory
        if keep is None:
            memory.proof.release_region()
            return memory.proof
        joints = sorted(self._joint_map.joints)
        last = joints[last_joint_above(self._model, tuple(joints))[keep.arm.tip_body]]
        frame = joints.index(last) + 1
        tip = _contiguous(keep.tip.rows.reshape(12))
        memory.proof.keep_region(_contiguous(keep.q), frame, tip, _contiguous(keep.part.numbers))
        return memory.proof

    def leaves_region(self, hit: Hit) -> bool:
        """Whether a proof stopped because the tip leaves its region, and not because a pair is too near."""
        return hit.pair == len(self.geometry.pairs)

    def opens(self, hit: Hit) -> bool:
        """Whether a proof stopped because closed loops cannot be closed, or a passive joint leaves its limits."""
        return hit.pair > len(self.geometry.pairs)

    def _set(self, geometry: Geometry) -> None:
        self.geometry = geometry  # the geoms and pairs
        self._memory = _QueryScratch(geometry)

    def at(self, q: Array, clearance: float = 0.0) -> str:
        """What touches, or is nearer than a clearance, m, at q (n,), such as "link7 touches floor"; empty if nothing does."""
        pair = self.hit(q, clearance)
        if pair >= 0:
            first, second = self.names(pair)
            return f"{second} touches {first}"
        return self._touches_not_convex(q) if self.not_convex else ""

    def along(self, path: Array) -> str:
        """The first contact at the points of a path (T, n), as for `at`."""
        return next(filter(None, map(self.at, path)), "")

    def hit(self, q: Array, clearance: float = 0.0) -> int:
        """A pair that is not farther apart than the clearance, m, at q (n,), or -1."""
        pair = self._memory.scene.first_hit(_contiguous(q), clearance)
        return pair if pair < len(self.geometry.pairs) else -1

    def nearest(self, q: Array) -> tuple[int, float]:
        """The row of the pair that is nearest to touching at q (n,), or -1 where there is no pair, and its distance, m.

        The distance is infinite where there is no pair, and zero or less if it overlaps, then not the depth.
        """
        nearest = self._memory.scene.nearest_pair(_contiguous(q))
        return (nearest.pair if nearest.pair < len(self.geometry.pairs) else -1), nearest.distance

    def depth(self, q: Array, pair: int) -> float:
        """How deep, m, a pair overlaps at q (n,): the shortest of many displacements that part it; negative if it is apart."""
        clearances = np.full(len(self.geometry.pairs), -np.inf)  # no other pair is near
        clearances[pair] = np.inf
        return -float(self.near(q, np.zeros(len(q)), 1.0, clearances).distances[0])

    def distance(self, q: Array, pair: int) -> float:
        """m between the two of a pair at q (n,), negative where they overlap."""
        return -self.depth(q, pair)

    def near(self, q: Array, moves: Array, share: float, clearances: Array) -> NearPairs:
        """The pairs that a motion by at most `moves` (n,) rad can bring nearer by more than a share of what is free.

        What is free of a pair is its distance less its clearance (K,) m.
        """
        joint_map = self._joint_map
        all_moves = moves if joint_map.closure is not None else np.abs(joint_map.ratio) @ moves
        near = self._memory.scene.near_pairs(_contiguous(q), _contiguous(all_moves), share, clearances)
        return NearPairs(
            pairs=np.array([each.pair for each in near], np.int64),
            distances=np.array([each.distance for each in near]),
            gradients=np.array([each.gradient for each in near]).reshape(-1, len(q)),
        )

    def near_points(self, q: Array, geoms: IntArray, points: Array, margin: float) -> BoolArray:
        """(N,) which points (N, 3) m of the world are within a margin, m, of some geoms (rows of the geometry) at q (n,)."""
        marks = np.zeros(len(points), np.int64)
        self._memory.scene.mark_points(
            _contiguous(q), np.ascontiguousarray(geoms, np.int64), _contiguous(points), margin, marks
        )
        return marks.astype(bool)

    def line_hit(self, start: Array, end: Array, clearance: float = 0.0, keep: KeptRegion | None = None) -> Hit | None:
        """Proves that the straight line between two configurations (n,) keeps more than a clearance, m.

        None if it does; else the pair and where on the line, from 0 to 1, it is not known to be free.
        """
        proof = self.proof(keep)
        if self._joint_map.closure is not None:
            self._set_line(proof, start, end)
        else:
            self._set_line(proof, self._joint_map.positions(start), self._joint_map.positions(end))
        return proof.hit(clearance)

    def motion_hit(
        self, knots: Array, coefficients: Array, clearance: float = 0.0, keep: KeptRegion | None = None
    ) -> Hit | None:
        """Proves that a motion of piecewise polynomials keeps more than a clearance, m, at all times.

        None if it does; else the pair and the time at which it is not known to be free. `coefficients` (K, degree + 1,
        n) are those of powers of the time since each of the `knots` (K + 1,) s.
        """
        return self._proof_of(knots, coefficients, keep).hit(clearance)

    def closest_approach(self, knots: Array, coefficients: Array, clearance: float, keep: KeptRegion | None = None) -> Approach:
        """As `motion_hit`, and how near the motion comes."""
        return self._proof_of(knots, coefficients, keep).closest_approach(clearance)

    def _proof_of(self, knots: Array, coefficients: Array, keep: KeptRegion | None) -> ClearanceProof:
        """The proofs of this thread, of a motion, whose followers follow."""
        proof = self.proof(keep)
        if not self._joint_map.is_plain and self._joint_map.closure is None:
            coefficients = coefficients @ self._joint_map.ratio.T
            coefficients[:, 0] += self._joint_map.offset
        proof.set_motion(knots, _contiguous(coefficients))
        return proof

    def _set_line(self, proof: ClearanceProof, start: Array, end: Array) -> None:
        """Takes the straight line between two positions of all joints, (m,) each, or of driven ones of loops, as the motion."""
        proof.set_motion(_UNIT_KNOTS, np.stack([start, end - start])[None])

    def names(self, pair: int) -> tuple[str, str]:
        """What a pair is called: bodies, or geoms that stand in the world."""
        first, second = self.geometry.pair_geoms(pair)
        return self._owner_name(first), self._owner_name(second)

    def _owner_name(self, geom: int) -> str:
        """The name of a geom of the model, or behind these of a body of the world."""
        of_world = geom - self._model.ngeom
        return self._world_names[of_world] if of_world >= 0 else geom_owner_name(self._model, geom)

    def refusal(self, hit: Hit) -> str:
        """Why a proof stopped: which bodies would touch, or that closed loops would not close; one sentence."""
        if self.opens(hit):
            return "the closed loops cannot be followed within the limits of their passive joints"
        return "{1} would touch {0}".format(*self.names(hit.pair))

    def require_provable(self) -> None:
        """Raises ModelError if a proof does not cover a link or a geom: one without a shape, or one that is not convex."""
        if self.not_checkable:
            raise ModelError(self.not_checkable)
        self.require_convex()

    def require_provable_among_obstacles(self) -> None:
        """As `require_provable`; but links without a shape are refused only if there is anything that they could touch.

        For motions that are made for simulations as well. A `Robot` refuses them in any case.
        """
        if self._world_names or has_obstacles(self._model, self._joint_map.joints):
            self.require_provable()
        self.require_convex()

    def require_convex(self) -> None:
        """Raises ModelError if the arm could touch a geom that is not convex, which proofs do not cover."""
        if self.not_convex:
            raise ModelError(
                f"{self.not_convex[0]}: a height field or signed distance field, for which no clearance can be proved; "
                "replace it by boxes or meshes"
            )

    def _all_hits(self, q: Array) -> BoolArray:
        hits = np.empty(len(self.geometry.pairs), np.int64)
        self._memory.scene.all_hits(_contiguous(q), 0.0, hits)
        return hits.astype(bool)

    def _touch_by_design(self) -> BoolArray:
        """(K,) pairs that touch at home and at every sample, or at home between neighboring frames of the robot itself."""
        at_home = self._all_hits(self._home)
        always = at_home.copy()
        for q in self._limits.random(self._home, SAMPLES, np.random.default_rng(0)):
            always &= self._all_hits(q)
        bodies = self._model.geom_bodyid[self.geometry.geom_ids[self.geometry.pairs]].tolist()
        are_neighbors = self.geometry.moved_by_one_joint() >= 0
        for p in np.flatnonzero(at_home & are_neighbors):
            are_neighbors[p] = not stands_alone(self._model, *bodies[p])
        if self._model.neq:
            pinned = pinned_bodies(self._model)
            are_neighbors |= np.array([frozenset(self._model.body_weldid[pair].tolist()) in pinned for pair in bodies], bool)
        return always | (at_home & are_neighbors)

    def _proved_by_one_joint(self) -> BoolArray:
        """(K,) pairs that one joint alone moves, and that never touch over its whole range."""
        proved = np.zeros(len(self.geometry.pairs), bool)
        if self._joint_map.closure is not None:  # a joint of a loop does not move alone
            return proved
        low = self._joint_map.positions(np.maximum(self._limits.q_min, self._home - np.pi))
        high = self._joint_map.positions(np.minimum(self._limits.q_max, self._home + np.pi))
        is_endless = ~np.isfinite(self._limits.q_max - self._limits.q_min)
        home = self._joint_map.positions(self._home)
        slides = self._model.jnt_type[list(self._joint_map.joints)] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        proof = self.proof()
        moving = self.geometry.moved_by_one_joint()
        for pair in np.flatnonzero(moving >= 0).tolist():
            joint = moving[pair]
            if slides[joint] and is_endless.any():
                continue
            start = home.copy()
            end = home.copy()
            start[joint] = low[joint]
            end[joint] = high[joint]
            self._set_line(proof, start, end)
            proved[pair] = proof.hit(0.0, pair) is None
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
            if acts(contact) and not all(is_convex(self._model, int(geom)) for geom in contact.geom):
                first, second = sorted(contact.geom.tolist())
                return f"{geom_owner_name(self._model, second)} touches {geom_owner_name(self._model, first)}"
        return ""


def why_not_checkable(arm: MovingJoints) -> str:
    """Why no contact of an arm can be excluded, one sentence; empty if contacts can be checked."""
    names = arm.unchecked_links
    if not names:
        return ""
    verb = "has" if len(names) == 1 else "have"
    return (
        f"not checkable: {few_names(names)} {verb} no collision shape; "
        'armctl.load(..., shapes="capsules") gives them capsules, avoid=False moves without a check'
    )


def allowed_geoms(model: mujoco.MjModel, allow: Iterable[tuple[str, str]]) -> set[tuple[int, int]]:
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
    """The geoms of a body and of those below it, or the geom of that name; "body3" is a nameless one, as in messages."""
    body = number_of(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body >= 0:
        return [geom for geom in range(model.ngeom) if is_below(model, int(model.geom_bodyid[geom]), body)]
    geom = number_of(model, mujoco.mjtObj.mjOBJ_GEOM, name)
    if geom < 0:
        bodies = [model.body(i).name for i in range(1, model.nbody)]
        geoms = [model.geom(i).name for i in range(model.ngeom)]
        raise UnknownNameError.from_known("body or geom in allow", name, [*bodies, *geoms])
    return [geom]


def _contiguous(numbers: Array) -> Array:
    return np.ascontiguousarray(numbers, np.float64)
