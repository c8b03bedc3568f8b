"""Text tables, rendered as Markdown; `console` shows them in a terminal, and reports in HTML."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable


class Cell(NamedTuple):
    """The text of a cell and, if it is numeric, its value; a column of numbers is aligned right."""

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

    def without_empty_columns(self) -> Table:
        """Return the table without the columns in which every cell is empty."""
        kept = [i for i in range(len(self.headings)) if any(row.cells[i].text for row in self.rows)]
        rows = tuple(row._replace(cells=tuple(row.cells[i] for i in kept)) for row in self.rows)
        return self._replace(headings=tuple(self.headings[i] for i in kept), rows=rows)


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


def _line(texts: Iterable[str]) -> str:
    return f"| {' | '.join(map(_escaped, texts))} |"


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
