"""What cells leave for a report, their evaluations and a small manifest: read from runs, or from committed files."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Protocol

from csac.record import manifest as manifests
from csac.record.files import write_atomically
from csac.record.run import RunDirectory
from csac.record.tables import COLUMNS
from csac.studies.cells import Cell, Status, Store, is_final, read_history
from csac.studies.collected import ROLLOUTS, Record, read_collected, read_rollouts, rollouts_of
from csac.types import InputError


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
        path = self.store.path(cell)
        if not is_final(path):
            return None
        run, seconds = RunDirectory.open(path), read_history(path).get("seconds", 0.0)
        tables = run.evaluations, read_rollouts(path / ROLLOUTS)
        return Record(run.manifest, seconds, *tables, bool(run.manifest.history))


class Results:
    """Records from files that were collected: `cells/<task>/<arm>/seed-<k>.json` and its tables.

    A run without a schedule does not depend on how long it goes on: a longer one stands for a cell that was not run.
    """

    def __init__(self, directory: str | Path, may_be_empty: bool = False) -> None:
        self.directory = Path(directory)
        self._files: dict[str, Path] = {}
        self._of_any_length: dict[str, dict[int, Path]] = {}
        for path in sorted(self.directory.glob("cells/*/*/seed-*.json")):
            try:
                cell = Cell.of_run(manifests.read(path.read_bytes()))
            except (InputError, OSError) as error:
                raise InputError(f"{path} is not a cell's: {error}") from None
            self._files[cell.key] = path
            self._of_any_length.setdefault(_whatever_its_length(cell), {})[cell.steps] = path
        if not self._files and not may_be_empty:
            raise InputError(
                f"{self.directory} holds no results of a study; csac study run NAME --results DIR makes them"
            )

    def has(self, cell: Cell) -> bool:
        """Whether the cell itself was collected, and not a longer run alone."""
        return cell.key in self._files

    def path(self, cell: Cell) -> Path:
        """Return where a cell's manifest is, or is to be: what an older version collected lies under another name."""
        return self._files.get(cell.key, self.directory / "cells" / cell.name.with_suffix(".json"))

    def record(self, cell: Cell) -> Record | None:
        """Return what a cell has given, or None where it was not collected."""
        path = self._files.get(cell.key)
        return self._of_longer(cell) if path is None else read_collected(path)

    def _of_longer(self, cell: Cell) -> Record | None:
        """Return the beginning of a longer run, which has no policy of that time to test, and not how long it took."""
        if cell.make_algorithm().cadence.has_schedule:
            return None
        for steps, path in sorted(self._of_any_length.get(_whatever_its_length(cell), {}).items()):
            if steps > cell.steps and cell.steps % cell.evaluation_interval == 0:
                whole = read_collected(path)
                begun = dataclasses.replace(whole.manifest, steps=cell.steps, steps_done=cell.steps)
                rows = whole.evaluations[whole.evaluations["step"] <= cell.steps]
                if not whole.failure:
                    return Record(begun, 0.0, rows, None, whole.interrupted, steps)
        return None

    def status(self, cell: Cell, rollouts: int) -> Status | None:
        """Return how a cell ended that was collected, with the rollouts that are wanted, or None."""
        record = self.record(cell)
        if record is None:
            return None
        tested = 0 if record.rollouts is None else len(record.rollouts)
        if tested < rollouts and not record.failure:
            return None
        return Status("failed" if record.failure else "complete", cell.steps, record.failure, record.seconds)


def collect(store: Store, cell: Cell, to: Results | str | Path) -> None:
    """Copy what a cell that is over has given to files that are small enough to be kept with the code.

    `to` is their directory, or what is known to be in it already. One that failed before its first evaluation has a
    table without rows. A failure replaces nothing.
    """
    results = to if isinstance(to, Results) else Results(to, may_be_empty=True)
    record, source, path = Runs(store).record(cell), store.path(cell), results.path(cell)
    table = source / "evaluations.csv"
    if record is None or not (record.failure or table.exists()) or (record.failure and path.exists()):
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    header = (",".join(COLUMNS["evaluations"]) + "\n").encode()
    write_atomically(path.with_suffix(".csv"), table.read_bytes() if table.exists() else header)
    if (source / ROLLOUTS).exists():
        write_atomically(rollouts_of(path), (source / ROLLOUTS).read_bytes())
    manifest = dataclasses.replace(record.manifest, machine=dataclasses.replace(record.manifest.machine, host=""))
    fields = json.loads(manifests.written(dataclasses.replace(manifest, process=None, history=())))
    fields |= {"seconds": record.seconds, "interrupted": record.interrupted}
    write_atomically(path, (json.dumps(fields, indent=1) + "\n").encode())


def _whatever_its_length(cell: Cell) -> str:
    return dataclasses.replace(cell, steps=0).key
