"""Self-contained HTML pages of results: one style, and elements from text, tables and figures."""

import html

from armctl.core.tables import Table

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 84rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; font-size: 13px; }
td, th { padding: .25rem .6rem; text-align: right; border-bottom: 1px solid #ddd; }
td:first-child, th:first-child, td:last-child { text-align: left; }
mark { background: #d9f2e3; color: #0b5a32; font-weight: 600; } figcaption { font-size: 13px; }
.columns { display: grid; grid-template-columns: minmax(0, 1fr) auto; gap: 1.5rem; align-items: start; }
@media (max-width: 60rem) { .columns { grid-template-columns: 1fr; } }
pre { background: #f4f5f7; padding: .6rem .8rem; overflow-x: auto; font-size: 13px; }
figure { margin: 0; } video { max-width: 100%; }
.remark { color: #a33; } svg { width: 100%; height: auto; } .table { overflow-x: auto; max-width: 100%; }
"""


def page(title: str, *elements: str) -> str:
    escaped = html.escape(title)
    head = f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{escaped}</title>\n<style>{_STYLE}</style>'
    return "\n".join([head, f"<h1>{escaped}</h1>", *elements, "</html>\n"])


def heading(text: str) -> str:
    return f"<h2>{html.escape(text)}</h2>"


def paragraph(text: str) -> str:
    return f"<p>{html.escape(text)}</p>"


def program(text: str) -> str:
    """Lines of a program, or what it prints."""
    return f"<pre>{html.escape(text)}</pre>"


def remark(text: str) -> str:
    """A paragraph in the color of a warning."""
    return f'<p class="remark">{html.escape(text)}</p>'


def table(rows: Table | str) -> str:
    """A table that scrolls if it is wider than the page, from its rows or as HTML."""
    return f'<div class="table">\n{rows.html() if isinstance(rows, Table) else rows}\n</div>'
