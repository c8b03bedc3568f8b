"""`csac tune`: trials of a shared study, one after another, each a run that is trained, judged, and perhaps pruned."""

from __future__ import annotations

import shutil
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.checks import check_whole
from csac.record.sets import RunSet
from csac.record.statistics import evaluation_matrix, last_evaluations
from csac.studies.cells import restarting_seeds
from csac.studies.job import Stopped
from csac.studies.shared_study import POINTS
from csac.tasks.seeds import TUNING_EVALUATION_SEED
from csac.training.checkpoint import steps_in
from csac.training.signals import signals_noted
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from csac.studies.shared_study import Attempt, Result, SharedStudy

MOST_TRIALS = 100_000


@dataclass
class Watcher:
    """What a search tells whoever watches it; nothing, unless a subclass listens."""

    def begins(self, attempt: Attempt, step: int) -> None:
        """A trial begins, or goes on from a step."""

    def restarts(self, attempt: Attempt, seeds: Sequence[int]) -> None:
        """The trial goes on without the episodes that these seeds were in, which its checkpoint could not hold."""

    def advanced(self, step: int, objective: float) -> None:
        """The trial was evaluated: so much it has of the objective so far."""

    def ended(self, result: Result, study: SharedStudy) -> None:
        """The trial is over."""


def tune(
    study: SharedStudy,
    trials: int,
    watcher: Watcher,
    command: str | None = None,
) -> None:
    """Run trials, one after another, until the study has so many.

    Raises:
        InputError: fewer than one trial, or a trial that cannot begin.
        Stopped: SIGINT or SIGTERM; the trial was saved and is in the queue again.
        StorageFailure: the directory can no longer be written.
    """
    check_whole("trials", trials, 1, MOST_TRIALS)
    options = {"command": command}
    with signals_noted() as received:
        while not received and (attempt := study.next(trials)):
            with attempt.lock:
                _run(study, attempt, watcher, options)
            watcher.ended(next(one for one in study.results() if one.label == attempt.label), study)
    if received:
        raise Stopped(received[0])


def _run(study: SharedStudy, attempt: Attempt, watcher: Watcher, options: dict[str, Any]) -> None:
    """Train a trial from where it is, and tell the study what came of it."""
    from csac.training.train import Interrupted, train  # JAX

    question = study.question
    points = _points_before(attempt.path)
    watcher.begins(attempt, max(points, default=0))
    if seeds := restarting_seeds(attempt.path):
        watcher.restarts(attempt, seeds)
    for step in points:
        attempt.trial.report(_objective(points, step), step)
    is_pruned = False

    def is_enough(step: int, returns: Mapping[int, float]) -> bool:
        nonlocal is_pruned
        if step not in points:
            points[step] = dict(returns)
            attempt.trial.report(_objective(points, step), step)
        watcher.advanced(step, _objective(points, step))
        # Once is enough: groups that are ahead may tell of later evaluations before the run stops.
        is_pruned = is_pruned or (step < question.steps and attempt.trial.should_prune())
        return is_pruned or len(returns) < question.seeds  # a seed has failed

    try:
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of seeds that fail: told below
            run = train(
                question.algorithm_with(attempt.values),
                question.task,
                directory=attempt.path,
                resume=True,
                tensorboard=False,
                stop_when=is_enough,
                environment_arguments=question.environment_arguments,
                steps=question.steps,
                seeds=question.seeds,
                seeds_per_process=question.seeds,
                first_seed=question.first_seed,
                evaluation_interval=question.evaluation_interval,
                evaluation_episodes=question.evaluation_episodes,
                evaluation_seed=TUNING_EVALUATION_SEED,
                device=question.device,
                checkpoint_interval=question.checkpoint_interval,
                keep_checkpoints=question.keep_checkpoints,
                **options,
            )
    except Interrupted as interruption:
        study.give_back(attempt)
        raise Stopped(interruption.signal_number) from None
    except InputError:
        study.drop(attempt)
        raise
    if failures := run.failures:
        study.prune(attempt, "; ".join(f"seed {seed}: {reason}" for seed, reason in failures.items()))
    elif is_pruned:
        study.prune(attempt)
    else:
        study.complete(attempt, last_evaluations(run.evaluations, POINTS))
    # Nobody goes on with it any more, and the replay takes most of the room.
    for one in run.runs:
        shutil.rmtree(one.checkpoints, ignore_errors=True)


def _points_before(path: Path) -> dict[int, dict[int, float]]:
    """Return each seed's return at each evaluation up to the checkpoint that a trial goes on from.

    A trial that has no checkpoint yet begins anew. One that has is left as it is: `train` restores a damaged table, of
    which nothing is known until then, and refuses a manifest that it cannot use.
    """
    with suppress(InputError):
        runs = RunSet.open(path)
        newest = min(max(steps_in(run.checkpoints), default=0) for run in runs.runs)
        steps, seeds, returns = evaluation_matrix(runs.evaluations)
        return {
            step: dict(zip(seeds.tolist(), column.tolist(), strict=True))
            for step, column in zip(steps.tolist(), returns.T, strict=True)
            if step <= newest
        }
    return {}


def _objective(points: Mapping[int, Mapping[int, float]], step: int) -> float:
    """Return the objective as it was at a step; over the seeds that were alive then."""
    last = sorted(known for known in points if known <= step)[-POINTS:]
    return float(np.mean([np.mean([points[known][seed] for known in last]) for seed in points[step]]))
