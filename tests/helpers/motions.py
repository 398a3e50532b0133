"""Motions that tests of control share: standing still, and a gentle sway."""

import numpy as np

from armctl.core.trajectory import Setpoint


class Still:
    """Stands where it is."""

    def __init__(self, q, duration=0.2):
        self.q, self.duration = q, duration

    def __call__(self, t):
        return Setpoint(self.q, 0 * self.q, 0 * self.q)

    def sample(self, times):
        q = np.tile(self.q, (len(times), 1))
        return Setpoint(q, 0 * q, 0 * q)


class Sway:
    """A smooth motion of all joints around home, gentle enough for every arm."""

    duration = 0.4

    def __init__(self, arm):
        lo, hi = arm.limits.q_min, arm.limits.q_max
        self.centre = np.clip(arm.home, lo + 0.06, hi - 0.06)
        self.size = np.full(arm.n, 0.05)

    def sample(self, times):
        w, t = 2 * np.pi / self.duration, np.asarray(times)[:, None]
        inside = (t >= 0) & (t <= self.duration)
        q = self.centre + self.size * np.where(inside, 0.5 * (1 - np.cos(w * t)), 0.0)
        v = self.size * np.where(inside, 0.5 * w * np.sin(w * t), 0.0)
        return Setpoint(q, v, self.size * np.where(inside, 0.5 * w**2 * np.cos(w * t), 0.0))

    def __call__(self, t):
        return Setpoint(*(x[0] for x in self.sample([t])[:3]))
