"""Cells whose evaluations and manifest were collected, `seed-<k>.json` and its tables: read without JAX."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from csac.record import manifest as manifests
from csac.record.tables import read_rows
from csac.types import InputError

if TYPE_CHECKING:
    import numpy as np

    from csac.record.manifest import Manifest

ROLLOUTS = "rollouts.csv"  # fresh episodes of a finished policy, in a run


class Record(NamedTuple):
    """What one cell has given: its manifest, the seconds that it took as far as they are known, and its tables."""

    manifest: Manifest
    seconds: float
    evaluations: np.ndarray
    rollouts: np.ndarray | None
    interrupted: bool | None = None
    """Whether it was ever stopped and resumed, None where that was not written down."""
    longer: int = 0
    """Steps of the longer run that it is the beginning of, 0 where it is a run of its own."""

    @property
    def failure(self) -> str:
        """Why it failed, or nothing."""
        return self.manifest.failure if self.manifest.state == "failed" else ""


def find_collected(directory: str | Path) -> list[Path]:
    """Return the manifests of the cells that were collected in this directory and below it.

    A file of that name without tables beside it is something else: a study keeps the times of its own cells so.
    """
    return sorted(path for path in Path(directory).rglob("seed-*.json") if path.with_suffix(".csv").exists())


def read_collected(path: Path) -> Record:
    """Return what a cell has given whose manifest was collected at this path.

    Raises:
        InputError: it is no cell's, or its tables are missing or damaged.
    """
    try:
        content = path.read_bytes()
        manifest, fields = manifests.read(content), json.loads(content)
    except (InputError, OSError) as error:
        raise InputError(f"{path} is not a cell's: {error}") from None
    tables = _read_evaluations(path, manifest), read_rollouts(rollouts_of(path))
    return Record(manifest, fields.get("seconds", 0.0), *tables, fields.get("interrupted"))


def _read_evaluations(path: Path, manifest: Manifest) -> np.ndarray:
    """Return the returns of a cell. Raises InputError where they are missing, or end before a finished run did."""
    table = path.with_suffix(".csv")
    if not table.exists():
        raise InputError(f"{table} is missing: restore it, or remove {path.name} too, and the cell is run again")
    rows = read_rows(table)
    is_cut = manifest.state == "finished" and not (rows["step"] >= manifest.steps_done).any()
    if is_cut or "return" not in (rows.dtype.names or ()):
        what = f"no evaluation of step {manifest.steps_done:,}" if is_cut else "no returns"
        raise InputError(
            f"{table} is damaged, as it has {what}: restore it, or remove it and {path.name}, and the cell is run again"
        )
    return rows


def rollouts_of(path: Path) -> Path:
    """Return where the fresh episodes of the cell are whose manifest was collected at this path, if there are any."""
    return path.with_name(f"{path.stem}.{ROLLOUTS}")


def read_rollouts(path: Path) -> np.ndarray | None:
    """Return a table of fresh episodes, or None where there is none."""
    return read_rows(path) if path.exists() else None
