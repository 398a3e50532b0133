"""The exceptions of armctl, with one base class.

A wrong call raises one of these. The message is one sentence: what, which, value with unit, bound, what to do next.
A target that is out of reach, blocked or not settled raises nothing; the result has `ok=False` and a reason.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable, Sequence
from typing import Any

from armctl.core.note import Note

MAX_MESSAGE_CHARACTERS = 400
_MAX_LISTED_CHARACTERS = 240  # of known names; of a longer list the message gives the number
_MAX_SHOWN_PAIRS = 2
_MAX_SHOWN_CHARACTERS = 80  # of a value in a message
_OTHER_NAMES = {"pid": "computed-torque-observer", "osc": "operational-space"}  # what armctl calls the same thing


def few_names(names: Sequence[str], count: int = 4) -> str:
    """Some names for a message: the first few, and how many more there are."""
    first = [f"{name:.40}" for name in names[:count]]
    if len(names) > count:
        return f"{', '.join(first)} and {len(names) - count} more"
    return " and ".join(filter(None, [", ".join(first[:-1]), *first[-1:]]))


def pairs_in_words(pairs: Sequence[tuple[str, str]]) -> str:
    """Some pairs of names for a message: the first few, and how many more there are."""
    named = [f"{first:.40} with {second:.40}" for first, second in pairs[:_MAX_SHOWN_PAIRS]]
    more = len(pairs) - len(named)
    return ", ".join(named) + (f" and {more} more" if more > 0 else "")


def shown(value: object) -> str:
    """A value for a message: its repr in one line of at most 80 characters."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # the repr of a caller's object may raise anything
        text = f"an object of type {type(value).__name__}"
    return text if len(text) <= _MAX_SHOWN_CHARACTERS else text[: _MAX_SHOWN_CHARACTERS - 3] + "..."


class ArmctlError(Exception):
    """The base class of the exceptions that armctl raises.

    The message is one line of at most 400 characters. A longer message, such as one with a very long name from a model, loses
    its middle.
    """

    def __init__(self, message: object = "") -> None:
        """An error with a message.

        Args:
            message: One sentence.
        """
        super().__init__(_one_line(str(message)))


class InputError(ArmctlError, ValueError):
    """An argument has a wrong shape, type or value."""


class LimitError(InputError):
    """A value is outside the arm's limits."""


class UnknownNameError(ArmctlError, LookupError):
    """A name is unknown; the message suggests a similar one."""

    @classmethod
    def from_known(cls, kind: str, name: str, known: Iterable[str], lister: str = "") -> UnknownNameError:
        """The error for an unknown name.

        Args:
            kind: The kind of thing that the name should identify, such as "robot".
            name: The unknown name.
            known: The known names.
            lister: A command that lists the known names.
        """
        if not isinstance(name, str):
            return cls(f"{kind}: {shown(name)} is not a name")
        known = list(dict.fromkeys(known))
        near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.6) or [
            k for k in known if name and name.lower() in k.lower()
        ]
        other = _OTHER_NAMES.get(name.lower())
        if not known:
            hint = "there is none here"
        elif other in known:
            hint = f"the closest one is {other!r}"
        elif near:
            hint = f"did you mean {near[0]!r}?"
        elif len(listed := ", ".join(known)) <= _MAX_LISTED_CHARACTERS:
            hint = f"known: {listed}"
        else:
            hint = f"there are {len(known)} known names" + (f"; {lister} lists them" if lister else "")
        return cls(f"unknown {kind} {name!r:.80}; {hint}")


class ModelError(ArmctlError):
    """A model cannot be read, or contains no arm."""


class NotInstalledError(ArmctlError):
    """A missing optional package, or a missing part of the system such as a screen."""

    @classmethod
    def from_extra(cls, what: str, extra: str) -> NotInstalledError:
        """The error for a package that one of armctl's extras installs.

        Args:
            what: What is missing, such as "an .mp4 needs an encoder".
            extra: Name of the extra.
        """
        return cls(f"{what}; install armctl with its extra [{extra}], in a clone: .venv/bin/pip install -e '.[{extra}]'")


def import_extra(module: str, what: str, extra: str) -> Any:
    """A module that one of armctl's extras installs; NotInstalledError, as by `NotInstalledError.from_extra`, without it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise NotInstalledError.from_extra(what, extra) from None


class PlanError(ArmctlError):
    """A motion cannot be planned."""


class LinkError(ArmctlError):
    """The link to a robot failed, the robot reports a fault, or it is not in the state that a motion needs."""


class ArmctlWarning(UserWarning):
    """armctl had to assume something, such as a limit that the model does not specify.

    Attributes:
        note: What `load` notes of a model, with its severity and advice; None for any other warning.
    """

    def __init__(self, message: object = "", note: Note | None = None) -> None:
        """A warning with a message, shortened as that of an ArmctlError.

        Args:
            message: One sentence.
            note: What `load` notes of a model.
        """
        super().__init__(_one_line(str(message)))
        self.note = note


class MissingShapeWarning(ArmctlWarning):
    """Links of a robot carry mass and have no collision shape, so that no contact of the arm can be excluded."""


def _one_line(message: str) -> str:
    """The message without line breaks; if it is too long, its beginning and its end, which says what to do."""
    line = " ".join(message.split()) if "\n" in message else message
    if len(line) <= MAX_MESSAGE_CHARACTERS:
        return line
    end = MAX_MESSAGE_CHARACTERS // 3
    return f"{line[: MAX_MESSAGE_CHARACTERS - end - 5]} ... {line[-end:]}"
