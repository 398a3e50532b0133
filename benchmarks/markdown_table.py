"""Tables in Markdown, which the benchmarks print and write."""

from collections.abc import Iterable, Sequence

from tabulate import tabulate


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in GitHub's Markdown; a `|` in a cell is escaped."""
    cells = [[" ".join(str(cell).split()).replace("|", r"\|") for cell in row] for row in rows]
    return tabulate(cells, columns, tablefmt="github", disable_numparse=True)


def titled_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table below its title in bold."""
    return f"**{title}**\n\n{markdown_table(columns, rows)}"
