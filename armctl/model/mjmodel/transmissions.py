"""Transmissions: which actuator moves a joint, and which joints an equality couples to it.

Joints that equalities couple at fixed ratios (a mimic joint, a pair of fingers on one motor, a telescope) are one degree of
freedom, and an arm counts them as one joint. MuJoCo's equalities are soft constraints; armctl takes them as rigid.
"""

from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.validation import shown
from armctl.model.mjmodel.closed_loops import find_loops, loop_equalities
from armctl.model.mjmodel.couplings import Couplings, tendon_coefficients
from armctl.model.mjmodel.queries import (
    SCALAR,
    Joints,
    actuator_name,
    is_damper,
    is_disabled,
    is_on_joint,
    is_powerless,
    joint_actuators,
    joint_name,
    name_of,
)
from armctl.model.mjmodel.spring_joints import spring_joints

_PARALLEL = 1e-9  # of the cosine between the moments of two actuators


@dataclass(frozen=True)
class Mimic:
    """How a joint follows another: position = ratio x position of the other + offset."""

    ratio: float  # speed of the joint per unit speed of the other
    offset: float  # rad (m), its position when the other is at zero


@dataclass(frozen=True)
class Transmission:
    """What moves a joint."""

    joint: int
    actuator: int
    moments: dict[int, float]  # torque on each joint that the actuator acts on, per unit of actuator force, N m
    coupled: dict[int, Mimic]  # the joints that move as one with this one, itself first, and how they follow it
    # Further actuators on the same joints, whose moments are multiples of these, and the gear of each: one motor replaces all
    added: dict[int, float] = field(default_factory=dict)
    idle: tuple[int, ...] = ()  # actuators that the file switches off: by their gains, or by the options for their group

    @property
    def gear(self) -> float:
        """Torque on the joint per unit of actuator force, by virtual work, all coupled joints included, N m."""
        return generalized_gear(self.moments, self.coupled)


