"""JointStates: the last state of an arm's joints, from messages with any joints in any order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armctl.core.errors import few_names
from armctl.core.validation import Array, IntArray

_RESTART_S = 1.0  # by which a stamp is earlier where the robot's clock was set back, and not only late
_MAX_SPEED_RATIO = 4.0  # of the greatest speed, at which a position has not moved but belongs to another source
_JUMP_RAD = 0.05
_MIN_INTERVAL_S = 0.02  # stamps may be rounded
_SAME_RAD = 1e-6  # by which one joint may differ where a message has it twice


class JointStates:
    """Joints by name. What a message lacks, and whatever is older than what is known, changes nothing.

    Attributes:
        t: (n,) s, the stamp of each joint's state; -inf before the first.
        q, v, tau: (n,) rad, rad/s and N m; NaN where no message has it.
        count: How many messages had a newer state of a joint.
        restarts: How often the clock of the stamps was set back.
        problem: What was wrong with the last message that was refused; empty if nothing was.
        jump: The joint that moved faster than it can; empty if none did.
    """

    def __init__(self, names: Sequence[str], v_max: Array):
        """No state yet of joints with these names and greatest speeds, (n,) rad/s."""
        n = len(names)
        self.names = tuple(names)
        self.t = np.full(n, -np.inf)
        self.q = np.full(n, np.nan)
        self.v = np.full(n, np.nan)
        self.tau = np.full(n, np.nan)
        self.count = 0
        self.restarts = 0
        self.problem = ""
        self.jump = ""
        self._v_max = v_max
        self._seen: dict[str, None] = {}  # names in the messages, in their order

    @property
    def missing(self) -> list[str]:
        """The joints without a state."""
        return [name for name, q in zip(self.names, self.q, strict=True) if np.isnan(q)]

    @property
    def seen(self) -> list[str]:
        """All joints that the messages had."""
        return list(self._seen)

    def take(self, t: float, names: Sequence[str], q: Sequence[float], v: Sequence[float], tau: Sequence[float]) -> None:
        """Takes a message with its stamp, s; velocities and efforts may be empty."""
        self._seen.update(dict.fromkeys(names))
        self.problem = _problem(names, q)
        if self.problem:
            return
        columns = {name: column for column, name in enumerate(names)}
        joints = np.array([k for k, name in enumerate(self.names) if name in columns], dtype=np.intp)
        order = [columns[self.names[k]] for k in joints]
        positions = np.array([q[column] for column in order], dtype=float)
        finite = np.isfinite(positions)
        if (finite & (t < self.t[joints] - _RESTART_S)).any():
            self.restarts += 1
            self.t[:] = -np.inf
        new = finite & (t > self.t[joints])
        if not new.any():
            return
        changed = joints[new]
        self.count += 1
        self._find_jump(t, changed, positions[new])
        self.t[changed] = t
        self.q[changed] = positions[new]
        for row, values in ((self.v, v), (self.tau, tau)):
            if len(values) == len(names):
                row[changed] = np.array([values[column] for column in order], dtype=float)[new]

    def _find_jump(self, t: float, joints: IntArray, q: Array) -> None:
        """Notes a joint that moved faster than it can: another node publishes it, too."""
        interval = np.maximum(t - self.t[joints], _MIN_INTERVAL_S)
        bound = _JUMP_RAD + _MAX_SPEED_RATIO * self._v_max[joints] * interval
        way = np.nan_to_num(np.abs(q - self.q[joints]))
        k = int((way - bound).argmax())
        if way[k] > bound[k]:
            joint = joints[k]
            self.jump = (
                f"{self.names[joint]:.60} jumps from {self.q[joint]:.3f} to {q[k]:.3f} rad; do two nodes publish its state?"
            )

    @property
    def explanation(self) -> str:
        """Why there is no state of all joints."""
        if not self._seen:
            return "no message came"
        if self.missing:
            return (
                f"it has no {few_names(self.missing)}, but {few_names(self.seen, 8)}; give joints=[...], its names in the "
                "order of the model's joints"
            )
        return self.problem


def _problem(names: Sequence[str], q: Sequence[float]) -> str:
    """Why a message is not taken; empty if it is."""
    if len(q) != len(names):
        return f"a message has {len(names)} names and {len(q)} positions"
    if len(set(names)) < len(names):
        for name, position in zip(names, q, strict=True):
            if not abs(position - q[names.index(name)]) <= _SAME_RAD:
                return f"a message has {name:.60} twice, with different positions"
    return ""
