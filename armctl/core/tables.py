"""Tables of text for terminals, in Markdown and in HTML, for reports, pages and benchmarks."""

import html
import re
import shutil
import sys
import textwrap
from collections.abc import Collection, Sequence
from dataclasses import dataclass

PIPE_COLUMNS = 80  # where the output is no terminal
_LONGEST_LABEL = 30  # characters; a longer beginning of a line is no label
_MAX_CELL = 36  # columns; longer cells are wrapped


@dataclass(frozen=True)
class Table:
    """A header and rows of text, all of one length."""

    header: Sequence[str]  # the names of the columns
    rows: Sequence[Sequence[str]]  # the cells, row by row

    def markdown(self) -> str:
        """The table in GitHub's Markdown; a `|` in a cell is escaped."""
        return self._formatted("github", [[_one_line(cell).replace("|", r"\|") for cell in row] for row in self._lines()])

    def text(self, width: int | None = None, keys: int = 1) -> str:
        """The table for a terminal, by default this one. A wider table continues below, with its first `keys` columns again."""
        width = terminal_columns() if width is None else width
        lines = [[_one_line(cell) for cell in row] for row in self._lines()]
        columns = [[_wrapped(row[i], k == 0, lines, i) for k, row in enumerate(lines)] for i in range(len(self.header))]
        widths = [max(len(line) for cell in column for line in cell) for column in columns]
        blocks = [list(range(keys))]
        for i in range(keys, len(columns)):
            if sum(widths[j] + 2 for j in blocks[-1]) + widths[i] > width and len(blocks[-1]) > keys:
                blocks.append(list(range(keys)))
            blocks[-1].append(i)
        return "\n\n".join(_block(columns, widths, block) for block in blocks)

    def html(self, marked: Collection[tuple[int, int]] = ()) -> str:
        """The table as an HTML element; special characters are escaped, cells (row, column from 0) in `marked` highlighted."""
        lines = [[html.escape(_one_line(cell)) for cell in row] for row in self._lines()]
        for row, column in marked:
            lines[row + 1][column] = f"<mark>{lines[row + 1][column]}</mark>"
        return self._formatted("unsafehtml", lines)

    def _lines(self) -> list[Sequence[str]]:
        return [self.header, *self.rows]

    @staticmethod
    def _formatted(kind: str, lines: list[list[str]]) -> str:
        from tabulate import tabulate

        # Cells are text already: tabulate would round and align what looks like a number.
        return tabulate(lines[1:], lines[0], tablefmt=kind, disable_numparse=True)


def terminal_columns() -> int:
    """The width of the terminal that the output goes to; 80 where it goes elsewhere."""
    return shutil.get_terminal_size((PIPE_COLUMNS, 1)).columns if sys.stdout.isatty() else PIPE_COLUMNS


def _one_line(cell: str) -> str:
    return " ".join(str(cell).split())


def folded(text: str, width: int = PIPE_COLUMNS) -> str:
    """Text whose longer lines continue below, in line with the value after a label and two spaces."""
    return "\n".join(_folded(line, width) for line in text.split("\n"))


def _folded(line: str, width: int) -> str:
    if len(line) <= width:
        return line
    label = re.match(r"\s*\S.*?(:\s|\s\s+)", line)
    indent = len(label[0]) if label and len(label[0]) <= _LONGEST_LABEL else 2
    return textwrap.fill(line, width, subsequent_indent=indent * " ", break_long_words=False, break_on_hyphens=False)


def _wrapped(cell: str, is_header: bool, lines: list[list[str]], column: int) -> list[str]:
    """A cell in lines; a header is as narrow as the cells and words of its column allow."""
    limit = _MAX_CELL
    if is_header:
        cells = (min(len(row[column]), _MAX_CELL) for row in lines[1:])
        limit = max([1, *cells, *map(len, cell.split())])
    return textwrap.wrap(cell, limit, break_long_words=False, break_on_hyphens=False) or [""]


def _block(columns: list[list[list[str]]], widths: list[int], shown: list[int]) -> str:
    """Some columns of a table, with a line below the header."""
    text = []
    for row in range(len(columns[0])):
        cells = [columns[i][row] for i in shown]
        for k in range(max(map(len, cells))):
            parts = [(cell[k] if k < len(cell) else "").ljust(widths[i]) for cell, i in zip(cells, shown, strict=True)]
            text.append("  ".join(parts).rstrip())
        if row == 0:
            text.append("  ".join("-" * widths[i] for i in shown))
    return "\n".join(text)
