"""
The compiled core of armctl. It computes; the Python modules that use it check and explain.
"""

from collections.abc import Sequence
import enum

import numpy
from numpy.typing import NDArray

class TipFollower:
    """Joints that keep the tip on a path, step by step."""

    def __init__(
        self, *, model: ArmModel, q_min: numpy.ndarray, q_max: numpy.ndarray, centering: float, oriented: bool
    ) -> None:
        """
        Joints that a path leaves free go to the middle of their ranges at the rate `centering`.

        Twists are (6,) if the path is oriented, else (3,).
        """

    def slope(self, q: numpy.ndarray, twist: numpy.ndarray, v: numpy.ndarray) -> None:
        """The joint velocities (n,) that make a twist of the tip."""

    def step(
        self,
        q: numpy.ndarray,
        slope: numpy.ndarray,
        length: float,
        halfway: numpy.ndarray,
        position: numpy.ndarray,
        rotation: numpy.ndarray,
        moved: numpy.ndarray,
    ) -> bool:
        """
        Moves the joints a step along the path, with the twist half a step further, to a pose there.

        Returns whether the tip arrives.
        """

class ShapeKind(enum.IntEnum):
    """The shape of a geom."""

    HULL = 0

    BOX = 1

    CYLINDER = 2

    ELLIPSOID = 3

    PLANE = 4

    POINTS = 5

class PointCloud:
    """Points that stand, as balls, and a tree over them. Immutable."""

    def __init__(self, points: numpy.ndarray, radius: float) -> None:
        """
        From points (N, 3) m in the frame of the cloud, and the radius of each, m.
        """

    @property
    def size(self) -> int:
        """How many points."""

    def distance(self, place: numpy.ndarray) -> float:
        """m, of a place (3,) in the frame of the cloud from the nearest point."""

class CollisionModel:
    """
    What an arm could touch: shapes, the joints that move them, and pairs. Immutable.
    """

    def __init__(
        self,
        *,
        references: numpy.ndarray,
        n: int,
        joint_offset: numpy.ndarray,
        axes: numpy.ndarray,
        anchors: numpy.ndarray,
        slides: numpy.ndarray,
        parents: numpy.ndarray,
        joints: numpy.ndarray,
        vertices: numpy.ndarray,
        first_neighbor: numpy.ndarray,
        neighbors: numpy.ndarray,
        kinds: numpy.ndarray,
        frames: numpy.ndarray,
        inflations: numpy.ndarray,
        positions: numpy.ndarray,
        rotations: numpy.ndarray,
        sizes: numpy.ndarray,
        centers: numpy.ndarray,
        radii: numpy.ndarray,
        first_vertex: numpy.ndarray,
        first_geoms: numpy.ndarray,
        second_geoms: numpy.ndarray,
        margins: numpy.ndarray,
        directions: numpy.ndarray,
        ratio: numpy.ndarray,
    ) -> None:
        """
        A model from arrays for each joint, geom, vertex and pair; armctl/cpp/collision_model.hpp explains them.
        """

    def with_additions(
        self, added: CollisionAdditions, clouds: Sequence[PointCloud], cloud_poses: numpy.ndarray
    ) -> CollisionModel:
        """
        The same with further geoms, behind these its clouds at poses (C, 12): the rotation row by row, and the position.
        """

    def with_margins(self, margins: numpy.ndarray) -> CollisionModel:
        """The same with other margins of the pairs, (K,) m."""

    def with_loops(self, loops: LoopClosure) -> CollisionModel:
        """The same of an arm with closed loops."""

class CollisionAdditions:
    """Geoms and pairs that are added to a model."""

    def __init__(
        self,
        *,
        vertices: numpy.ndarray,
        first_neighbor: numpy.ndarray,
        neighbors: numpy.ndarray,
        kinds: numpy.ndarray,
        frames: numpy.ndarray,
        inflations: numpy.ndarray,
        positions: numpy.ndarray,
        rotations: numpy.ndarray,
        sizes: numpy.ndarray,
        centers: numpy.ndarray,
        radii: numpy.ndarray,
        first_vertex: numpy.ndarray,
        first_geoms: numpy.ndarray,
        second_geoms: numpy.ndarray,
        margins: numpy.ndarray,
        kept_pairs: numpy.ndarray,
    ) -> None:
        """
        Arrays as of a model, and `kept_pairs` (K,) that says which of its pairs stay; armctl/cpp/collision_model.hpp explains them.
        """

class PairDistance:
    """A pair and its distance."""

    @property
    def pair(self) -> int:
        """Its row, or the number of pairs where there is none."""

    @property
    def distance(self) -> float:
        """m"""

class NearPair:
    """A pair, and how its distance changes."""

    @property
    def pair(self) -> int:
        """Its row."""

    @property
    def distance(self) -> float:
        """m; negative if it overlaps."""

    @property
    def gradient(self) -> list[float]:
        """The derivatives (n,) of the distance by the positions of the joints."""

class CollisionScene:
    """
    Distances where an arm is, with scratch memory: use an object in one thread at a time.
    """

    def __init__(self, model: CollisionModel) -> None: ...
    def first_hit(self, q: numpy.ndarray, clearance: float) -> int:
        """
        A pair that is not farther apart than the clearance, m, at q (n,), or the number of pairs where there is none.
        """

    def all_hits(self, q: numpy.ndarray, clearance: float, hits: numpy.ndarray) -> None:
        """Marks every pair that is not farther apart than the clearance, (K,)."""

    def nearest_pair(self, q: numpy.ndarray) -> PairDistance:
        """
        The pair that is nearest to touching at q (n,); a distance at or below zero says that it overlaps.
        """

    def mark_points(
        self, q: numpy.ndarray, geoms: numpy.ndarray, points: numpy.ndarray, margin: float, marks: numpy.ndarray
    ) -> None:
        """
        Marks the points (N, 3) m of the world that are not farther than a margin, m, from some geoms (G,) at q (n,).
        """

    def near_pairs(self, q: numpy.ndarray, moves: numpy.ndarray, share: float, clearances: numpy.ndarray) -> list[NearPair]:
        """
        The pairs that moves (m,) of all joints, or with closed loops (n,), from q (n,) can bring nearer by more than a share of what is free, which is
        their distance less their clearance (K,).
        """

