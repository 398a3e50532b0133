"""DifferentialIk: joint velocities that follow moving targets under limits.

A single target is a quadratic program with mink's tasks; targets by tip are one of the compiled core.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.region import Region
from armctl.core.target import TargetLike
from armctl.core.tip_targets import TipTargets, read_polygon
from armctl.core.validation import Array, choice, frozen, number, vector
from armctl.model.arm.arm import Arm, check_arm, check_one_tip
from armctl.plan.ik.target_program import QP_SOLVERS, TargetProgram
from armctl.plan.ik.tree_steps import Posture, TreeSteps

if TYPE_CHECKING:
    import mink
    from mink.tasks import BaseTask

    from armctl.plan.ik.tasks import TipTask


_MAX_POSTURE_WEIGHT = 1e3
_ADDITIONS = "avoid, tasks, limits and constraints"


class DifferentialIk:
    """Follows a target, or targets by tip, with joint velocities. Position and velocity limits hold even if the solver fails.

    Targets by tip also respect the acceleration limits: each step begins with the velocity of the last one, and always leaves
    room to stop before a position limit.

    Attributes:
        status: How the last step ended: "solved", "held back" (shortened, because it would have ended too near a body; or
            limits hold, and tips that stay or are relative do not for now), or "no solution" (the velocity is zero).
    """

    def __init__(
        self,
        arm: Arm,
        *,
        posture: ArrayLike | None = None,
        posture_gain: float = 4.0,
        posture_weight: float = 0.0,
        avoid: bool = False,
        clearance: float = 0.01,
        tasks: Sequence[BaseTask] = (),
        limits: Sequence[mink.Limit] = (),
        constraints: Sequence[mink.Task] = (),
        solver: str = "daqp",
        center_of_mass_within: ArrayLike | None = None,
    ):
        """Prepares the program of an arm.

        Args:
            posture: (n,) rad (m for a slide joint), which the joints approach as far as the tip leaves them free. By default
                the arm's home.
            posture_gain: 1/s, the gain of the posture; 0 disables it.
            posture_weight: How much the posture counts while tips are away from their targets, with targets by tip. With 0, a
                tip comes as near as possible to a target out of reach, and joints may wind to where they find no way back. With
                0.1, they keep nearer to the posture, and come less near to targets that are far out of reach. At targets that
                are reached it makes no difference.
            avoid: Whether to keep the arm clear of itself and of the scene.
            clearance: m, the distance to keep.
            tasks: Further mink tasks, made for `arm.model`.
            limits: Further mink limits, made for `arm.model`.
            constraints: mink tasks that must hold exactly.
            solver: The QP solver, "daqp" (an active set, the faster one) or "osqp".
            center_of_mass_within: (K, 2) m, the corners of a convex polygon on the ground above which the robot's center of
                mass is kept, with targets by tip.

        Raises:
            InputError: An argument has a wrong shape, type or value.
            LimitError: The posture is outside the joint limits.
            ModelError: The arm could touch a height field or signed distance field, which `avoid` cannot avoid.
        """
        check_arm(arm)
        choice("solver", solver, QP_SOLVERS)
        rest = arm.home if posture is None else arm.checked("posture", posture)
        gain = number("posture_gain", posture_gain, 0.0)
        self.arm = arm
        self.status = "solved"
        self._polygon = read_polygon("center_of_mass_within", center_of_mass_within)
        weight = number("posture_weight", posture_weight, 0.0, _MAX_POSTURE_WEIGHT)
        if weight and not gain:
            raise InputError("posture_weight: without a gain no joint goes to the posture; give a posture_gain above 0")
        if weight and (avoid or tasks or limits or constraints):
            raise InputError(f"posture_weight: it is for targets by tip, which do without {_ADDITIONS}; leave one of both out")
        self._tree = TreeSteps(arm, Posture(rest, gain, weight), self._polygon)
        self._program = None
        if not arm.further_tips:
            self._program = TargetProgram(arm, rest, gain, avoid, clearance, tasks, limits, constraints, solver)
        elif avoid or tasks or limits or constraints:
            raise InputError(f"{_ADDITIONS} are for an arm with one tip; give none for targets by tip")

    @property
    def tip(self) -> TipTask:
        """The mink task that brings the tip of an arm with one tip to the target."""
        return self._only_program.tip

    @property
    def configuration(self) -> mink.Configuration:
        """The configuration of mink at the last step of an arm with one tip."""
        return self._only_program.configuration

    def step(self, q: ArrayLike, target: TargetLike | Region | TipTargets, dt: float, *, free_axis: str | None = None) -> Array:
        """The joint velocity that brings the tip nearer to the target, or several tips nearer to theirs.

        Args:
            q: (n,) rad (m for a slide joint), the current configuration; joints outside their limits move back in.
            target: A Pose, (3,) m for position only, or a Target; a Region, of which this step approaches the member nearest to
                the tip; or targets by tip as for `solve_ik`.
            dt: s, for how long the velocity will be held.
            free_axis: "x", "y" or "z": the tip's axis about which the target may be turned freely.

        Returns:
            (n,) rad/s (m/s for a slide joint).

        Raises:
            InputError: An argument has a wrong shape, type or value.
            LimitError: A joint is half a turn (1 m) or more outside its limits, as degrees are.
        """
        start = vector("q", q, self.arm.n)
        self.arm.check_units("q", start)
        dt = number("dt", dt, 1e-9)
        if isinstance(target, Region):
            check_one_tip(self.arm)
            target = target.nearest(self.arm.fk(start)).pose
        if not isinstance(target, Mapping) and (len(self._polygon) or self._tree.posture.weight):
            check_one_tip(self.arm)
            target = {self.arm.tip: target}
        if not isinstance(target, Mapping):
            v, self.status = self._only_program.step(start, target, dt, free_axis)
            return frozen(v)
        if self._program is not None and self._program.has_additions:
            raise InputError(f"target: {_ADDITIONS} are for a single target, not for targets by tip; leave one of both out")
        v, is_exact = self._tree.step(start, target, dt, free_axis)
        self.status = "solved" if is_exact else "held back"
        return frozen(v)

    def reset(self, v: ArrayLike | None = None) -> None:
        """Forgets the last step: targets by tip go on from a velocity, and tips that stay do so where they are then.

        Args:
            v: (n,) rad/s, the velocity; None for standstill.
        """
        self._tree = TreeSteps(self.arm, self._tree.posture, self._polygon)
        if v is not None:
            self._tree.v = vector("v", v, self.arm.n)

    @property
    def _only_program(self) -> TargetProgram:
        """The program of an arm with one tip; an InputError for several."""
        if self._program is None:
            check_one_tip(self.arm)
        assert self._program is not None
        return self._program
