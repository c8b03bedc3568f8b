"""Text tables, rendered as Markdown or HTML; `console` shows them in a terminal."""

from __future__ import annotations

import html as html_text
import math
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable


class Cell(NamedTuple):
    """The text of a cell and, if it is numeric, its value, used to sort the column and to align it right."""

    text: str
    value: float | None = None


EMPTY = Cell("", math.nan)


class Row(NamedTuple):
    """The cells of a row. A summary row is over the rows above it, without the failed ones."""

    cells: tuple[Cell, ...]
    kind: Literal["plain", "failed", "summary"] = "plain"


class Table(NamedTuple):
    """Headings, rows with as many cells, a title above and a note below."""

    headings: tuple[str, ...]
    rows: tuple[Row, ...]
    title: str = ""
    note: str = ""

    def is_numeric(self, column: int) -> bool:
        """Return whether every cell of a column has a value."""
        return all(row.cells[column].value is not None for row in self.rows)


SMALL = 0.1  # returns below this get three significant digits instead of two decimals


def number(value: float, largest: float | None = None) -> str:
    """Format a return, a small one with three significant digits; `largest` sets the format of a whole column."""
    size = abs(value if largest is None else largest)
    return f"{value:.3g}" if 0 < size < SMALL else f"{value:,.{1 if size >= 100 else 2}f}"


def short(steps: float) -> str:
    """Format a number of steps briefly: 500, 12.5k, 1M."""
    for size, suffix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(steps) >= size:
            return f"{steps / size:.4g}{suffix}"
    return f"{steps:.4g}"


def numeric(value: float, text: str) -> Cell:
    """Return a cell with a number, or an empty one for NaN."""
    return EMPTY if math.isnan(value) else Cell(text, value)


def markdown(table: Table) -> str:
    """Return the table in Markdown, with numeric columns aligned right."""
    columns = range(len(table.headings))
    lines = [f"**{_escaped(table.title)}**", ""] if table.title else []
    lines.append(_line(table.headings))
    lines.append(_line("---:" if table.is_numeric(column) else "---" for column in columns))
    lines += [_line(cell.text for cell in row.cells) for row in table.rows]
    lines += ["", _escaped(table.note)] if table.note else []
    return "\n".join(lines)


def html(table: Table) -> str:
    """Return the table in HTML: rows have the class `plain`, `failed` or `summary`, values are in `data-value`."""
    headings = "".join(
        f'<th scope="col"{_class(table, column)}>{html_text.escape(heading)}</th>'
        for column, heading in enumerate(table.headings)
    )
    body = "\n".join(_html_row(table, row) for row in table.rows)
    caption = f"<caption>{html_text.escape(table.title)}</caption>\n" if table.title else ""
    span = f'<td colspan="{len(table.headings)}">{html_text.escape(table.note)}</td>'
    foot = f"<tfoot><tr>{span}</tr></tfoot>\n" if table.note else ""
    return f"<table>\n{caption}<thead><tr>{headings}</tr></thead>\n<tbody>\n{body}\n</tbody>\n{foot}</table>"


def _line(texts: Iterable[str]) -> str:
    return f"| {' | '.join(map(_escaped, texts))} |"


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _html_row(table: Table, row: Row) -> str:
    cells = "".join(
        f"<td{_class(table, column)}{_value(cell)}>{html_text.escape(cell.text)}</td>"
        for column, cell in enumerate(row.cells)
    )
    return f'<tr class="{row.kind}">{cells}</tr>'


def _class(table: Table, column: int) -> str:
    return ' class="number"' if table.is_numeric(column) else ""


def _value(cell: Cell) -> str:
    return "" if cell.value is None or math.isnan(cell.value) else f' data-value="{cell.value:.10g}"'