MAX_DEGREE: int = 5

class Hit:
    """A pair that is not known to be free."""

    @property
    def pair(self) -> int:
        """
        Its row; the number of pairs says that the tip leaves its region, the next that loops do not close.
        """

    @property
    def time(self) -> float:
        """s"""

class Approach:
    """How near a motion comes."""

    @property
    def bound(self) -> float:
        """m, proved; negative if the clearance could not be proved."""

    @property
    def distance(self) -> float:
        """
        m, that occurs: at most 0.2 mm above the bound, or where the proof failed.
        """

    @property
    def nearest(self) -> Hit:
        """Its pair and time."""

class ClearanceProof:
    """
    Proofs for whole motions with scratch memory: use an object in one thread at a time.
    """

    def __init__(self, scene: CollisionScene) -> None: ...
    def keep_region(self, q: numpy.ndarray, frame: int, tip: numpy.ndarray, region: numpy.ndarray) -> None:
        """
        In the next proofs, the tip, which moves with a frame and has a pose (12,) at q (n,), stays in a region (38,).
        """

    def release_region(self) -> None:
        """Lets the tip go anywhere."""

    def set_motion(self, knots: numpy.ndarray, coefficients: numpy.ndarray) -> None:
        """
        Sets the motion of the next proofs: knots (K + 1,) s, and coefficients (K, degree + 1, m) of all joints, or with closed
        loops of the n driven ones, by powers of the time since the knot, of degree 1 to 5.
        """

    def hit(self, clearance: float, pair: int | None = None) -> Hit | None:
        """
        Proves that the motion keeps all pairs, or one, farther apart than a clearance, m: None, or
        where it is not known to be free.
        """

    def closest_approach(self, clearance: float) -> Approach:
        """Proves it, and how near the motion comes."""

PASSIVE_LIMIT_TOLERANCE: float = 1e-09

class LoopClosure:
    """Closed loops of an arm: where its passive joints are. Immutable."""

    def __init__(
        self,
        *,
        reference: numpy.ndarray,
        reference_q: numpy.ndarray,
        rotations: numpy.ndarray,
        translations: numpy.ndarray,
        slides: numpy.ndarray,
        parents: numpy.ndarray,
        offsets: numpy.ndarray,
        low: numpy.ndarray,
        high: numpy.ndarray,
        length: float,
        ratio: numpy.ndarray,
        passive: numpy.ndarray,
        first_joints: numpy.ndarray,
        second_joints: numpy.ndarray,
        first_placements: numpy.ndarray,
        second_placements: numpy.ndarray,
        holds_axes: numpy.ndarray,
        followers: numpy.ndarray,
        leaders: numpy.ndarray,
        terms: numpy.ndarray,
    ) -> None:
        """
        Loops from arrays for each joint, loop and pair of tied joints; armctl/cpp/loop_closure.hpp explains them.
        """

def first_break(closure: LoopClosure, knots: numpy.ndarray, coefficients: numpy.ndarray) -> float | None:
    """
    The first time, s, at which loops are not proved to stay closed with passive joints inside their limits, in a motion of the n
    driven joints with coefficients (K, degree + 1, n) by powers of the time since the knots (K + 1,) s; None if they are.
    """

def close_loops(closure: LoopClosure, q: numpy.ndarray, positions: numpy.ndarray, ratios: numpy.ndarray) -> int:
    """
    Fills the positions (T, m) of all joints, and their speeds per speed of the driven ones (T, m n), at q (T, n). Returns at which row the loops do not close; T if they do everywhere.
    """

def loop_accelerations(closure: LoopClosure, q: numpy.ndarray, v: numpy.ndarray, accelerations: numpy.ndarray) -> None:
    """
    Fills the accelerations (T, m) of all joints at speeds v (T, n) of the driven ones whose own accelerations are zero.
    """

class ArmModel:
    """The model of an arm: a tree of links. Immutable."""

    def __init__(
        self,
        *,
        masses: numpy.ndarray,
        armature: numpy.ndarray,
        rotations: numpy.ndarray,
        translations: numpy.ndarray,
        slides: numpy.ndarray,
        parents: numpy.ndarray,
        centers: numpy.ndarray,
        inertias: numpy.ndarray,
        lifted_masses: numpy.ndarray,
        lifted_moments: numpy.ndarray,
        stiffness: numpy.ndarray,
        spring_rest: numpy.ndarray,
        offsets: numpy.ndarray,
        damping: numpy.ndarray,
        friction_loss: numpy.ndarray,
        friction_gain: numpy.ndarray,
        friction_rate: numpy.ndarray,
        chain_length: int,
        gravity: numpy.ndarray,
        tip_rotation: numpy.ndarray,
        tip_translation: numpy.ndarray,
        implicit_damping: bool,
        implicit_coriolis: bool,
        ratio: numpy.ndarray,
    ) -> None:
        """
        A model from arrays for each of the m joints, and for each of the arm's n; armctl/cpp/arm_model.hpp explains them.
        """

    @property
    def n(self) -> int:
        """The number of joints that the arm's motors drive."""

    def for_period(self, dt: float, continuous: bool) -> ArmModel:
        """
        The model for a control period, s: one step of MuJoCo, or a continuous motion. dt = 0 is continuous time.
        """

    def with_loops(
        self, loops: LoopClosure, damping: numpy.ndarray, friction: numpy.ndarray, armature: numpy.ndarray
    ) -> ArmModel:
        """
        The same arm with closed loops, and the damping (m, 3), dry friction (m, 3: loss, gain, rate) and armature (m,) of its
        passive joints, zero for others.
        """

