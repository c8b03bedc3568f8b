"""What is trained and how, with everything decided: what the command line, `train`, resume and forks share."""

from __future__ import annotations

import dataclasses
import logging
import pickle
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from csac.algorithms import ALGORITHMS
from csac.checks import check_whole
from csac.presets import matching_preset
from csac.record.manifest import CheckpointPlan, EvaluationPlan, Manifest
from csac.record.run import RunDirectory, is_run
from csac.tasks.environment import Environment
from csac.tasks.perturbations import Perturbation, perturbations_of, refuse_late
from csac.tasks.preflight import json_arguments, try_task, wrapper_warnings
from csac.tasks.registry import check_events, events_of
from csac.tasks.seeds import EVALUATION_SEED, FIRST_TRAINING_SEED
from csac.tasks.trust import remember
from csac.training.checkpoint import steps_in
from csac.training.devices import choose_device
from csac.training.options import Options, check_groups, checked_options
from csac.training.resume import Source, planned_perturbations, refuse_other_source
from csac.training.scheduler import choose_evaluation_processes, choose_groups, split_seeds
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.tasks.registry import Task
    from csac.training.options import PlanOptions
    from csac.types import Algorithm, Spec


_log = logging.getLogger(__name__)


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
    evaluation_seed: int = EVALUATION_SEED
    """What the first evaluation episode is reset with; the next ones with the numbers after it."""
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
            preset=matching_preset(type(self.algorithm), self.task_name, hyperparameters),
            seeds=tuple(self.labels),
            groups=self.groups,
            steps=self.steps,
            evaluation=EvaluationPlan(self.evaluation_interval, self.evaluation_episodes, self.evaluation_seed),
            events=self.events,
            checkpoints=CheckpointPlan(self.checkpoint_interval, self.keep_checkpoints),
            device=self.device,
            **surroundings,
        )


class Before(NamedTuple):
    """What was there before this call: the run that goes on, or the checkpoint that another run begins with."""

    directory: Path | None
    existing: RunDirectory | None
    source: Source | None
    unbegun: RunDirectory | None = None
    """A fork that was made and never had its checkpoint, which is copied once more."""

    @classmethod
    def find(cls, directory: str | Path | None, resume: bool, start_from: str | Path | None) -> Before:
        """Look for what is to be continued. Raises InputError where it cannot be."""
        path = None if directory is None else Path(directory)
        existing = RunDirectory.open(path) if path and resume and is_run(path) else None
        if existing and _has_begun(existing):
            if start_from is not None:
                refuse_other_source(existing, start_from)
            return cls(path, existing, None)
        if start_from is None:
            return cls(path, existing, None)
        return cls(path, None, Source.find(start_from), existing)

    @property
    def run(self) -> RunDirectory | None:
        """The run that is continued, in its own directory or in another."""
        return self.existing or (self.source.run if self.source else None)

    def create(self, plan: Plan, manifest: Manifest) -> RunDirectory:
        """Start the new run in the directory that was named, or in one of its own. Raises InputError."""
        if self.unbegun:
            return self.unbegun
        if self.directory:
            return RunDirectory.create(self.directory, manifest)
        return RunDirectory.create_by_date(plan.task_name, manifest)

    def copy_source(self, run: RunDirectory, manifest: Manifest) -> None:
        """Give a new run, which is locked, the checkpoint that it begins with. Raises InputError."""
        assert self.source
        if self.unbegun:
            run.read_again()
            if _has_begun(run):
                raise InputError(f"{run.path} has begun meanwhile: resume it")
            run.update_manifest(**{**vars(manifest), "created": run.manifest.created})
        self.source.copy_to(run, manifest.checkpoints.keep)


def _has_begun(run: RunDirectory) -> bool:
    """Whether there is anything to go on with: not in a fork that was stopped before it had its checkpoint."""
    manifest = run.manifest
    return bool(not manifest.forked_from or manifest.history or steps_in(run.checkpoints))


