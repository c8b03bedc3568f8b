"""Write and read the CSV tables of a run; equal runs give byte-identical tables."""

from __future__ import annotations

import csv
import io
import operator
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.recfunctions import repack_fields

from csac.record.files import write_atomically
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

COLUMNS: dict[str, tuple[str, ...]] = {
    "evaluations": ("seed", "step", "episode", "return", "length", "success"),
    "episodes": ("seed", "step", "return", "length"),
    "metrics": ("seed", "step"),
}
INTEGER_COLUMNS = frozenset({"seed", "step", "episode", "length"})


def append_rows(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Append rows to the table at `path`, flushed to the system on return.

    The header is `columns`, then the rows' other keys; a new key causes the table to be rewritten with a new column,
    empty in earlier rows. A value is None (an empty cell), an integer, a boolean, or a float, written with the fewest
    digits that restore it in its own precision. Raises RuntimeError for a value that is not a number.
    """
    if not rows:
        return
    with open(path, "ab+") as file:
        file.seek(0)
        old = next(csv.reader([file.readline().decode()]))
        header = list(dict.fromkeys([*(old or columns), *(column for row in rows for column in row)]))
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        if header != old:
            writer.writerow(header)
            text.writelines(line + "," * (len(header) - len(old)) + "\n" for line in file.read().decode().split())
        writer.writerows([_cell(path, column, row.get(column)) for column in header] for row in rows)
        if not old or header == old:
            file.write(text.getvalue().encode())
            return
    write_atomically(path, text.getvalue().encode())


def continues(table: bytes, before: bytes) -> bool:
    """Return whether a table begins with the rows of `before`; columns may have been added since."""
    if table.startswith(before):
        return True
    header, *rows = before.splitlines()
    wider, *others = table.splitlines()[: len(rows) + 1] or [b""]
    more = b"," * (wider.count(b",") - header.count(b","))
    return wider.startswith(header + b",") and others == [row + more for row in rows]


def check_new(path: Path) -> None:
    """Raise InputError if no new table can be created at `path`, before anything has been computed for it."""
    if path.exists():
        raise InputError(f"{path} exists: give another name, or remove it first")
    if not (path.parent.is_dir() and os.access(path.parent, os.W_OK)):
        raise InputError(f"cannot write into {path.parent}: choose a folder that exists and is yours to write")


def read_rows(path: str | Path) -> np.ndarray:
    """Read a table of a run as a structured array [row].

    `seed`, `step`, `episode` and `length` are int64, every other column is float64 with NaN for an empty cell. A last
    line without its newline was cut off by a crash and is left out. Raises InputError if the file is missing or is not
    such a table.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        header, *body = list(csv.reader(io.StringIO(text[: text.rfind("\n") + 1]))) or [[]]
        needed = COLUMNS.get(path.stem, ("seed", "step"))
        if not header and not body:
            return structured(needed, [])
        is_plain = all(name.isprintable() for name in header)  # no control characters
        if len(set(header)) < len(header) or not {*needed} <= {*header} or not is_plain:
            raise ValueError(f"its header is {','.join(header)[:100]!r}")
        for number, cells in enumerate(body, start=2):
            if len(cells) != len(header):
                raise ValueError(f"line {number} has {len(cells)} cells, not {len(header)}")
        return structured(header, body)
    except (OSError, csv.Error, ValueError, OverflowError) as error:
        raise InputError(f"{path} is no table of a run ({error!s:.150}): restore it") from None


def joined(name: str, tables: Iterable[np.ndarray]) -> np.ndarray:
    """Return the rows of several tables of this name, with the columns that all non-empty ones have."""
    tables = [table for table in tables if len(table)]
    if not tables:
        return structured(COLUMNS[name], [])
    common = [item for item in tables[0].dtype.names or () if all(item in (t.dtype.names or ()) for t in tables)]
    return np.concatenate([repack_fields(table[common]) for table in tables])


def structured(header: Sequence[str], body: Sequence[Sequence[str]]) -> np.ndarray:
    """Return cells of text as a structured array [row].

    Raises ValueError or OverflowError if a cell is not the number that its column needs, or a column name is invalid.
    """
    rows = np.empty(len(body), [(name, np.int64 if name in INTEGER_COLUMNS else np.float64) for name in header])
    for index, name in enumerate(header):
        convert = int if name in INTEGER_COLUMNS else float
        rows[name] = [convert(cells[index] or "nan") for cells in body]
    return rows


def _cell(path: Path, column: str, value: Any) -> str:
    if column in INTEGER_COLUMNS:
        return str(operator.index(value))
    if value is None:
        return ""
    number = np.asarray(value)
    if number.shape or number.dtype.kind not in "buif":
        raise RuntimeError(f"{path.name}, column {column!r}: {value!r} is not a number")
    return str(int(number)) if number.dtype.kind in "bui" else str(number[()])
