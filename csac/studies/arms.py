"""The arms of a study: the cells of one method on one task under one condition, their seeds merged."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from csac.record.statistics import evaluation_matrix, maximum_average_return
from csac.record.summaries import over_seeds
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.record.summaries import OverSeeds
    from csac.studies.results import Record, Source
    from csac.studies.study import Method, Study


@dataclass
class Arm:
    """What the seeds of one method on one task under one condition have given. Failed seeds are in no table of rows."""

    method: Method
    task: str
    condition: tuple[str, ...]
    records: list[Record] = field(default_factory=list)
    failures: dict[int, str] = field(default_factory=dict)
    missing: list[int] = field(default_factory=list)
    """Seeds that are not over."""

    @property
    def label(self) -> str:
        """The method's."""
        return self.method.label

    @property
    def rows(self) -> np.ndarray:
        """The rows of evaluations.csv of every seed that did not fail."""
        return _joined([record.evaluations for record in self.records])

    @property
    def rollouts(self) -> np.ndarray:
        """The rows of the fresh episodes of every seed that did not fail."""
        return _joined([record.rollouts for record in self.records if record.rollouts is not None])

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
    """Return every arm of a study with what its cells have given, task by task."""
    arms: dict[tuple[str, tuple[str, ...], str], Arm] = {}
    for method, condition, cell in study.entries():
        arm = arms.setdefault((cell.task, condition, method.label), Arm(method, cell.task, condition))
        record = source.record(cell)
        if record is None:
            arm.missing.append(cell.seed)
        elif record.failure:
            arm.failures[cell.seed] = record.failure
        else:
            arm.records.append(record)
    order = {task: index for index, task in enumerate(study.tasks)}
    return sorted(arms.values(), key=lambda arm: order[arm.task])


def with_rows(arms: Sequence[Arm]) -> list[Arm]:
    """Return the arms of which there is something to show."""
    return [arm for arm in arms if len(arm.rows)]


def _joined(tables: Sequence[np.ndarray]) -> np.ndarray:
    if not tables:
        return np.zeros(0, [("seed", np.int64), ("step", np.int64), ("episode", np.int64), ("return", np.float64)])
    return np.concatenate(tables)
