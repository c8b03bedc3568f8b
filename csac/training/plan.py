"""What is trained and how, with everything decided: what the command line, `train`, resume and forks share."""

from __future__ import annotations

import dataclasses
import pickle
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from csac.algorithms import ALGORITHMS
from csac.presets import matching_preset
from csac.record.manifest import CheckpointPlan, EvaluationPlan, Manifest
from csac.tasks.known import check_events, events_of
from csac.tasks.perturbations import Perturbation, perturbations_of
from csac.training.options import Options, check_whole
from csac.training.scheduler import choose_evaluation_processes, choose_groups, split_seeds
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.record.run import RunDirectory
    from csac.tasks.making import Task
    from csac.training.options import PlanOptions
    from csac.types import Algorithm


@dataclass(frozen=True, kw_only=True)
class Plan(Options):
    """What is trained and how, with everything decided; shared by the command line, `train`, resume and forks."""

    algorithm: Algorithm
    task: Task
    task_name: str
    """The task's id, or what a callable is called."""
    environment_arguments: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments for the environment."""
    perturbations: tuple[Perturbation, ...] = ()
    """Changes of the task in mid-training, in the order of their steps."""
    events: tuple[str, ...] = ()
    """Names in the last `info` of an evaluation episode: each is a column of evaluations.csv."""
    groups: tuple[tuple[int, ...], ...]
    """The seeds that each process trains."""
    evaluation_processes: int = 0
    """Processes in which each group evaluates while it trains on; 0 evaluates in line."""

    def manifest(self, **surroundings: Any) -> Manifest:
        """Return the manifest of a run that follows this plan; `surroundings` are its machine, versions and so on."""
        hyperparameters = dataclasses.asdict(self.algorithm)  # pyright: ignore[reportArgumentType]
        return Manifest(
            task=self.task_name,
            task_is_callable=not isinstance(self.task, str),
            environment_arguments=self.environment_arguments,
            perturbations=tuple(map(str, self.perturbations)),
            algorithm=self.algorithm.name,
            hyperparameters=hyperparameters,
            preset=matching_preset(self.algorithm.name, self.task_name, hyperparameters),
            seeds=tuple(self.labels),
            groups=self.groups,
            steps=self.steps,
            evaluation=EvaluationPlan(self.evaluation_interval, self.evaluation_episodes),
            events=self.events,
            checkpoints=CheckpointPlan(self.checkpoint_interval, self.keep_checkpoints),
            device=self.device,
            **surroundings,
        )


def choose_events(task: Task, given: Sequence[str] | None, before: Manifest | None) -> tuple[str, ...]:
    """Return the events asked for beside the task's own; without a word those of the run that this one continues."""
    check_events(given or ())
    if given is None and before:
        return before.events
    return events_of(task, given or ())


def choose_parts(
    groups: int | None, options: Options, existing: Manifest | None, can_be_sent: bool
) -> tuple[tuple[int, ...], ...]:
    """Return the seeds of each group, for as many groups as were asked for or, without a word, as pay here."""
    if groups is None and existing and list(existing.seeds) == options.labels:
        groups = len(existing.groups) or 1  # so that the numbers stay the same to the last bit
    if groups is None:
        groups = choose_groups(options.seeds, options.device) if can_be_sent else 1
    check_whole("groups", groups, 1, options.seeds)
    return tuple(tuple(part) for part in split_seeds(options.labels, groups))


def choose_processes(given: int | None, parts: Sequence[Sequence[int]], options: Options, allowed: bool) -> int:
    """Return how many processes each group evaluates with, asked for or as pay here."""
    if given is not None:
        check_whole("evaluation_processes", given, 0, 1_000)
        return given
    if not allowed or options.evaluation_interval >= options.steps:
        return 0
    return choose_evaluation_processes(parts, options.evaluation_episodes)


def options_of(run: RunDirectory) -> tuple[str, PlanOptions]:
    """Return the task and the options that a run was started with, as far as they belong to what it computes.

    Raises:
        InputError: its task is a Python function.
    """
    manifest = run.manifest
    if manifest.task_is_callable:
        raise InputError(
            f"the task of {run.path} is a Python function: call csac.train with it, this directory and resume=True"
        )
    return manifest.task, {
        "steps": manifest.steps,
        "seeds": len(manifest.seeds),
        "first_seed": manifest.seeds[0],
        "evaluation_interval": manifest.evaluation.interval,
        "evaluation_episodes": manifest.evaluation.episodes,
        "environment_arguments": manifest.environment_arguments,
        "perturbations": perturbations_of(manifest.perturbations),
        "device": manifest.device,
        "checkpoint_interval": manifest.checkpoints.interval,
        "keep_checkpoints": manifest.checkpoints.keep,
    }


def algorithm_of(manifest: Manifest) -> Algorithm:
    """Return the algorithm of a run with its hyperparameters. Raises InputError where this csac does not know them."""
    name = manifest.algorithm
    if name not in ALGORITHMS:
        raise InputError(f"the run's algorithm {name!r} is not known: choose a run of {' or '.join(ALGORITHMS)}")
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in manifest.hyperparameters.items()}
    unknown = values.keys() - {item.name for item in dataclasses.fields(ALGORITHMS[name])}
    if unknown:
        raise InputError(f"the run has hyperparameters that this csac does not know: {', '.join(sorted(unknown))}")
    make: Any = ALGORITHMS[name]
    return make(**values)


def check_algorithm(algorithm: object) -> None:
    """Raise InputError for what is no algorithm with its hyperparameters: a name, a class, something else."""
    if not isinstance(algorithm, type) and dataclasses.is_dataclass(algorithm) and hasattr(algorithm, "update"):
        return
    given = algorithm.__name__ if isinstance(algorithm, type) else str(algorithm)
    names = {name: kind.__name__ for name, kind in ALGORITHMS.items()}
    raise InputError(f"{given:.60} is no algorithm with hyperparameters: give {names.get(given.lower(), 'CSAC')}()")


def why_not_sent(*things: object) -> Exception | None:
    """Return what keeps things from being sent to another process, or None."""
    try:
        pickle.dumps(things)
    except Exception as error:
        return error
    return None
