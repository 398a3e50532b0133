"""Every deliberate error of armctl, under one base.

A wrong call raises one of these, with one sentence: what, which, value with unit, bound, what to do next.
What the world refuses (out of reach, not settled) is never an exception but a result with `ok=False` and a reason.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class ArmctlError(Exception):
    """The base of every error that armctl raises on purpose."""


class InputError(ArmctlError, ValueError):
    """An argument of the wrong shape, kind or value."""


class LimitError(InputError):
    """A value outside the arm's limits."""


class UnknownNameError(ArmctlError, LookupError):
    """A name that stands for nothing here; the message suggests a near one."""

    @classmethod
    def of(cls, kind: str, name: str, known: Iterable[str], lister: str = "") -> UnknownNameError:
        """The error for `name`, which is no `kind` among `known`.

        Args:
            kind: What the name should stand for, such as "robot".
            name: The name that was given.
            known: The names that would have been right.
            lister: A command that lists them.

        Returns:
            The error, to be raised by the caller.
        """
        known = list(known)
        near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.6) or [
            k for k in known if name and name.lower() in k.lower()
        ]
        if near:
            hint = f"did you mean {near[0]!r}?"
        elif len(known) <= 12:
            hint = f"known: {', '.join(known)}"
        else:
            hint = f"there are {len(known)} known names" + (f"; {lister} lists them" if lister else "")
        return cls(f"unknown {kind} {name!r}; {hint}")


class ModelError(ArmctlError):
    """A model that cannot be read, or that is no arm."""


class NotInstalledError(ArmctlError):
    """Something that armctl uses where it is there, and that this needs."""


class PlanError(ArmctlError):
    """A motion that cannot be planned."""


class ArmctlWarning(UserWarning):
    """Something armctl had to assume, such as a limit that a model does not give."""
