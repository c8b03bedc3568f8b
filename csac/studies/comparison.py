"""Any runs, read to be compared, as the arms that they are of.

A run is a run directory, a cell that a study has collected (`seed-<k>.json` and its tables), or a file of rows as
evaluations.csv has them, of which nothing else is known.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from csac.checks import check_whole
from csac.record.config import STEPS_LIMIT
from csac.record.run import RunDirectory, is_run
from csac.record.sets import find_sets
from csac.record.summaries import case_names, last_rows
from csac.record.tables import check_ends, read_evaluations, read_rows
from csac.studies.arms import Arm, Time
from csac.studies.collected import ROLLOUTS, find_collected, read_collected, rollouts_of
from csac.studies.configurations import differing, filled_in, labels, merged, name_of, settings_of
from csac.studies.sections import plain
from csac.tasks.perturbations import perturbations_of
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from csac.record.manifest import Manifest


class Given(NamedTuple):
    """One run: what it is called where a label was given, where it is, and what is known of it."""

    label: str | None
    path: Path
    rows: np.ndarray
    manifest: Manifest | None
    rollouts: Path | None = None
    """Where its fresh episodes are, if there are any."""
    times: tuple[Time, ...] = ()
    """How long it took, as far as that is known."""


@dataclass(frozen=True)
class Comparison:
    """Runs to report on. Steps are environment steps per seed.

    Raises:
        InputError: no such step, no such perturbation, or one of runs that all tell of their own.
    """

    runs: tuple[Given, ...]
    perturbations: tuple[str, ...] = ()
    """What changed in runs that cannot tell it themselves."""
    until: int | None = None
    """The last step that counts."""

    def __post_init__(self) -> None:
        if self.until is not None:
            check_whole("--until", self.until, 1, STEPS_LIMIT)
        if perturbations_of(self.perturbations) and all(run.manifest for run in self.runs):
            raise InputError("--perturb is for a CSV file alone: these runs tell themselves what was changed in them")

    @property
    def has_rows(self) -> bool:
        """Whether any run has an evaluation that counts."""
        steps = [run.rows["step"] for run in self.runs]
        return any(len(one) if self.until is None else (one <= self.until).any() for one in steps)

    def arms(self) -> list[Arm]:
        """Return the arms: runs of one label on each task, or else runs that differ in their seeds alone.

        Raises:
            InputError: runs of one label on one task have a seed in common, or differ in what no arm can.
        """
        groups: dict[str, list[Given]] = {}
        for run in self.runs:
            key = f"label {run.label}, {self._task(run)}" if run.label else _key(run)
            own = groups.setdefault(key, [])
            if own and seeds_of([run]) & seeds_of(own):
                if run.label:
                    common = min(seeds_of([run]) & seeds_of(own))
                    raise InputError(
                        f"{run.label}: {own[0].path} and {run.path} both hold seed {common}; label them apart"
                    )
                own = groups.setdefault(f"{key} {run.path}", [])
            own.append(run)
        return _named([self._arm(runs) for runs in groups.values()], [runs[0] for runs in groups.values()])

    def _task(self, run: Given) -> str:
        """Return what a run of a label learns: a file of rows, which cannot tell, what the runs beside it learn."""
        if run.manifest:
            return run.manifest.config.task
        tasks = sorted({one.manifest.config.task for one in self.runs if one.label == run.label and one.manifest})
        if len(tasks) > 1:
            raise InputError(
                f"{run.label}: {run.path} does not tell which of {' and '.join(tasks)} it is of; label it apart"
            )
        return tasks[0] if tasks else ""

    def _arm(self, runs: Sequence[Given]) -> Arm:
        manifests = [run.manifest for run in runs if run.manifest]
        self._refuse_differing(runs[0].label, manifests)
        condition = manifests[0].config.perturbations if manifests else self.perturbations
        task = manifests[0].config.task if manifests else ""
        arm = Arm(runs[0].label or "", task, tuple(map(str, perturbations_of(condition))))
        end = max(self._end(run) for run in runs)
        for run in runs:
            failed = _failures(run.manifest)
            rows = run.rows[~np.isin(run.rows["seed"], list(failed))]
            rows = rows if self.until is None else rows[rows["step"] <= self.until]
            arm.failures.update(failed)
            if run.manifest and _is_on_its_way(run.manifest) and self._end(run) < end:
                arm.missing += sorted({run.manifest.config.seed} - failed.keys())
                arm.manifests.append(run.manifest)
                continue
            arm.evaluations.append(rows)
            arm.tests += self._tests(run, rows, failed)
            if run.manifest:
                arm.manifests.append(run.manifest)
                arm.times += run.times
        if manifests:
            arm.algorithm, arm.hyperparameters = (
                manifests[0].config.algorithm,
                merged([settings_of(one) for one in manifests]),
            )
        return arm

    def _end(self, run: Given) -> int:
        """Return the step of a run's last evaluation that counts."""
        steps = run.rows["step"]
        return int((steps if self.until is None else steps[steps <= self.until]).max(initial=0))

    def _tests(self, run: Given, rows: np.ndarray, failed: Mapping[int, str]) -> list[np.ndarray]:
        """Return the fresh episodes of a run, or those of its last evaluation, where they tell of what happens.

        Fresh episodes of a policy that has learnt beyond the last step that counts do not.
        """
        one = run.manifest
        is_beyond = one is not None and self.until is not None and one.steps_done > self.until
        if run.rollouts and not is_beyond and run.rollouts.exists():
            rows = read_rows(run.rollouts)
            rows = rows[~np.isin(rows["seed"], list(failed))]
        return [last_rows(rows)] if case_names([rows]) else []

    def _refuse_differing(self, label: str | None, manifests: Sequence[Manifest]) -> None:
        """Raise InputError where the runs of one label cannot be one arm."""
        told = [
            {
                "algorithm": one.config.algorithm,
                "perturbations": ", ".join(map(str, perturbations_of(one.config.perturbations))) or "none",
                "steps": one.config.steps if self.until is None else min(one.config.steps, self.until),
                "evaluation interval": one.config.evaluation_interval,
            }
            for one in manifests
        ]
        for name in differing(told)[:1]:
            values = " and ".join(dict.fromkeys(plain(one[name]) for one in told))
            raise InputError(f"{label}: its runs differ in {name}, {values}; give each a label of its own")