def inverse_dynamics(model: ArmModel, q: numpy.ndarray, v: numpy.ndarray, a: numpy.ndarray, tau: numpy.ndarray) -> None:
    """
    The torques that change the velocity by a dt over the period, without dry friction: (T, n) N m.
    """

def gravity(model: ArmModel, q: numpy.ndarray, tau: numpy.ndarray) -> None:
    """The torques that hold the arm still: (T, n) N m."""

def tips(model: ArmModel, q: numpy.ndarray, positions: numpy.ndarray, rotations: numpy.ndarray) -> None:
    """
    Positions (T, 3) m and rotation matrices (T, 9), row by row, of the tip in the world at each row of q (T, n).
    """

def frames(
    model: ArmModel, q: numpy.ndarray, joint: int, placement: numpy.ndarray, positions: numpy.ndarray, rotations: numpy.ndarray
) -> None:
    """
    As `tips`, of a frame that a joint carries (-1: the world) at a placement (12,) in it: rotation row by row, position.
    """

def mass_matrices(model: ArmModel, q: numpy.ndarray, M: numpy.ndarray) -> None:
    """The mass matrices with armature, (T, n n) kg m^2, row by row."""

def tip_jacobians(model: ArmModel, q: numpy.ndarray, J: numpy.ndarray) -> None:
    """
    The Jacobians of the tip, (T, 6 n), row by row: linear first, world axes.
    """

def tip_twists(model: ArmModel, q: numpy.ndarray, v: numpy.ndarray, twists: numpy.ndarray) -> None:
    """The twists (T, 6) of the tip, linear first, world axes."""

def tip_forces(model: ArmModel, q: numpy.ndarray, wrenches: numpy.ndarray, tau: numpy.ndarray) -> None:
    """
    J(q)^T wrench, (T, n) N m, for wrenches (T, 6) on the tip: force first, world axes.
    """

def quaternions(rotations: numpy.ndarray, quats: numpy.ndarray) -> None:
    """
    The unit quaternions wxyz (T, 4), w >= 0, of rotation matrices (T, 3, 3).
    """

class ActionMode(enum.Enum):
    """What the numbers of an action mean."""

    torque = 0

    joint_delta = 1

    joint_target = 2

    cartesian_delta = 3

    cartesian_pose = 4

class EnvironmentBatch:
    """
    Several copies of an arm, each with its own simulation, controller and target.
    """

    def __init__(
        self,
        api: MujocoApi,
        arm: ArmModel,
        law: Law,
        *,
        gear: numpy.ndarray,
        qpos_addresses: numpy.ndarray,
        dof_addresses: numpy.ndarray,
        ctrl_addresses: numpy.ndarray,
        spring_qpos_addresses: numpy.ndarray | None = None,
        spring_dof_addresses: numpy.ndarray | None = None,
        rotor_qpos_addresses: numpy.ndarray | None = None,
        rotor_dof_addresses: numpy.ndarray | None = None,
        limits: numpy.ndarray,
        mode: int,
        size: int,
        ticks: int,
        dt: float,
        joint_scale: float,
        position_scale: float,
        rotation_scale: float,
        smoothing: int,
        approach_rate: float,
        tip_damping: float,
        tip_joints: numpy.ndarray,
        tip_sizes: numpy.ndarray,
        tip_placements: numpy.ndarray,
        home_tips: numpy.ndarray,
        gripper_ctrl: numpy.ndarray,
        gripper_length: numpy.ndarray,
        gripper_ends: numpy.ndarray,
        grip_step: float,
        object_addresses: numpy.ndarray | None = None,
        obstacle: int | None = None,
        max_delay: int,
        q: numpy.ndarray,
        action: numpy.ndarray,
        v: numpy.ndarray,
        target: numpy.ndarray,
        q_ref: numpy.ndarray,
        v_ref: numpy.ndarray,
        tip: numpy.ndarray,
        opening: numpy.ndarray,
        object: numpy.ndarray,
        touched: numpy.ndarray,
        noise: numpy.ndarray | None = None,
    ) -> None:
        """
        Copies without simulations, that work on the arrays; armctl/cpp/environment_batch.hpp explains the arguments.
        """

    def set_simulation(self, row: int, model: object, data: object) -> None:
        """Gives a copy its mujoco.MjModel and MjData."""

    def restart(self, row: int, delay: int) -> None:
        """
        Begins an episode of a copy, whose commands are delayed by some ticks; its arrays are the caller's.
        """

    def step(self, first: int, last: int) -> str:
        """
        Steps the copies [first, last). Returns MuJoCo's message if it could not make a step; else an empty text.
        """

    def rehearse(self, action: numpy.ndarray, target: numpy.ndarray, q_ref: numpy.ndarray, v_ref: numpy.ndarray) -> None:
        """
        Moves target and reference, (n,) each, as a step does; the arms stay where they are.
        """

class AxesRelation(enum.IntEnum):
    """How the axes of some joints are related."""

    MEET = 0

    PARALLEL = 1

class Constraint(enum.Enum):
    """
    Which parts of the tip's pose are constrained; FREE_X leaves the turn about x free.
    """

    POSE = 0

    POSITION = 1

    FREE_X = 2

    FREE_Y = 3

    FREE_Z = 4

class IkAnswer:
    """What a search for one target found."""

    @property
    def solved(self) -> bool:
        """Whether q is a solution."""

    @property
    def jumped(self) -> bool:
        """Whether q is far from q0 although the tip began near the target."""

    @property
    def next_start(self) -> int:
        """The start after the last one used."""

    @property
    def steps(self) -> int:
        """Steps over all starts."""

    @property
    def position_error(self) -> float:
        """m, measured at q."""

    @property
    def orientation_error(self) -> float:
        """rad, measured at q."""

    @property
    def branch(self) -> int:
        """The number of the branch of q."""

