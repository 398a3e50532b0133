"""Note: a sentence on a robot's model, and what to write into its file instead."""

from __future__ import annotations

from enum import StrEnum


class Severity(StrEnum):
    """How much is doubtful."""

    ERROR = "error"
    """The arm cannot be used as it is."""
    WARNING = "warning"
    """Results can be wrong."""
    NOTE = "note"
    """An assumption."""


class Note(str):
    """A sentence on what was assumed, changed or left out when a model was loaded.

    Attributes:
        advice: What to write into the file or to pass instead; empty if there is no advice.
        severity: How much is doubtful.
    """

    advice: str
    severity: Severity

    def __new__(cls, text: str, advice: str = "", severity: Severity = Severity.WARNING) -> Note:
        """A note.

        Args:
            text: The sentence.
            advice: What to write into the file or to pass instead.
            severity: How much is doubtful.
        """
        note = super().__new__(cls, text)
        note.advice = advice
        note.severity = severity
        return note
