"""Records of cells and runs that nobody has run: what a report shows of numbers that are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from csac.record.tables import structured
from csac.record.manifest import EvaluationPlan, Machine, Manifest
from csac.record.run import RunDirectory
from csac.studies.cells import Cell
from csac.studies.collected import Record

COLUMNS = ("seed", "step", "episode", "return", "length", "success", "out_of_bounds", "collision", "env_complete")
COMMIT = "0123456789" * 4


def rows(cell: Cell, value: Callable[[int], float], points: int = 20, episodes: int = 2) -> np.ndarray:
    """Evaluations of one cell: `value(step)` is the return of each episode."""
    steps = [cell.steps * (point + 1) // points for point in range(points)]
    return structured(
        COLUMNS,
        [
            [str(cell.seed), str(step), str(episode), str(value(step)), "100", "1", "0", "0", "1"]
            for step in steps
            for episode in range(episodes)
        ],
    )


class MadeRecords:
    """A source of records: the return of a cell at a step is `value(cell, step)`; None is a cell that is not over."""

    def __init__(
        self, value: Callable[[Cell, int], float | None], failing: Callable[[Cell], str] = lambda _: ""
    ) -> None:
        self.value, self.failing = value, failing

    def record(self, cell: Cell) -> Record | None:
        if self.value(cell, 0) is None:
            return None
        reason = self.failing(cell)
        manifest = Manifest(
            task=cell.task,
            algorithm=cell.algorithm,
            hyperparameters=cell.hyperparameters,
            perturbations=cell.perturbations,
            seeds=(cell.seed,),
            steps=cell.steps,
            evaluation=EvaluationPlan(cell.evaluation_interval, cell.evaluation_episodes),
            machine=Machine("a processor"),
            versions={"csac": "0.1.0"},
            commit=COMMIT,
            state="failed" if reason else "finished",
            failures={cell.seed: reason} if reason else {},
        )
        table = rows(cell, lambda step: self.value(cell, step) or 0.0)
        return Record(manifest, 60.0, table, rows(cell, lambda _: 1.0, points=1, episodes=10))


def make_run_of(path: str | Path, returns: Sequence[Sequence[float]], **changes: Any) -> RunDirectory:
    """A run of SAC with evaluations at 10, 20, ... of one episode each: `returns` [seed][point], told of its seeds."""
    success = changes.pop("success", None)
    hyperparameters = {"batch_size": 8, "discount": 0.99, **changes.pop("hyperparameters", {})}
    told: dict[str, Any] = {
        "task": "Hopper-v4",
        "algorithm": "sac",
        "seeds": tuple(range(max(1, len(returns)))),
        "steps": 100,
        "steps_done": 100,
        "state": "finished",
        "versions": {"csac": "0.1.0"},
        "commit": COMMIT,
        "command": "csac train Hopper-v4 --seeds 1",
        **changes,
    }
    run = RunDirectory.create(path, Manifest(hyperparameters=hyperparameters, **told))
    run.append(
        "evaluations",
        [
            {"seed": seed, "step": 10 * (t + 1), "episode": 0, "return": value, "length": 7, "success": success}
            for seed, line in zip(told["seeds"], returns, strict=False)
            for t, value in enumerate(line)
        ],
    )
    return run