def make_plan(
    algorithm: Algorithm, task: Task, given: PlanOptions, before: Before, may_evaluate_beside: bool
) -> tuple[Plan, Spec]:
    """Return what is to be done, with everything decided that was left open, and the sizes of the task.

    Raises:
        InputError: a mistake in the options, or a task that csac cannot learn.
    """
    options, others = checked_options(given, algorithm)
    choose_device(options.device)
    if others.get("evaluation_processes") and not may_evaluate_beside:
        raise InputError("stop_when is asked before training goes on: leave out evaluation_processes")
    arguments = json_arguments(others.get("environment_arguments"))
    asked = others.get("perturbations")
    continued = before.run.manifest if before.run else None
    with closing(Environment(task, arguments)) as environment:
        spec, task_name = environment.spec, environment.task_name
        try_task(environment, arguments)
        for line in wrapper_warnings(environment):
            _log.warning("note: %s", line)
        remember(task)
        changes = planned_perturbations(asked, before.existing, before.source)
        if not before.existing:  # whose number of steps has its own refusal
            refuse_late(changes, options.steps, planned=before.source is not None and asked is None)
        for item in changes:
            environment.perturb({item.kind: item.value})
    problem = _why_not_sent(algorithm, task, arguments)
    existing = before.existing.manifest if before.existing else None
    parts = _choose_parts(others.get("groups", 1), options, existing, not problem)
    processes = _choose_processes(
        others.get("evaluation_processes", 0), parts, options, may_evaluate_beside and not problem
    )
    if problem and (processes or len(parts) > 1):
        wanted, without = ("evaluation_processes need", "evaluation_processes=0") if processes else _SEVERAL
        raise InputError(
            f"the task cannot be sent to another process, which {wanted}: "
            f"make it a module's function, or train with {without} ({problem})"
        )
    plan = Plan(
        **dataclasses.asdict(options),
        algorithm=algorithm,
        task=task,
        task_name=task_name,
        environment_arguments=arguments,
        perturbations=changes,
        evaluation_seed=_choose_evaluation_seed(others.get("evaluation_seed", EVALUATION_SEED), options),
        events=_choose_events(task, others.get("events"), continued),
        groups=parts,
        evaluation_processes=processes,
    )
    return plan, spec


_SEVERAL = ("several groups need", "groups=1")


def _choose_events(task: Task, given: Sequence[str] | None, before: Manifest | None) -> tuple[str, ...]:
    """Return the events asked for beside the task's own; without a word those of the run that this one continues."""
    if given is not None:
        check_events(given)
    if given is None and before:
        return before.events
    return events_of(task, given or ())


def _choose_evaluation_seed(given: int, options: Options) -> int:
    """Return what the first evaluation episode is reset with, if no training episode can be reset with one of them."""
    check_whole("evaluation_seed", given, 0, FIRST_TRAINING_SEED - options.evaluation_episodes)
    return int(given)


def _choose_parts(
    groups: int | None, options: Options, existing: Manifest | None, can_be_sent: bool
) -> tuple[tuple[int, ...], ...]:
    """Return the seeds of each group, for as many groups as were asked for or, without a word, as pay here."""
    if groups is None and existing and (list(existing.seeds), existing.device) == (options.labels, options.device):
        groups = len(existing.groups) or 1  # so that the numbers stay the same to the last bit
    if groups is None:
        groups = choose_groups(options.seeds, options.device) if can_be_sent else 1
    check_groups(groups, options.seeds)
    return tuple(tuple(part) for part in split_seeds(options.labels, groups))


def _choose_processes(given: int | None, parts: Sequence[Sequence[int]], options: Options, allowed: bool) -> int:
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
        "evaluation_seed": manifest.evaluation.first_seed,
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


def _why_not_sent(*things: object) -> Exception | None:
    """Return what keeps things from being sent to another process, or None."""
    try:
        pickle.dumps(things)
    except Exception as error:
        return error
    return None