class Solutions:
    """How many seeds became solutions, and the effort."""

    @property
    def count(self) -> int: ...
    @property
    def steps(self) -> int: ...
    @property
    def lost(self) -> int:
        """Seeds that led to no solution."""

    @property
    def samples(self) -> int:
        """Positions of the joint that is swept; 1 for six joints."""

    @property
    def doubtful(self) -> bool:
        """Whether the closed form may have missed some."""

LIMIT_ROUNDING: float = 1e-06

NO_BRANCH: int = 27

ROTATION_WEIGHT: float = 0.3333333333333333

SAME_SOLUTION: float = 0.001

class Chain:
    """
    The chain of an arm from its base to the tip, with k joints and n unknowns. Immutable.

    Lengths are in reaches; targets and tolerances of positions are in m. Results are written into the last arguments.
    """

    def __init__(
        self,
        *,
        slides: numpy.ndarray,
        low: numpy.ndarray,
        reach: float,
        high: numpy.ndarray,
        period: numpy.ndarray,
        unknowns: numpy.ndarray,
        ratios: numpy.ndarray,
        rotations: numpy.ndarray,
        translations: numpy.ndarray,
        relation: int | None = None,
        first: int | None = None,
        others: numpy.ndarray | None = None,
        pair_relation: int | None = None,
        pair_first: int | None = None,
        distances_to_points: numpy.ndarray | None = None,
    ) -> None:
        """
        A chain from arrays for each of the k joints, and for each of the n unknowns; armctl/cpp/chain.hpp explains them.
        """

    def contains(self, q: numpy.ndarray) -> bool:
        """Whether q is a contiguous array of n float64 inside the bounds."""

    def search_one(
        self,
        target: numpy.ndarray,
        constraint: Constraint,
        position_tolerance: float,
        orientation_tolerance: float,
        q0: numpy.ndarray,
        last: int,
        seed: int,
        q: numpy.ndarray,
    ) -> IkAnswer:
        """
        Searches from q, then from random starts, for a target (4, 3). Fills q (n,) with the best configuration met.
        """

    def search(
        self,
        targets: numpy.ndarray,
        constraint: Constraint,
        position_tolerance: float,
        orientation_tolerance: float,
        q0: numpy.ndarray,
        first: int,
        last: int,
        seed: int,
        q: numpy.ndarray,
        outcomes: numpy.ndarray,
    ) -> None:
        """
        Searches for each of the targets (N, 12). Fills q (N, n) and outcomes (N, 4): the first four fields of IkAnswer.
        """

    def refine(
        self,
        targets: numpy.ndarray,
        constraint: Constraint,
        rotation_weight: float,
        q0: numpy.ndarray,
        pull: float,
        q: numpy.ndarray,
        squared_errors: numpy.ndarray,
    ) -> None:
        """
        Moves each q (N, n) to a minimum of the squared error plus `pull` times its squared distance from q0.
        """

    def search_regions(
        self,
        regions: numpy.ndarray,
        numbers: numpy.ndarray,
        position_tolerance: float,
        orientation_tolerance: float,
        q0: numpy.ndarray,
        q: numpy.ndarray,
        solved: numpy.ndarray,
        steps: numpy.ndarray,
    ) -> None:
        """
        Descends from each q (K, n) into the region (R, 38) of its number (K,), and winds it to q0 (n,). Fills solved and steps (K,).
        """

    def slide_in_regions(
        self,
        regions: numpy.ndarray,
        numbers: numpy.ndarray,
        position_tolerance: float,
        orientation_tolerance: float,
        q0: numpy.ndarray,
        q: numpy.ndarray,
        solved: numpy.ndarray,
        steps: numpy.ndarray,
    ) -> None:
        """
        As search_regions, but slides each q towards q0 within its region first.
        """

    def relax_in_regions(
        self,
        regions: numpy.ndarray,
        spacing: numpy.ndarray,
        position_tolerance: float,
        orientation_tolerance: float,
        is_start_held: bool,
        sweeps: int,
        q: numpy.ndarray,
    ) -> None:
        """
        Shortens the path q (N, n), each row of which stays in its region (N, 38); spacing (N - 1,) is between them.
        """

    def random_starts(self, q0: numpy.ndarray, first: int, seed: int, q: numpy.ndarray) -> None:
        """
        Fills q (B, n) with random configurations of numbers from `first` on: odd ones inside the bounds, others in one turn.
        """

    def descend(
        self,
        target: numpy.ndarray,
        constraint: Constraint,
        position_tolerance: float,
        orientation_tolerance: float,
        q: numpy.ndarray,
        solved: numpy.ndarray,
        steps: numpy.ndarray,
    ) -> None:
        """
        Descends from each q (B, n) to a solution for a target (12,), without regard to the bounds of hinges.
        """

    def branches(self, q: numpy.ndarray, branches: numpy.ndarray) -> None:
        """Fills branches (N,) with the numbers of those of q (N, n)."""

class IkErrorModel:
    """
    Half the squared error around a configuration, with scratch memory: use an object in one thread at a time.
    """

    def __init__(self, chain: Chain) -> None: ...
    def linearize(
        self,
        target: numpy.ndarray,
        constraint: Constraint,
        position_priority: float,
        q: numpy.ndarray,
        hessian: numpy.ndarray,
        gradient: numpy.ndarray,
        J: numpy.ndarray,
    ) -> float:
        """
        Fills the Hessian (n, n) with the curvature of the chain, J^T e (n,) and J (6, n), where a third of a reach
        counts like a rad. Returns the norm of the error.
        """

