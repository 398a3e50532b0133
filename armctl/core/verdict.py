"""Verdict: the base of results that say whether they are ok."""

from __future__ import annotations


class Verdict:
    """A result that is true if it is ok."""

    __slots__ = ()
    ok: bool

    def __bool__(self) -> bool:
        return self.ok
