"""Searches whose trials are not trained: what each seed would reach is told."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

from csac.algorithms import SAC
from csac.record.manifest import EvaluationPlan, Manifest
from csac.record.run import RunDirectory, is_run
from csac.studies.search_space import searched
from csac.studies.shared_study import Attempt, Question, Result, SharedStudy
from csac.studies.tune import Watcher
from csac.training.interruptions import Interrupted

Value = Callable[[Any, int, int], float]  # of an algorithm, a seed and a step


def question(search: tuple[str, ...] = ("actor_learning_rate", "discount"), **changes: Any) -> Question:
    """A question with steps 100 to 1,000 and two seeds."""
    algorithm = changes.pop("algorithm", SAC(warmup_steps=50))
    given: dict[str, Any] = {
        "task": "probes:ActionReward-v0",
        "steps": 1_000,
        "seeds": 2,
        "first_seed": 1_000,
        "evaluation_interval": 100,
        "evaluation_episodes": 2,
        **changes,
    }
    values = vars(algorithm)
    return Question(algorithm=algorithm, space=searched(algorithm.name, values, search, ()), **given)


class FakeTrain:
    """Stands in for `train`. `value` says what a seed reaches; it may be stopped at a step, and a seed may fail.

    `lead` is how many evaluations it still tells of when it has been told to stop, as groups that are ahead do.
    """

    def __init__(
        self, value: Value, stop_at: int = 0, failing: Callable[[Any], bool] = lambda _: False, lead: int = 0
    ) -> None:
        self.value, self.stop_at, self.failing, self.lead = value, stop_at, failing, lead
        self.calls: list[dict[str, Any]] = []

    def __call__(self, algorithm: Any, task: str, *, directory: Path, stop_when: Any, **options: Any) -> RunDirectory:
        self.calls.append({"algorithm": algorithm, "task": task, "directory": directory, **options})
        seeds = range(options["first_seed"], options["first_seed"] + options["seeds"])
        run, interval = self._run(directory, algorithm, seeds, options), options["evaluation_interval"]
        if self.failing(algorithm):
            run.update_manifest(failures={seeds[0]: "step 7: learning has diverged"}, state="failed")
            seeds = seeds[1:]
        end = options["steps"]
        for step in range(run.manifest.last_checkpoint + interval, options["steps"] + 1, interval):
            if step > end:
                break
            returns = {seed: self.value(algorithm, seed, step) for seed in seeds}
            row = {"step": step, "length": 1, "success": None}
            run.append(
                "evaluations",
                [
                    {**row, "seed": seed, "episode": episode, "return": value + 2 * episode - 1}
                    for seed, value in returns.items()
                    for episode in range(2)
                ],
            )
            if stop_when(step, returns):
                end = min(end, step + self.lead * interval)
            if step == self.stop_at:
                run.update_manifest(last_checkpoint=step, state="interrupted")
                raise Interrupted(run, signal.SIGINT, True)
        run.update_manifest(state=run.manifest.state if run.manifest.failures else "finished")
        return run

    def _run(self, directory: Path, algorithm: Any, seeds: range, options: dict[str, Any]) -> RunDirectory:
        if is_run(directory):
            return RunDirectory.open(directory)
        plan = EvaluationPlan(options["evaluation_interval"], 2, options["evaluation_seed"])
        manifest = Manifest(
            task="t", algorithm=algorithm.name, seeds=tuple(seeds), steps=options["steps"], evaluation=plan
        )
        return RunDirectory.create(directory, manifest)


class Told(Watcher):
    """Keeps what a search tells."""

    def __init__(self) -> None:
        self.begun: list[tuple[int, int]] = []
        self.results: list[Result] = []

    def begins(self, attempt: Attempt, step: int) -> None:
        self.begun.append((attempt.label, step))

    def ended(self, result: Result, study: SharedStudy) -> None:
        self.results.append(result)