def read_runs(
    paths: Sequence[Path],
    labels: Sequence[tuple[str, Sequence[Path]]] = (),
    on_damaged: Callable[[InputError], None] | None = None,
) -> tuple[Given, ...]:
    """Return the runs at these paths and below them, each once, and those that have a label.

    `on_damaged` is told why a run below a path is left out.

    Raises:
        InputError: there is no run, or one that a path names, or rows of any, cannot be read.
    """
    plain_ones: dict[Path, Given] = {}
    for run in (run for path in paths for run in _read(path, None, on_damaged)):
        plain_ones.setdefault(run.path.resolve(), run)  # a path may lie below another
    labelled = [run for label, some in labels for path in some for run in _read(path, label, on_damaged)]
    runs = (*plain_ones.values(), *labelled)
    if not runs:
        raise InputError("there is nothing to report on: give run directories ('csac runs' lists them)")
    manifests = filled_in([run.manifest for run in runs])
    return tuple(run._replace(manifest=manifest) for run, manifest in zip(runs, manifests, strict=True))


def _read(path: Path, label: str | None, on_damaged: Callable[[InputError], None] | None) -> list[Given]:
    """Return the run at this path, or those below it, or else the collected cells. Raises InputError without any."""
    if path.name == "evaluations.csv" and is_run(path.parent):
        path = path.parent
    if path.suffix == ".csv":
        rows = read_evaluations(path)
        check_ends(path)
        return [Given(label, path, rows, None)]
    sets = [] if is_run(path) or not path.is_dir() else find_sets(path, on_damaged)
    runs = [run for one in sets for run in one.runs]
    if not runs and not is_run(path) and (collected := find_collected(path)):
        return [_given_cell(label, manifest) for manifest in collected]
    return [_given_run(label, run) for run in runs or [RunDirectory.open(path)]]


def _failures(manifest: Manifest | None) -> dict[int, str]:
    return {manifest.config.seed: manifest.failure} if manifest and manifest.state == "failed" else {}


def _given_run(label: str | None, run: RunDirectory) -> Given:
    return Given(label, run.path, run.evaluations, run.manifest, run.path / ROLLOUTS, _times(run.path, run.manifest))


def _given_cell(label: str | None, path: Path) -> Given:
    cell = read_collected(path)
    one = cell.manifest
    is_whole = cell.seconds and not cell.failure
    took = (Time(cell.seconds, one.config.steps, (one.config.seed,), cell.interrupted),) if is_whole else ()
    return Given(label, path.with_suffix(".csv"), cell.evaluations, one, rollouts_of(path), took)


def _is_on_its_way(manifest: Manifest) -> bool:
    """Whether a run is being made, or was stopped and can go on."""
    return manifest.state not in ("finished", "failed")


def _key(run: Given) -> str:
    """Return what runs without a label have in common that are one arm."""
    one = run.manifest
    if not one:
        return f"file {run.path}"
    fields = [one.config.task, one.config.algorithm, one.config.perturbations, settings_of(one)]
    return f"run {json.dumps(fields, sort_keys=True, default=str)}"


def _named(arms: list[Arm], firsts: Sequence[Given]) -> list[Arm]:
    """Give a label to each arm that has none; arms that it does not tell apart are told by where they are."""
    names = labels(arms, [arm.label or _name(run) for arm, run in zip(arms, firsts, strict=True)])
    keys = [(label, arm.task, arm.condition) for label, arm in zip(names, arms, strict=True)]
    return [
        replace(arm, label=f"{key[0]}, {run.path}" if keys.count(key) > 1 else key[0])
        for arm, key, run in zip(arms, keys, firsts, strict=True)
    ]


def _name(run: Given) -> str:
    return name_of(run.manifest) if run.manifest else run.path.stem


def seeds_of(runs: Sequence[Given]) -> set[int]:
    """Return the seeds that the rows of runs have."""
    return {int(seed) for run in runs for seed in np.unique(run.rows["seed"])}


def _times(path: Path, manifest: Manifest) -> tuple[Time, ...]:
    """Return how long a run took that was never interrupted, by its manifest and the last line of its log."""
    if manifest.history or manifest.state != "finished":
        return ()
    with suppress(OSError, ValueError, IndexError):
        last = (path / "log.txt").read_text(encoding="utf-8").splitlines()[-1]
        took = datetime.fromisoformat(last.split(" ")[0]) - datetime.fromisoformat(manifest.created)
        return (Time(took.total_seconds(), manifest.steps_done, (manifest.config.seed,), interrupted=False),)
    return ()
