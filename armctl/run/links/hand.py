"""Hand: the gripper of a robot, with the calls and results of that of a simulation."""

from __future__ import annotations

import time

from armctl.core.defaults import DEFAULT_GRIP_FORCE
from armctl.core.result import GripResult
from armctl.core.validation import number
from armctl.run.links.link import HandLink

_WIDTH_TOLERANCE = 2e-3  # m
# A hand may report a grasp where it closed on nothing: fingers that are nearer to each other hold nothing that counts.
_THINNEST_OBJECT_M = 3e-3


class Hand:
    """The gripper of a robot. Made by `Robot.gripper`; the arm does not move meanwhile.

    The hand does not know what it holds, so a body in it is no part of the proofs of the motions that follow.
    """

    def __init__(self, link: HandLink):
        """The hand behind a link.

        Args:
            link: The link of the robot, which is open.
        """
        self._link = link

    @property
    def width(self) -> float:
        """The distance between the fingers now, m."""
        return self._link.read_hand().width

    @property
    def width_max(self) -> float:
        """The distance between the fingers when open, m."""
        return self._link.read_hand().width_max

    def open(self) -> GripResult:
        """Opens the hand completely.

        Returns:
            How it ended.
        """
        return self.move(self.width_max)

    def move(self, width: float) -> GripResult:
        """Moves the fingers to a distance.

        Args:
            width: m.

        Returns:
            How it ended: not ok if the fingers are more than 2 mm from it.

        Raises:
            InputError: A width outside the hand's range.
            LinkError: The link failed.
        """
        width = number("width", width, 0.0, self.width_max + 1e-6)
        begin = time.monotonic()
        self._link.move_hand(width)
        reached = self.width
        wrong = abs(reached - width) > _WIDTH_TOLERANCE
        reason = f"the fingers stopped {1e3 * reached:.3g} mm apart, {1e3 * width:.3g} mm were asked for" if wrong else ""
        return _result(False, reached, begin, reason)

    def close(self) -> GripResult:
        """Grasps with 10 N.

        Returns:
            The result: ok if something is held.

        Raises:
            LinkError: The link failed.
        """
        return self.grasp(DEFAULT_GRIP_FORCE)

    def grasp(self, force: float) -> GripResult:
        """Closes until the fingers touch something, then holds it with a force until the next command.

        Args:
            force: N.

        Returns:
            The result. A grasp counts where the hand reports it and the fingers are at least 3 mm apart.

        Raises:
            InputError: The force is negative or not finite.
            LinkError: The link failed.
        """
        force = number("force", force, 0.0)
        begin = time.monotonic()
        self._link.close_hand(force)
        width, _, grasps = self._link.read_hand()
        holds = grasps and width >= _THINNEST_OBJECT_M
        reason = ""
        if not holds:
            claim = "; the hand reports a grasp" if grasps else ""
            reason = f"closed on nothing: the fingers are {1e3 * width:.2g} mm apart{claim}"
        return _result(holds, width, begin, reason)


def _result(grasped: bool, width: float, begin: float, reason: str) -> GripResult:
    return GripResult(
        ok=not reason,
        grasped=grasped,
        held="",
        width=width,
        force=float("nan"),
        duration=time.monotonic() - begin,
        reason=reason,
    )
