"""The arms of a comparison: the runs of one method on one task under one condition, their seeds merged."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.lib.recfunctions import repack_fields

from csac.record.statistics import evaluation_matrix, maximum_average_return
from csac.record.summaries import over_seeds
from csac.record.tables import COLUMNS, structured
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from csac.record.manifest import Manifest
    from csac.record.summaries import OverSeeds
    from csac.studies.collected import Record
    from csac.studies.results import Source
    from csac.studies.study import Study


class Time(NamedTuple):
    """How long one run took: `steps` environment steps of each of its seeds."""

    seconds: float
    steps: int
    seeds: tuple[int, ...]
    interrupted: bool | None = None
    """Whether it was ever stopped and resumed, None where that is not known."""


@dataclass
class Arm:
    """Seeds that belong together: what one method has given on one task under one condition, without what failed."""

    label: str
    task: str
    condition: tuple[str, ...] = ()
    """What the task was perturbed by."""
    algorithm: str = ""
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    published: str | None = None
    """The paper's column that stands beside it."""
    preset: str | None = None
    """What its other hyperparameters come from, where that is a preset."""
    manifests: list[Manifest] = field(default_factory=list)
    times: list[Time] = field(default_factory=list)
    """How long each of its runs took, as far as that is known."""
    evaluations: list[np.ndarray] = field(default_factory=list)
    tests: list[np.ndarray] = field(default_factory=list)
    """Rows of fresh episodes of finished policies."""
    failures: dict[int, str] = field(default_factory=dict)
    missing: list[int] = field(default_factory=list)
    """Seeds that are not over."""
    beginnings: dict[int, int] = field(default_factory=dict)
    """Of each seed that is the beginning of a longer run, the steps of that."""

    @property
    def rows(self) -> np.ndarray:
        """The rows of evaluations.csv of every seed that did not fail."""
        return _joined(self.evaluations)

    @property
    def rollouts(self) -> np.ndarray:
        """The rows of the fresh episodes of every seed that did not fail."""
        return _joined(self.tests)

    def best(self) -> tuple[np.ndarray, int]:
        """Return each seed's return at the step of the maximum average return, and that step; none without one."""
        rows = self.rows
        try:
            _, step = maximum_average_return(rows)
        except InputError:
            return np.zeros(0), 0
        steps, _, returns = evaluation_matrix(rows)
        return returns[:, int(np.flatnonzero(steps == step)[0])], step

    def maximum(self) -> OverSeeds:
        """Return the maximum average return: its mean is the paper's score, its deviation is over the seeds."""
        return over_seeds(self.best()[0])


def gather(study: Study, source: Source) -> list[Arm]:
    """Return every arm of a study with what its cells have given, task by task.

    The beginning of a longer run has no policy of its own to test: where the study tests policies, it is missing.
    """
    arms: dict[tuple[str, tuple[str, ...], str], Arm] = {}
    for method, condition, cell in study.entries():
        given = (method.algorithm, method.hyperparameters, method.published, method.preset)
        made = Arm(method.label, cell.task, condition, *given)
        arm = arms.setdefault((cell.task, condition, method.label), made)
        record = source.record(cell)
        if record is None or (record.longer and study.rollouts_each):
            arm.missing.append(cell.seed)
        elif record.failure:
            arm.failures[cell.seed] = record.failure
        else:
            _add(arm, record, cell.seed)
    order = {task: index for index, task in enumerate(study.tasks)}
    return sorted(arms.values(), key=lambda arm: order[arm.task])


def with_rows(arms: Sequence[Arm]) -> list[Arm]:
    """Return the arms of which there is something to show."""
    return [arm for arm in arms if len(arm.rows)]


def by_condition(arms: Sequence[Arm]) -> dict[tuple[str, tuple[str, ...]], list[Arm]]:
    """Return the arms of each task and condition."""
    groups: dict[tuple[str, tuple[str, ...]], list[Arm]] = {}
    for arm in arms:
        groups.setdefault((arm.task, arm.condition), []).append(arm)
    return groups


def variant_of(label: str) -> str:
    """Return what stands before the first comma of a label: the method, without what was swept."""
    return label.partition(", ")[0]


def tasks_of(arms: Sequence[Arm]) -> dict[str, list[Arm]]:
    """Return the arms of each task."""
    return {task: [arm for arm in arms if arm.task == task] for task in dict.fromkeys(arm.task for arm in arms)}


def _add(arm: Arm, record: Record, seed: int) -> None:
    arm.manifests.append(record.manifest)
    if record.seconds:
        one = record.manifest
        arm.times.append(Time(record.seconds, one.config.steps, (one.config.seed,), record.interrupted))
    arm.evaluations.append(record.evaluations)
    arm.tests += [] if record.rollouts is None else [record.rollouts]
    if record.longer:
        arm.beginnings[seed] = record.longer


def _joined(tables: Sequence[np.ndarray]) -> np.ndarray:
    """Return the rows of all tables, with the columns that each of them has."""
    if not tables:
        return structured(COLUMNS["evaluations"], [])
    columns = [table.dtype.names or () for table in tables]
    names = [name for name in columns[0] if all(name in own for own in columns)]
    return np.concatenate([repack_fields(table[names]) for table in tables])
