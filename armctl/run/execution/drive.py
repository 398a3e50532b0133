"""Drive: what moves an arm along references: a simulated plant, or the link to a robot."""

from typing import Protocol

import mujoco
import numpy as np

from armctl.control.interface import Controller, State
from armctl.core.log import LogSource, LogTorques
from armctl.core.pose import Pose
from armctl.core.trajectory import TickReference, Trajectory
from armctl.core.validation import Array
from armctl.model.arm.actuation import Actuation
from armctl.model.arm.arm import Arm
from armctl.plan.motion.trajectory.piecewise import Pieces
from armctl.run.execution.recorder import Recorder


class Drive(Protocol):
    """What the commands of an arm need of a plant or a robot; `Stepper` is the one of a simulation."""

    source: LogSource  # of its logs
    torques: LogTorques  # of its logs
    late: int  # ticks by which references for a robot came too late until now; it came to rest instead

    @property
    def actuation(self) -> Actuation:
        """The driven joints of the arm."""
        ...

    @property
    def model(self) -> mujoco.MjModel: ...

    @property
    def data(self) -> mujoco.MjData:
        """The scene now; for a robot, a mirror of what it measures."""
        ...

    @property
    def dt(self) -> float:
        """The tick, s."""
        ...

    @property
    def failure(self) -> str:
        """Why the last run ended early, in words; empty if it did not."""
        ...

    @failure.setter
    def failure(self, failure: str, /) -> None: ...

    @property
    def q_ref(self) -> Array:
        """(n,) rad, the last reference, where the next motion starts."""
        ...

    @property
    def continuous(self) -> bool:
        """Whether the arm moves almost continuously between ticks."""
        ...

    @property
    def description(self) -> str:
        """The plant or the robot in words, for the log."""
        ...

    @property
    def blocked(self) -> str:
        """Why no motion may start, and what to do; empty if one may."""
        ...

    @property
    def state(self) -> State:
        """The state of the arm now."""
        ...

    def tip_pose(self, arm: Arm, tip: str | None = None) -> Pose:
        """The pose of one of an arm's tips now, T_world_tip; of the first one if left out."""
        ...

    def is_still(self) -> bool:
        """Whether the arm is at rest."""
        ...

    def recorder(self) -> Recorder:
        """A recorder for a run."""
        ...

    def reference(self, trajectory: Trajectory, ticks: int) -> TickReference:
        """The first `ticks` ticks of a trajectory."""
        ...

    def run(self, controller: Controller, reference: TickReference, recorder: Recorder, to_rest: Pieces | None = None) -> None:
        """Runs along a reference; `failure` says why if the run ends early.

        A robot uses its own controller, and follows `to_rest`, the motion from the first row on up to rest, where nothing else
        comes in time; a simulation waits.
        """
        ...

    def instability(self, arm: Arm, controller: Controller, q: Array) -> str:
        """What a reason adds if the loop of an arm is unstable at q (n,); empty if it is stable, or the drive has its own."""
        ...

    def come_to_rest(self, *, stop: bool) -> None:
        """Called where a run ends: waits until a robot rests; with `stop` it brakes on its path before its end."""
        ...


def hold_reference(drive: Drive, seconds: float) -> TickReference:
    """A reference that stays where the last one ended, for at least one tick."""
    still = np.zeros((max(1, round(seconds / drive.dt)), drive.actuation.n))
    return TickReference(drive.q_ref + still, still, still, still, still)