class ClosedForm:
    """
    The closed form of six hinges; armctl/cpp/closed_form.hpp explains it. Immutable.
    """

    def __init__(self, chain: Chain, held: int | None) -> None:
        """Of a chain with special axes; of seven hinges, one is held."""

    def solve_all(
        self,
        target: numpy.ndarray,
        q0: numpy.ndarray,
        position_tolerance: float,
        orientation_tolerance: float,
        slack: float,
        margin: float,
        positions: numpy.ndarray,
        least: int,
        wanted: int,
        q: numpy.ndarray,
        position_errors: numpy.ndarray,
        orientation_errors: numpy.ndarray,
        branches: numpy.ndarray,
    ) -> Solutions:
        """
        Fills q (M, n), errors and branches (M,) with the solutions for a target (4, 3), refined, the nearest to q0 first.
        """

    def find_first(
        self,
        targets: numpy.ndarray,
        q0: numpy.ndarray,
        slack: float,
        margin: float,
        positions: numpy.ndarray,
        q: numpy.ndarray,
        found: numpy.ndarray,
    ) -> None:
        """
        Fills q (N, n) with a configuration for each of the targets (N, 12) that has any.
        """

REGION_NUMBERS: int = 38

def region_coordinates(region: numpy.ndarray, tips: numpy.ndarray, coordinates: numpy.ndarray) -> None:
    """
    Fills coordinates (K, 6) with x, y, z, roll, pitch and yaw of tips (K, 12) in a region (38,), or with x, y, z and the tilt.
    """

def nearest_members(region: numpy.ndarray, tips: numpy.ndarray, members: numpy.ndarray) -> None:
    """
    Fills members (K, 12) with the poses of a region (38,) that are nearest to the tips (K, 12).
    """

def residuals(
    constraint: Constraint,
    targets: numpy.ndarray,
    positions: numpy.ndarray,
    rotations: numpy.ndarray,
    position_errors: numpy.ndarray,
    orientation_errors: numpy.ndarray,
) -> None:
    """
    The errors of tips (N, 3) and (N, 3, 3) for targets (N, 12), (N,) each.
    """

class Law:
    """
    A control law with its memory and scratch memory: use an object for one arm at a time. armctl/cpp/law.hpp explains it.
    """

    @property
    def n(self) -> int:
        """The number of joints."""

    @property
    def needs_wrench(self) -> bool:
        """Whether `torque` reads the measured wrench."""

    def torque(
        self, q: numpy.ndarray, v: numpy.ndarray, reference: numpy.ndarray, wrench: numpy.ndarray, tau: numpy.ndarray
    ) -> None:
        """
        The torque for the coming control period, written into tau (n,) N m.

        `reference` has the (5, n) rows q, v, a, v_tick, a_tick of a setpoint; k rows each of q, v_tick and a_tick of the ticks
        from this one on may follow, if they are known.
        `wrench` (6,) is not read by a law that does not need it.
        """

    def applied(self, tau: numpy.ndarray) -> None:
        """
        Tells that the motors got torques (n,) N m that are not those of the last call of `torque`.
        """

    @property
    def memory(self) -> NDArray[numpy.float64]:
        """
        What the law keeps from tick to tick; an array that shares the memory of the law.
        """

    def reset(self) -> None:
        """Begins a new run."""

    def clone(self) -> Law:
        """The same law and gains with memory of its own, at the start of a run."""

class PD(Law):
    """tau = stiffness (q_ref - q) + damping (v_ref - v)"""

    def __init__(self, *, stiffness: numpy.ndarray, damping: numpy.ndarray) -> None: ...

class PDFeedforward(Law):
    """PD with the torque of the reference motion."""

    def __init__(self, of: ArmModel, *, stiffness: numpy.ndarray, damping: numpy.ndarray) -> None: ...

class PDGravity(Law):
    """PD with gravity compensation."""

    def __init__(self, of: ArmModel, *, stiffness: numpy.ndarray, damping: numpy.ndarray) -> None: ...

class TorqueRateLimit(Law):
    """A law whose torques change at limited rates."""

    def __init__(self, of: Law, *, tau_rate_max: numpy.ndarray, dt: float) -> None: ...

class TorqueFilter(Law):
    """
    A law whose torques go through filters of second-order sections: rows of b0, b1, b2, a0 = 1, a1, a2, as in SciPy.
    """

    def __init__(self, of: Law, *, sections: numpy.ndarray) -> None: ...

class CFunctionLaw(Law):
    """
    A compiled C function as a law; armctl/cpp/laws/c_function.hpp has its signature.
    """

    def __init__(self, address: int, *, n: int, parameters: numpy.ndarray, memory_size: int, needs_wrench: bool) -> None: ...

BODY_PARAMETERS: int = 10

class ComputedTorque(Law):
    """
    Computed torque; with weights of an estimate, at estimated positions and velocities.
    """

    def __init__(
        self,
        of: ArmModel,
        *,
        stiffness: float,
        damping: float,
        added_damping: numpy.ndarray,
        decay_rate: float,
        textbook: bool,
        torque_limit: numpy.ndarray,
        position_weight: float,
        velocity_weight: float,
        dt: float,
        continuous: bool,
    ) -> None: ...

class LQR(Law):
    """
    Linear quadratic regulator with integral action, at estimated positions and velocities.
    """

    def __init__(
        self,
        of: ArmModel,
        *,
        nodes: numpy.ndarray,
        feedback: numpy.ndarray,
        torque_limit: numpy.ndarray,
        position_weight: float,
        velocity_weight: float,
        dt: float,
        continuous: bool,
    ) -> None: ...