class Transmissions:
    """The transmissions of a compiled model. Each joint is analysed once."""

    def __init__(self, model: mujoco.MjModel, *, opened: bool = False):
        """Reads the actuators, equalities and tendons of a model. If it is `opened`, loops of links tie no joints."""
        self.model = model
        self.moments = [moments_of(model, actuator) for actuator in range(model.nactuator)]  # `nu` counts controls
        candidates = loop_equalities(model)
        loops = find_loops(model, Transmissions(model, opened=True).mimics_of) if candidates and not opened else []
        # Closed loops that move with their motors, by each of their joints
        self.loops = {joint: loop for loop in loops if not loop.reason for joint in loop.joints}
        self.passive = {joint: loop for joint, loop in self.loops.items() if joint in loop.passive}  # joints without a motor
        kept = {equality for loop in self.loops.values() for equality in (*loop.equalities, *loop.ties)}
        remarks = {equality: loop.reason for loop in loops for equality in loop.equalities}
        self._couplings = Couplings(model, candidates if opened else kept, remarks)
        self._known: dict[int, Transmission | str] = {}
        self._without_motor: set[int] = set()  # of the joints that were analysed
        self._acting_on: dict[int, list[int]] = {}
        for actuator, moments in enumerate(self.moments):
            for joint in moments:
                self._acting_on.setdefault(joint, []).append(actuator)

    def of(self, joint: int) -> Transmission | str:
        """What moves a joint; if no single actuator can drive it, the reason."""
        if joint not in self._known:
            self._known[joint] = self._analysed(joint)
        return self._known[joint]

    def of_chain(self, joints: Joints) -> tuple[Transmission, ...]:
        """One transmission per driven degree of freedom of a chain, from the base to the tip; ModelError if one has none.

        The joint of each is the first of its coupled joints in the chain. All motors of a closed loop belong to a chain
        that has joints of it; in the place of a passive joint are those that are not in the chain.
        """
        found: list[Transmission] = []
        covered: set[int] = set()
        for joint in self._with_drivers(joints):
            if joint in covered or joint in self.springs:
                continue
            transmission = self.of(joint)
            if isinstance(transmission, str):
                raise ModelError(transmission)
            found.append(transmission)
            covered |= transmission.coupled.keys()
        return tuple(found)

    def _with_drivers(self, joints: Joints) -> list[int]:
        """A chain without its passive joints, and with the drivers of its loops that are not in it."""
        found: list[int] = []
        for joint in joints:
            found += [each for each in self.passive[joint].drivers if each not in joints] if joint in self.passive else [joint]
        missing = [driver for joint in joints if joint in self.loops for driver in self.loops[joint].drivers]
        return [*found, *(driver for driver in missing if driver not in found)]

    def mimics_of(self, joint: int) -> dict[int, float] | str | None:
        """The joints that a joint's motor moves, and their speeds per its leader's; None without a motor; or the reason."""
        transmission = self.of(joint)
        if isinstance(transmission, Transmission):
            return {other: mimic.ratio for other, mimic in transmission.coupled.items()}
        return None if joint in self._without_motor else transmission

    def acting_on(self, joints: Joints | set[int]) -> list[int]:
        """The actuators that act on these joints and on no other joint, in ascending order."""
        acting = {actuator for joint in joints for actuator in self._acting_on.get(joint, [])}
        return sorted(actuator for actuator in acting if self.moments[actuator].keys() <= set(joints))

    def coupling_reason(self, joint: int) -> str:
        """Why a joint does not move independently of all others; empty if it does."""
        return self._couplings.reason(joint, frozenset([joint]))

    @cached_property
    def actuators(self) -> dict[int, int]:
        """The leading actuator of each joint that has one, acting directly or through coupled joints."""
        found = [self.of(joint) for joint in range(self.model.njnt)]
        through = {each.joint: each.actuator for each in found if isinstance(each, Transmission)}
        return joint_actuators(self.model) | through

    def gear_of(self, actuator: int, coupled: dict[int, Mimic]) -> float:
        """Torque on the leading joint of coupled joints per unit of an actuator's force, N m."""
        return generalized_gear(self.moments[actuator], coupled)

    @cached_property
    def springs(self) -> dict[int, int]:
        """The spring joints of elastic joints, and the joint of the motor before each."""
        return spring_joints(self.model)

    def _analysed(self, joint: int) -> Transmission | str:
        model = self.model
        name = shown(joint_name(model, joint))
        if model.jnt_type[joint] not in SCALAR:
            return f"joint {name} is a ball joint, not a hinge or slide"
        coupled = self._coupled_with(joint)
        if isinstance(coupled, str):
            return coupled
        for other in coupled:
            if reason := self._couplings.reason(other, frozenset(coupled)):
                return reason
        driving, idle = self._driving(coupled)
        others = ", ".join(shown(joint_name(model, j)) for j in coupled if j != joint)
        if not driving:
            self._without_motor.add(joint)
            return f"joint {name} has no actuator of its own" + (
                f", nor has {others}, tied to it by equalities" if others else ""
            )
        first, *added = driving
        names = " and ".join(shown(actuator_name(model, actuator)) for actuator in driving)
        if any(not _are_parallel(self.moments[first], self.moments[other]) for other in added):
            return f"joint {name} and {others} are tied to each other by equalities, yet several actuators move them: {names}"
        if reason := _why_not_one_motor(model, driving):
            return f"joint {name} is moved by {names}, and {reason}: one motor cannot replace them; delete all but one of them"
        gears = {actuator: self.gear_of(actuator, coupled) for actuator in added}
        return Transmission(
            joint=joint, actuator=first, moments=self.moments[first], coupled=coupled, added=gears, idle=tuple(idle)
        )

    def _driving(self, coupled: dict[int, Mimic]) -> tuple[list[int], list[int]]:
        """The actuators that drive coupled joints, and those that are switched off.

        One that cannot give a force, or whose group the model's options disable, counts only if there is no other.
        """
        model = self.model
        present = [actuator for actuator in self.acting_on(set(coupled)) if not is_damper(model, actuator)]
        driving = present
        for is_off in (is_powerless, is_disabled):
            driving = [actuator for actuator in driving if not is_off(model, actuator)] or driving
        return driving, [actuator for actuator in present if actuator not in driving]

    def _coupled_with(self, joint: int) -> dict[int, Mimic] | str:
        """The joints that equalities couple to one at fixed ratios; the reason if a ratio is not fixed."""
        model = self.model
        coupled = {joint: Mimic(1.0, 0.0)}
        waiting = [joint]
        used: set[int] = set()
        while waiting:
            here = waiting.pop()
            for equality in self._couplings.joint_equalities(here):
                if equality in used:
                    continue
                used.add(equality)
                first = int(model.eq_obj1id[equality])
                second = int(model.eq_obj2id[equality])
                if reason := _why_not_linear(model, equality):
                    return reason
                there = second if here == first else first
                if there in coupled:
                    label = shown(name_of(model, mujoco.mjtObj.mjOBJ_EQUALITY, equality))
                    names = shown(joint_name(model, first)), shown(joint_name(model, second))
                    return f"joint {names[0]} is tied to {names[1]} twice by the equality {label}"
                coupled[there] = _behind(model, equality, coupled[here], here == second)
                waiting.append(there)
        return coupled


