"""A set of runs, one per seed, in the folders `seed-<k>` of one folder, or a single run."""

from __future__ import annotations

import os
import re
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from csac.checks import check_path
from csac.record.run import MANIFEST, RunDirectory, is_run
from csac.record.tables import joined
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Self

    from csac.record.config import RunConfig
    from csac.record.run import Table


def split_step(where: str | os.PathLike[str]) -> tuple[str, int | None]:
    """Split `DIRECTORY@STEP`; the step of `DIRECTORY` is None. Raises InputError if the step is no number."""
    name, at, text = str(where).rpartition("@")
    if not at or os.path.exists(where):
        return str(where), None
    if not re.fullmatch(r"[0-9]+(_[0-9]+)*", text):
        raise InputError(f"{where}: {text!r} is not a step; write DIRECTORY@STEP")
    return name, int(text)


class RunSet:
    """The runs in the folders `seed-<k>` of one folder, or a single run; `curve` is the path of their plot."""

    def __init__(self, path: Path, runs: Sequence[RunDirectory]) -> None:
        self.path, self.runs, self.seeds = path, list(runs), [run.seed for run in runs]
        self.curve = path / "curve.png"

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r}, seeds {self.seeds})"

    def __fspath__(self) -> str:
        return str(self.path)

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Self:
        """Open the runs in a folder, or a single run. Raises InputError if there is none, or a manifest is damaged."""
        check_path("a run directory", path)
        path = Path(os.path.abspath(path))
        if is_run(path):
            return cls(path, [RunDirectory.open(path)])
        below = [folder for folder in path.glob("seed-*") if is_run(folder)]
        runs = [run for run in map(RunDirectory.open, below) if run.path == run_path(path, run.seed)]  # no backup
        runs.sort(key=lambda run: run.seed)
        if not runs:
            RunDirectory.open(path)  # raises InputError that says what is there instead
        return cls(path, runs)

    @property
    def config(self) -> RunConfig:
        """The configuration of the first run; the others differ in their seeds."""
        return self.runs[0].config

    @property
    def failures(self) -> dict[int, str]:
        """The failure message of each failed seed."""
        return {run.seed: run.manifest.failure for run in self.runs if run.manifest.state == "failed"}

    @property
    def state(self) -> str:
        """The most urgent state among the runs: running, killed, interrupted, waiting, failed, or else finished."""
        states, order = {run.state for run in self.runs}, ("running", "killed", "interrupted", "waiting", "failed")
        return next((state for state in order if state in states), "finished")

    @property
    def steps_done(self) -> int:
        """The fewest steps done by any seed that did not fail."""
        steps = [run.manifest.steps_done for run in self.runs if run.manifest.state != "failed"]
        return min(steps or [run.manifest.steps_done for run in self.runs])

    def run(self, seed: int) -> RunDirectory:
        """Return the run of one seed. Raises InputError if there is none."""
        for run in self.runs:
            if run.seed == seed:
                return run
        raise InputError(f"{self.path} has no seed {seed!r:.20}; it has {', '.join(map(str, self.seeds))}")

    def rows(self, name: Table) -> np.ndarray:
        """Return all runs' rows of a table, seed by seed, with the columns that they have in common."""
        return joined(name, (run.rows(name) for run in self.runs))

    @property
    def evaluations(self) -> np.ndarray:
        """The `evaluations` of all runs."""
        return joined("evaluations", (run.evaluations for run in self.runs))

    @property
    def sound_evaluations(self) -> np.ndarray:
        """The `evaluations` of the runs that did not fail."""
        rows = self.evaluations
        return rows[~np.isin(rows["seed"], list(self.failures))]


def run_path(directory: Path, seed: int) -> Path:
    """Return the folder of a seed's run in a set."""
    return directory / f"seed-{seed}"


def new_set_directory(task: str, algorithm: str) -> Path:
    """Return `runs/<task>/<algorithm>/<date-time>`, with a number appended if that exists."""
    moment = datetime.now().strftime("%Y%m%d-%H%M%S")
    first = Path("runs", as_folder(task), as_folder(algorithm), moment).absolute()
    path, number = first, 1
    while os.path.lexists(path):
        number += 1
        path = first.with_name(f"{moment}-{number}")
    return path


def as_folder(name: str) -> str:
    """Return the name of a task or algorithm as a folder name."""
    return name.replace("/", "-").replace(":", "-")


def find_sets(directory: str | Path, on_damaged: Callable[[InputError], None] | None = None) -> list[RunSet]:
    """Return every set of runs in `directory` and below, sorted by path; `on_damaged` gets each damaged run's error.

    Raises InputError if there is no such directory.
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise InputError(f"there is no directory {directory}; give one that holds runs")
    found: dict[Path, list[RunDirectory]] = {}
    for folder, below, files in os.walk(directory):
        below[:] = [name for name in below if not name.startswith(".")]  # temporary folders of runs being created
        if MANIFEST in files or ("checkpoint" in below and is_run(folder)):
            below.clear()
            try:
                run = RunDirectory.open(folder)
                in_set = run.path == run_path(run.path.parent, run.seed) and Path(folder) != directory
                found.setdefault(run.path.parent if in_set else run.path, []).append(run)
            except InputError as error:
                if on_damaged and "evaluations.csv" in files:  # otherwise the manifest is not a run's
                    on_damaged(error)
    return [RunSet(path, sorted(runs, key=lambda run: run.seed)) for path, runs in sorted(found.items())]