class ComputedTorqueObserver(Law):
    """Computed torque with a disturbance observer that estimates velocities."""

    def __init__(
        self,
        of: ArmModel,
        *,
        stiffness: float,
        damping: float,
        disturbance_weight: float,
        torque_limit: numpy.ndarray,
        position_weight: float,
        velocity_weight: float,
        dt: float,
        continuous: bool,
    ) -> None: ...
    @property
    def disturbance(self) -> NDArray[numpy.float64]:
        """The estimated disturbance, (n,) N m; a part of the memory."""

class ComputedTorqueLearning(Law):
    """
    Computed torque with an observer, which learns payload, friction and delay.
    """

    def __init__(
        self,
        of: ArmModel,
        *,
        stiffness: float,
        damping: float,
        disturbance_weight: float,
        torque_limit: numpy.ndarray,
        position_weight: float,
        velocity_weight: float,
        dt: float,
        continuous: bool,
        filter_weight: float,
        information_weight: float,
        forgetting: float,
        torque_precision: numpy.ndarray,
        prior_deviations: numpy.ndarray,
    ) -> None: ...
    @property
    def disturbance(self) -> NDArray[numpy.float64]:
        """The estimated disturbance, (n,) N m; a part of the memory."""

    @property
    def estimate(self) -> NDArray[numpy.float64]:
        """
        The ten parameters of the payload, the delay, s, and the dry friction of the joints, N m; a part of the memory.
        """

class ComputedTorqueQP(Law):
    """Computed torque within limits of torque, velocity and position."""

    def __init__(
        self,
        of: ArmModel,
        *,
        stiffness: float,
        damping: float,
        added_damping: numpy.ndarray,
        decay_rate: float,
        torque_limit: numpy.ndarray,
        q_min: numpy.ndarray,
        q_max: numpy.ndarray,
        v_max: numpy.ndarray,
        a_max: numpy.ndarray,
        length: float,
        dt: float,
        continuous: bool,
    ) -> None: ...

class MPC(Law):
    """
    Model predictive control within limits of torque, velocity and position.
    """

    def __init__(
        self,
        of: ArmModel,
        *,
        blocks: numpy.ndarray,
        stiffness: float,
        damping: float,
        added_damping: numpy.ndarray,
        decay_rate: float,
        torque_limit: numpy.ndarray,
        q_min: numpy.ndarray,
        q_max: numpy.ndarray,
        v_max: numpy.ndarray,
        a_max: numpy.ndarray,
        length: float,
        dt: float,
        continuous: bool,
        torque_rate: numpy.ndarray,
    ) -> None: ...
    @property
    def counts(self) -> NDArray[numpy.float64]:
        """
        Ticks: all, those that needed a plan, and those without one; a part of the memory.
        """

UNBOUNDED: float = 1e30

def solve_program(
    H: numpy.ndarray, f: numpy.ndarray, M: numpy.ndarray, lower: numpy.ndarray, upper: numpy.ndarray, x: numpy.ndarray
) -> bool:
    """
    Minimizes x H x / 2 + f x subject to lower <= (x, M x) <= upper; whether there is a solution, which is written into x.
    """

SINGULARITY_DAMPING: float = 0.001

class OperationalSpace(Law):
    """Operational space control with a posture in the null space."""

    def __init__(
        self, of: ArmModel, *, stiffness: float, damping: float, posture_stiffness: float, posture_damping: float
    ) -> None: ...

class Impedance(Law):
    """Cartesian impedance control without inertia shaping."""

    def __init__(
        self,
        of: ArmModel,
        *,
        stiffness: numpy.ndarray,
        max_error: numpy.ndarray,
        posture_stiffness: numpy.ndarray,
        damping_ratio: float,
    ) -> None: ...
    def set_stiffness(self, stiffness: numpy.ndarray) -> None:
        """Replaces the stiffness of the tip, (6,) N/m and N m/rad."""

class Admittance(Law):
    """Admittance control: a position loop follows a compliant reference."""

    def __init__(
        self,
        of: ArmModel,
        *,
        mass: numpy.ndarray,
        damping: numpy.ndarray,
        stiffness: numpy.ndarray,
        bandwidth: float,
        dt: float,
    ) -> None: ...
    @property
    def offset(self) -> NDArray[numpy.float64]:
        """
        The displacement of the reference, (6,) m and rad; a part of the memory.
        """

class HybridForce(Law):
    """Hybrid force/motion control with contact transition."""

    def __init__(
        self,
        of: ArmModel,
        *,
        bandwidth: float,
        damping_ratio: float,
        in_tip_frame: bool,
        approach_speed: float,
        contact_force: float,
        dt: float,
        targets: numpy.ndarray,
        is_force: numpy.ndarray,
    ) -> None: ...
    def set_axes(self, is_force: numpy.ndarray, targets: numpy.ndarray) -> None:
        """
        Replaces the force axes, `is_force` and `targets` (6,). One that comes back later begins with an approach.
        """

    @property
    def in_contact(self) -> bool:
        """Whether every force axis with a target is in contact."""

def fastest_path_speed(
    coefficients: numpy.ndarray,
    interval_length: float,
    from_near: bool,
    *,
    interval: numpy.ndarray,
    damping: numpy.ndarray,
    j_max: numpy.ndarray,
    weights: numpy.ndarray,
    b_max: numpy.ndarray,
    force_end: numpy.ndarray,
    force_weights: numpy.ndarray,
    low: numpy.ndarray,
    high: numpy.ndarray,
    jerk_end: numpy.ndarray,
    jerk_weights: numpy.ndarray,
) -> bool:
    """
    Fills the coefficients of the squared path speed that takes the least time; False if none keeps the bounds.

    With from_near they hold the solution for bounds that are a little different. armctl/cpp/path_timing.hpp explains
    the bounds.
    """

