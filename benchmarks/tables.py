"""Writing measurements to files: rows in CSV, and tables in Markdown between the markers of a page.

A row maps column names to numbers or text; all rows of a table have the same columns.
"""

from __future__ import annotations

import csv
import statistics
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

Row: TypeAlias = dict[str, Any]


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write rows in the given order, with six significant digits."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})


def read_rows(path: Path) -> list[Row]:
    """Return the rows that `write_rows` wrote."""
    with path.open(newline="") as file:
        return [{key: _value(text) for key, text in line.items()} for line in csv.DictReader(file)]


def _value(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def formatted(rows: Sequence[Row], columns: Mapping[str, str]) -> str:
    """Return a Markdown table; `columns` maps each heading to a format string over the columns of a row."""
    return table(list(columns), [[form.format_map(row) for form in columns.values()] for row in rows])


def grouped(rows: Sequence[Row], *columns: str) -> dict[tuple, list[Row]]:
    """Group the rows by their values in these columns, in the order of first occurrence."""
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[column] for column in columns), []).append(row)
    return groups


def with_range(values: Sequence[float], form: str, unit: str = "") -> str:
    """Return the median and, if there are several values, their range in brackets."""
    median = f"{statistics.median(values):{form}}{unit}"
    return f"{median} ({min(values):{form}} to {max(values):{form}})" if len(values) > 1 else median


def between_markers(page: str, name: str, text: str) -> str:
    """Return the page with the text between its lines `<!-- name: begin -->` and `<!-- name: end -->` replaced.

    Raises:
        ValueError: the page lacks these lines.
    """
    begin, end = (f"<!-- {name}: {edge} -->" for edge in ("begin", "end"))
    before, found, rest = page.partition(f"{begin}\n")
    _, ended, after = rest.partition(end)
    if not (found and ended):
        raise ValueError(f"the page lacks the lines {begin} and {end}")
    return f"{before}{begin}\n{text}{end}{after}"
