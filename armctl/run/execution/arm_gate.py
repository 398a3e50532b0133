"""The gate of a simulation or a robot, which looks where everything is."""

from __future__ import annotations

from collections.abc import Callable

from armctl.model.arm.arm import Arm
from armctl.plan.stream.gate import Gate, GateScene


class ArmGate(Gate):
    """A Gate that looks at the scene of an arm's commands: loose bodies where they are, what is held, what is seen."""

    def __init__(self, arm: Arm, look: Callable[[], GateScene], *, speed: float, clearance: float):
        """A gate in front of an arm; `look()` is its scene now."""
        self._look_now = look
        super().__init__(arm, speed=speed, clearance=clearance)

    def _look(self) -> GateScene:
        scene = self._look_now()
        return scene._replace(arm=scene.arm.with_limits(self.arm.limits))
