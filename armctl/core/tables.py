"""Tables of text in Markdown and HTML, for reports, pages and benchmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """A header and rows of text, all of one length.

    Attributes:
        header: The names of the columns.
        rows: The cells, row by row.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """The table in GitHub's Markdown; a `|` in a cell is escaped."""
        return self._formatted("github", [[_one_line(cell).replace("|", r"\|") for cell in row] for row in self._lines()])

    def html(self) -> str:
        """The table as an HTML element; special characters are escaped."""
        return self._formatted("html", [[_one_line(cell) for cell in row] for row in self._lines()])

    def _lines(self) -> list[Sequence[str]]:
        return [self.header, *self.rows]

    @staticmethod
    def _formatted(kind: str, lines: list[list[str]]) -> str:
        from tabulate import tabulate

        # Cells are text already: tabulate would round and align what looks like a number.
        return tabulate(lines[1:], lines[0], tablefmt=kind, disable_numparse=True)


def _one_line(cell: str) -> str:
    return " ".join(str(cell).split())