def make_fastest(
    motion: numpy.ndarray,
    from_near: bool,
    *,
    q: numpy.ndarray,
    v_max: numpy.ndarray,
    a_max: numpy.ndarray,
    j_max: numpy.ndarray,
    v_bound: numpy.ndarray,
    a_bound: numpy.ndarray,
) -> None:
    """
    Replaces a motion through K waypoints by the fastest one.

    With from_near it is nearly that already. armctl/cpp/waypoint_timing.hpp explains the arguments.
    """

class RrtConnect:
    """
    Trees of proved lines from a start and from goals. Uses the proof's memory: one thread at a time.
    """

    def __init__(
        self,
        proof: ClearanceProof,
        clearance: float,
        start: numpy.ndarray,
        goals: numpy.ndarray,
        low: numpy.ndarray,
        high: numpy.ndarray,
        capacity: int,
    ) -> None:
        """
        Trees from a start (n,) and goals (g, n) that are free, between bounds (n,), with at most `capacity` nodes each.
        All lines keep more than the clearance, m, and the tip in the proof's region.
        """

    def grow(self, samples: numpy.ndarray) -> int:
        """
        Grows the trees towards samples (k, n) until they meet. Returns how many samples it took.
        """

    def way(self, start: numpy.ndarray, goal: numpy.ndarray) -> list[list[float]]:
        """
        The points of the way from a configuration (n,) to another in steps, as a tree grows; empty if something is in the way.
        """

    def project(self, q: numpy.ndarray) -> bool:
        """
        Moves configurations (k, n) by the least motion of the joints until the tip is well inside its region; False if it fails.
        """

    @property
    def step(self) -> float:
        """The longest line of a tree, rad (m)."""

    def path(self) -> list[list[float]]:
        """
        The points from the start to a goal; empty as long as the trees have not met.
        """

class MujocoApi:
    """
    MuJoCo's functions by their addresses, and where mjData keeps contacts.
    """

    def __init__(
        self,
        empty_model: object,
        *,
        step: int,
        rne_post_constraint: int,
        make_batch: int,
        delete_batch: int,
        apply: int,
        error: int,
        contact_count: int,
        contact_array: int,
        contact_stride: int,
        contact_geoms: int,
        contact_exclude: int,
        repair_first: int,
        repair_stride: int,
    ) -> None: ...

class Delay:
    """Commands that reach the motors some ticks after they were given."""

    def __init__(self, n: int, max_ticks: int) -> None: ...
    def restart(self, ticks: int) -> None:
        """Forgets all commands, and delays those to come by some ticks."""

    def delayed(self, tau: numpy.ndarray, delayed: numpy.ndarray) -> None:
        """
        Takes the command of this tick, (n,) N m, and gives that of some ticks ago.
        """

class Sensors:
    """How the sensors of a plant measure its joints during a run."""

    def __init__(
        self,
        *,
        gear: numpy.ndarray,
        qpos_addresses: numpy.ndarray,
        dof_addresses: numpy.ndarray,
        ctrl_addresses: numpy.ndarray,
        motor_addresses: numpy.ndarray,
        spring_qpos_addresses: numpy.ndarray | None = None,
        spring_dof_addresses: numpy.ndarray | None = None,
        rotor_qpos_addresses: numpy.ndarray | None = None,
        rotor_dof_addresses: numpy.ndarray | None = None,
        dt: float,
        is_at_motors: bool,
        is_differenced: bool,
        max_age: int,
        steps: numpy.ndarray | None = None,
    ) -> None:
        """
        Sensors at the start of a run; armctl/cpp/sensors.hpp explains the arguments.
        """

    @property
    def has_measured(self) -> bool:
        """Whether this tick is measured already."""

    def measure(self, model: object, data: object, noise: numpy.ndarray, ages: numpy.ndarray) -> None:
        """
        Measures, once in a tick, with noise (2, n) on positions and velocities; `ages`, (n,), is by how many ticks what is read is old.
        """

    def read(self, q: numpy.ndarray, v: numpy.ndarray, deflection: numpy.ndarray) -> None:
        """
        What was read at this tick: (n,) rad, (n,) rad/s, and (2, n) motors minus links.
        """

class CallbackLaw(Law):
    """A law in Python, which is called at every tick."""

    def __init__(self, call: object, tau: object) -> None:
        """
        `call()` writes the torque, (n,) N m, into the array `tau`. If it raises, the ticks end, and `TickLoop.run` raises it.
        """

class WrenchSensor:
    """The wrench of the environment on a tip, true or measured."""

    def __init__(
        self,
        api: MujocoApi,
        model: object,
        data: object,
        arm: ArmModel,
        *,
        bodies: numpy.ndarray,
        root: int,
        tip: int,
        offset: numpy.ndarray,
        is_connected: bool,
        is_sampled: bool,
        dt: float,
        delay: int,
        estimated: int,
    ) -> None:
        """
        A sensor in a mujoco.MjModel and MjData; armctl/cpp/wrench_sensor.hpp explains the arguments.
        """

    def reset(self) -> None:
        """Forgets all measurements."""

    def has_measured(self, t: float) -> bool:
        """Whether the measurement at a time, s, is made already."""

    def read(self, push: numpy.ndarray | None, wrench: numpy.ndarray) -> None:
        """The true wrench now, (6,), with that of the plant's pushes."""

    def measure(
        self,
        q: numpy.ndarray,
        v: numpy.ndarray,
        tau: numpy.ndarray,
        t: float,
        noise: numpy.ndarray | None,
        push: numpy.ndarray | None,
        wrench: numpy.ndarray,
        truth: numpy.ndarray,
    ) -> None:
        """
        What the sensor gives at this tick, and the true wrench, (6,) each.

        The state and the torque of the motors in the last tick are measured, (n,) each.
        """

class TickStatus(enum.Enum):
    """Why the ticks ended."""

    complete = 0

    diverged = 1

    not_finite = 2

    repaired = 3

