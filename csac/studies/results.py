"""What cells leave for a report, their evaluations and a small manifest: read from runs, or from committed files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from csac.record.files import write_atomically
from csac.record.run import RunDirectory
from csac.record.tables import read_rows
from csac.studies.cells import Cell, Store, read_history
from csac.studies.job import ROLLOUTS
from csac.types import InputError

if TYPE_CHECKING:
    import numpy as np

# Of a manifest, what names the cell and what tells where its numbers come from.
FACTS = (
    *("task", "algorithm", "hyperparameters", "seeds", "steps", "evaluation", "perturbations"),
    *("environment_arguments", "events", "state", "steps_done", "failures", "created", "device", "versions", "commit"),
    "command",
)


class Record(NamedTuple):
    """What one cell has given. `facts` are those of its manifest, its processor and the seconds that it took."""

    cell: Cell
    facts: dict[str, Any]
    evaluations: np.ndarray
    rollouts: np.ndarray | None

    @property
    def failure(self) -> str:
        """Why it failed, or nothing."""
        return "; ".join(map(str, self.facts["failures"].values())) if self.facts["state"] == "failed" else ""


class Source(Protocol):
    """Where records come from."""

    def record(self, cell: Cell) -> Record | None:
        """Return what a cell has given, or None where there is nothing final."""
        ...


class Runs:
    """Records from the runs themselves."""

    def __init__(self, store: Store) -> None:
        self.store = store

    def record(self, cell: Cell) -> Record | None:
        """Return what a cell has given, or None where it is not over. Raises InputError for a damaged table."""
        if not self.store.is_final(cell):
            return None
        path = self.store.path(cell)
        run, history = RunDirectory.open(path), read_history(path)
        facts = {name: run.manifest.get(name) for name in FACTS}
        facts["processor"] = run.manifest.get("machine", {}).get("processor")
        facts["seconds"] = history.get("seconds")
        return Record(cell, facts, run.evaluations, _rows(path / ROLLOUTS))


class Results:
    """Records from files that were collected: `cells/<task>/<arm>/seed-<k>.json` and its tables."""

    def __init__(self, directory: str | Path) -> None:
        self.directory = Path(directory)
        self._files: dict[str, Path] = {}
        for path in sorted(self.directory.glob("cells/*/*/seed-*.json")):
            try:
                self._files[Cell.of_run(json.loads(path.read_bytes())).key] = path
            except (ValueError, OSError) as error:
                raise InputError(f"{path} is not a cell's: {error}") from None
        if not self._files:
            raise InputError(
                f"{self.directory} holds no results of a study; csac study run NAME --results DIR makes them"
            )

    def record(self, cell: Cell) -> Record | None:
        """Return what a cell has given, or None where it was not collected."""
        path = self._files.get(cell.key)
        if path is None:
            return None
        facts = json.loads(path.read_bytes())
        return Record(cell, facts, read_rows(path.with_suffix(".csv")), _rows(_rollouts(path)))


def collect(store: Store, cell: Cell, directory: str | Path) -> None:
    """Copy what a cell that is over has given to files that are small enough to be kept with the code."""
    record, source = Runs(store).record(cell), store.path(cell)
    if record is None or not (source / "evaluations.csv").exists():
        return
    path = Path(directory) / "cells" / cell.name.with_suffix(".json")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path.with_suffix(".csv"), (source / "evaluations.csv").read_bytes())
    if (source / ROLLOUTS).exists():
        write_atomically(_rollouts(path), (source / ROLLOUTS).read_bytes())
    write_atomically(path, (json.dumps(record.facts, indent=1) + "\n").encode())


def _rollouts(path: Path) -> Path:
    return path.with_name(f"{path.stem}.{ROLLOUTS}")


def _rows(path: Path) -> np.ndarray | None:
    return read_rows(path) if path.exists() else None
