"""ToolAnswer: what a tool answers; and poses and numbers as JSON has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from armctl.core.pose import Pose
from armctl.core.validation import Array

_DIGITS = 5  # of positions, m, rad: more would be noise to a reader


@dataclass(frozen=True)
class ToolAnswer:
    """What a tool answers.

    Attributes:
        ok: Whether what was asked for is done.
        text: One sentence, or of tools that only look JSON.
        values: The same for programs; empty if there is only a sentence.
        picture: A PNG; empty if there is none.
    """

    ok: bool
    text: str
    values: Mapping[str, Any] = field(default_factory=dict)
    picture: bytes = b""


def rounded(values: Array) -> list[float]:
    """Numbers for JSON."""
    return [float(each) for each in np.round(np.asarray(values, np.float64), _DIGITS) + 0.0]


def pose_values(pose: Pose) -> dict[str, list[float]]:
    """A pose for JSON: position, m, and quaternion wxyz."""
    return {"position": rounded(pose.position), "quat": rounded(pose.quat)}


def point_text(position: Array) -> str:
    """A point in a sentence."""
    return f"({', '.join(f'{x:.3f}' for x in position)}) m"
