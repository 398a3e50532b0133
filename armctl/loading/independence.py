"""Which chains of a model can move at once."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import mujoco

from armctl.core.errors import ModelError
from armctl.loading.tip import find_tip
from armctl.mjmodel.queries import Chain, body_name, is_below, joint_name
from armctl.mjmodel.transmissions import chain_transmissions


def check_apart(model: mujoco.MjModel, chains: Sequence[Chain]) -> None:
    """Makes sure that chains can move at once without shaking each other.

    Args:
        model: The compiled model.
        chains: The chains.

    Raises:
        ModelError: One is part of another, two share a joint, or one stands on another.
    """
    for one, other in permutations(chains, 2):
        tips = [repr(find_tip(model, joints)[0]) for joints in (one, other)]
        shared, moved = sorted(set(one) & set(other)), _moved(model, one)
        if tied := moved & _moved(model, other) - set(shared):
            raise ModelError(
                f"the chains to {tips[0]} and {tips[1]} both move joint {joint_name(model, min(tied))!r}; give one of them"
            )
        if len(shared) == min(len(one), len(other)):
            raise ModelError(f"one of the chains to {tips[0]} and {tips[1]} is part of the other; give each chain once")
        if shared:
            names = ", ".join(repr(joint_name(model, joint)) for joint in shared)
            base = body_name(model, int(model.jnt_bodyid[shared[-1]]))
            raise ModelError(
                f"the chains to {tips[0]} and {tips[1]} share joint{'s' * (len(shared) > 1)} {names}, which only one of them "
                f"could move; base={base!r} holds what they share"
            )
        if any(is_below(model, int(model.jnt_bodyid[other[0]]), int(model.jnt_bodyid[joint])) for joint in moved):
            raise ModelError(f"the chain to {tips[1]} stands on the one to {tips[0]}, which would shake it; move one at a time")


def _moved(model: mujoco.MjModel, joints: Chain) -> set[int]:
    """The joints of a chain and those that are tied to them."""
    return {joint for drive in chain_transmissions(model, joints) for joint in drive.ties}
