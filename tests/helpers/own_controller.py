"""A controller of a user's own, which workers import by its name."""

import armctl


class Weak:
    """PD with a fraction of its torque; a fraction of 13 fails, as a user's code may."""

    name = "weak"

    def __init__(self, arm: armctl.Arm, share: float = 1.0):
        self._pd = armctl.PDGravity(arm)
        self._share = share

    def torque(self, state, setpoint):
        if self._share == 13.0:
            raise RuntimeError("thirteen")
        return self._share * self._pd.torque(state, setpoint)