def generalized_gear(moments: dict[int, float], coupled: dict[int, Mimic]) -> float:
    """Torque on the leading joint per unit of actuator force, by virtual work: each moment times the joint's speed ratio."""
    return sum(moment * coupled[joint].ratio for joint, moment in moments.items())


def moments_of(model: mujoco.MjModel, actuator: int) -> dict[int, float]:
    """Torque on each joint per unit of an actuator's force, if it is the same in all configurations.

    Empty for an actuator on a ball joint, a body, a site, a crank, or a tendon that runs over sites.
    """
    target = int(model.actuator_trnid[actuator, 0])
    gear = float(model.actuator_gear[actuator, 0])
    if is_on_joint(model, actuator):
        return {target: gear} if model.jnt_type[target] in SCALAR else {}
    if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_TENDON:
        return {}
    return {joint: gear * coefficient for joint, coefficient in tendon_coefficients(model, target).items()}


def _are_parallel(moments: dict[int, float], others: dict[int, float]) -> bool:
    """Whether one actuator can replace another: their moments on all joints have the same ratio."""
    if moments.keys() != others.keys():
        return False
    a = np.array(list(moments.values()))
    b = np.array([others[joint] for joint in moments])
    return bool(abs(a @ b) >= (1.0 - _PARALLEL) * np.linalg.norm(a) * np.linalg.norm(b))


def _why_not_one_motor(model: mujoco.MjModel, actuators: list[int]) -> str:
    """Why the forces of several actuators on the same joint do not add to that of one motor; empty if they do."""
    if len(actuators) == 1:
        return ""
    if any(model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_DCMOTOR for actuator in actuators):
        return "the torque of a dcmotor falls with the speed"
    if any(model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_MUSCLE for actuator in actuators):
        return "a muscle pulls in one direction only"
    if len(set(model.actuator_delay[actuators].tolist())) > 1:
        return "their delays differ"
    return ""


def _why_not_linear(model: mujoco.MjModel, equality: int) -> str:
    """Why an equality does not couple two joints at a fixed ratio; empty if it does."""
    label = shown(name_of(model, mujoco.mjtObj.mjOBJ_EQUALITY, equality))
    first = int(model.eq_obj1id[equality])
    second = int(model.eq_obj2id[equality])
    _, ratio, *higher_orders = model.eq_data[equality, :5].tolist()
    name = shown(joint_name(model, first))
    if second < 0 or ratio == 0:
        return f"joint {name} is locked by the equality {label}"
    if np.any(higher_orders):
        leader = shown(joint_name(model, second))
        return f"joint {name} is tied to {leader} by a curve, not a ratio, in the equality {label}"
    return ""


def _behind(model: mujoco.MjModel, equality: int, known: Mimic, known_is_second: bool) -> Mimic:
    """How the other joint of an equality follows the leader, from how the known one does.

    MuJoCo: first - first0 = offset + ratio (second - second0), where first0 and second0 are the positions in `qpos0`.
    """
    ends = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
    offset, ratio = model.eq_data[equality, :2].tolist()
    zero = model.qpos0[model.jnt_qposadr[ends]]
    offset += float(zero[0] - ratio * zero[1])
    if known_is_second:
        return Mimic(ratio * known.ratio, ratio * known.offset + offset)
    return Mimic(known.ratio / ratio, (known.offset - offset) / ratio)
