"""A place where a motion is not known to be free."""

from __future__ import annotations

from typing import NamedTuple


class Hit(NamedTuple):
    """A pair that is not known to be free.

    Attributes:
        pair: Its row in the checker's geometry.
        time: s, when.
    """

    pair: int
    time: float