class TickEnd:
    """How some ticks ended."""

    def __init__(self, row: int) -> None:
        """An object for `TickLoop.run`, which begins at a row."""

    @property
    def status(self) -> TickStatus: ...
    @property
    def row(self) -> int:
        """The last row that was begun."""

    @property
    def count(self) -> int:
        """Complete rows."""

    @property
    def measured(self) -> int:
        """Rows in which the state was measured."""

    @property
    def driven(self) -> int:
        """Rows in which the motors got a command."""

    @property
    def error(self) -> str:
        """MuJoCo's message if it could not make a step; else empty."""

    @property
    def contacts(self) -> list:
        """
        (row, geoms) for each row at which the touching geoms change; `geoms` are pairs of int32.
        """

class TickLoop:
    """
    The tick loop of one simulation: measure, control, step, record. One thread at a time.
    """

    def __init__(
        self,
        api: MujocoApi,
        model: object,
        data: object,
        pushed_arm: ArmModel,
        *,
        gear: numpy.ndarray,
        qpos_addresses: numpy.ndarray,
        dof_addresses: numpy.ndarray,
        ctrl_addresses: numpy.ndarray,
        motor_addresses: numpy.ndarray,
        spring_qpos_addresses: numpy.ndarray | None = None,
        spring_dof_addresses: numpy.ndarray | None = None,
        rotor_qpos_addresses: numpy.ndarray | None = None,
        rotor_dof_addresses: numpy.ndarray | None = None,
        substeps: int,
        dt: float,
        diverged_speed: float,
    ) -> None:
        """
        The loop of a mujoco.MjModel and MjData; armctl/cpp/tick_loop.hpp explains the arguments.
        """

    def run(
        self,
        law: Law,
        end: TickEnd,
        sensors: Sensors | None,
        delay: Delay | None,
        joint_torque: Law | None,
        wrench_sensors: Sequence[WrenchSensor],
        touching: bytes,
        *,
        v_rows: numpy.ndarray,
        first: int,
        last: int,
        q: numpy.ndarray,
        v: numpy.ndarray,
        a: numpy.ndarray,
        v_tick: numpy.ndarray,
        a_tick: numpy.ndarray,
        qpos_rows: numpy.ndarray,
        command_rows: numpy.ndarray,
        torque_rows: numpy.ndarray,
        tips: int,
        wrench_rows: numpy.ndarray | None = None,
        noise: numpy.ndarray | None = None,
        ages: numpy.ndarray | None = None,
        jitter: numpy.ndarray | None = None,
        pushes: numpy.ndarray | None = None,
        push: numpy.ndarray | None = None,
        times: numpy.ndarray | None = None,
        wrench_noise: numpy.ndarray | None = None,
        q_seen_rows: numpy.ndarray | None = None,
        v_seen_rows: numpy.ndarray,
        wrench_seen_rows: numpy.ndarray | None = None,
        deflection_seen_rows: numpy.ndarray | None = None,
    ) -> None:
        """
        Runs the ticks [first, last) of a reference and records them; `Ticks` in armctl/cpp/tick_loop.hpp explains the arrays, and `tips` is the number of wrench sensors.

        How they ended is written into `end`: an exception of a law in Python, or an interrupt, which raises when the call returns, would lose a result. `touching` are the geoms that touch in the row before, as in `TickEnd.contacts`.
        """

class StepEnd(enum.IntEnum):
    """How a step ended."""

    SOLVED = 0

    HELD_BACK = 1

class TreeSearch:
    """What a search found."""

    @property
    def solved(self) -> bool:
        """Whether q is a solution."""

    @property
    def starts(self) -> int:
        """How many starts were used."""

    @property
    def steps(self) -> int:
        """Steps over all starts."""

class TreeIk:
    """
    Inverse kinematics of a tree with T tasks, with scratch memory: use an object in one thread at a time.

    Targets (T, 12) are rotations row by row and positions, m. Results are written into the last arguments.
    """

    def __init__(
        self,
        model: ArmModel,
        *,
        joints: numpy.ndarray,
        unit: numpy.ndarray,
        reference_joints: numpy.ndarray,
        constraints: numpy.ndarray,
        points: numpy.ndarray,
        exact: numpy.ndarray,
        placements: numpy.ndarray,
        reference_placements: numpy.ndarray,
        fixed: numpy.ndarray,
        reach: float,
        q_min: numpy.ndarray,
        q_max: numpy.ndarray,
        v_max: numpy.ndarray,
        a_max: numpy.ndarray,
        polygon: numpy.ndarray,
    ) -> None:
        """
        A tree from arrays for its n unknowns, its tasks and a polygon; armctl/cpp/bindings/tree_ik.cpp explains them.
        """

    def step(
        self,
        targets: numpy.ndarray,
        q: numpy.ndarray,
        v_before: numpy.ndarray,
        dt: float,
        posture: numpy.ndarray,
        posture_gain: float,
        posture_weight: float,
        v: numpy.ndarray,
    ) -> StepEnd:
        """
        Fills v (n,) with the speeds that bring the frames nearer to the targets in dt, after v_before (n,).
        """

    def search(
        self,
        targets: numpy.ndarray,
        position_tolerance: float,
        orientation_tolerance: float,
        first: int,
        last: int,
        seed: int,
        q: numpy.ndarray,
    ) -> TreeSearch:
        """
        Searches from q (n,), then from random starts, and fills q with a solution, or with the best approximation.
        """

    def errors(self, targets: numpy.ndarray, q: numpy.ndarray, errors: numpy.ndarray) -> float:
        """
        Fills errors (T, 2), m and rad, at q (n,). Returns by how much the center of mass is outside the polygon, m.
        """

    def frames(self, q: numpy.ndarray, frames: numpy.ndarray) -> None:
        """Fills frames (T, 12) with the poses of the tasks' frames at q (n,)."""
