"""`train` and `resume`, which train seeds and return their runs. `csac train` and `csac resume` only call these."""

from __future__ import annotations

import dataclasses
import os
import shutil
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from csac.algorithms.hyperparameters import without_effect
from csac.checks import check_flag, check_path
from csac.deploy.choosing import TrainedRuns
from csac.processes import cores_to_use, end_if_unguarded
from csac.record.files import temporary_path
from csac.record.manifest import Manifest
from csac.record.run import RunDirectory, StorageFailure, is_run
from csac.record.sets import RunSet, new_set_directory, run_path
from csac.record.wandb import import_wandb
from csac.tasks.trust import named_task
from csac.training.callbacks import Callbacks
from csac.training.compilation import tidy_programs
from csac.training.config import algorithm_of, check_algorithm, make_configs, seed_range
from csac.training.devices import begin_with, choose_device
from csac.training.program import Program, choose_groups, groups_ahead, memory_needed, programs_of
from csac.training.resume import Source, find_resume_point, fork_options, refuse_differences, refuse_mixed
from csac.training.running import train_program
from csac.training.signals import Interrupted, stop_requested
from csac.training.supervisor import record_failure, supervise
from csac.training.watch import Watch, draw_curve
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from typing_extensions import Unpack

    from csac.record.config import RunConfig
    from csac.tasks.registry import Task
    from csac.training.callbacks import Callback
    from csac.training.config import TrainOptions
    from csac.training.demonstrations import Demonstrations
    from csac.types import Algorithm

    OnEvaluation = Callable[[int, dict[int, float]], Any]
    StopWhen = Callable[[int, dict[int, float]], bool]

PROCESSES_PER_CORE = 4  # more would only cost memory: further seeds wait


def train(
    algorithm: Algorithm,
    task: Task,
    *,
    seeds: int = 1,
    first_seed: int = 0,
    directory: str | Path | None = None,
    resume: bool = False,
    start_from: str | Path | None = None,
    seeds_per_process: int | None = None,
    evaluation_processes: int | None = None,
    environment_processes: int | None = None,
    tensorboard: bool = True,
    wandb: bool | str = False,
    progress: bool = True,
    command: str | None = None,
    callbacks: Sequence[Callback] = (),
    on_evaluation: OnEvaluation | None = None,
    stop_when: StopWhen | None = None,
    **options: Unpack[TrainOptions],
) -> TrainedRuns:
    """Train independent seeds of an algorithm on a task and return their runs.

    Several seeds train in separate processes, so a script needs the usual `if __name__ == "__main__":` guard.

    Args:
        algorithm: a hyperparameter dataclass such as `CSAC()`.
        task: a Gymnasium id, `module:Id`, or a callable that makes an environment.
        seeds: number of independent seeds.
        first_seed: the first seed; the others are numbered consecutively from it.
        directory: the folder of the runs, each in `seed-<k>`; by default `runs/<task>/<algorithm>/<date-time>`.
        resume: resume the runs that exist in `directory`, and start the others.
        start_from: `DIRECTORY` or `DIRECTORY@STEP` of a set or a run: start from copies of the seeds' checkpoints.
        seeds_per_process: seeds that share one program; by default 1 on a CPU, and a few on a GPU. If all of them share
            one, they train in this process.
        evaluation_processes: processes in which a program evaluates while training goes on; 0 pauses training to
            evaluate, and so does None if no core is free, if a callback receives evaluations (such as `stop_when`), or
            in a script without a guard. The numbers are the same.
        environment_processes: processes that step a program's environments, at most `environments`; 0 steps them in the
            training process, None chooses by what a step costs, 0 without a guard. The numbers are the same.
        tensorboard: whether to write TensorBoard files.
        wandb: whether to also log to Weights & Biases (the extra `wandb`), or the project to log to.
        progress: whether to show progress, as the command line does.
        command: the command line, for the manifest.
        callbacks: your own code (`csac.training.callbacks`), called in this process as training goes on.
        on_evaluation: called as `on_evaluation(step, {seed: mean return})` after each evaluation of a program's seeds.
        stop_when: called with the same arguments; those seeds end early, as finished, once it returns True.
        **options: what a run computes, as documented in `csac.record.config.RunConfig`: `steps`, `device`,
            `environments`, `evaluation_interval`, `evaluation_episodes`, `evaluation_environments`, `evaluation_seed`,
            `checkpoint_interval`, `keep_checkpoints`, `environment_arguments`, `perturbations`, `events`, `hindsight`;
            and `demonstrations`, with which the replay buffer starts (`docs/learning-options.md`).

    Raises:
        InputError: a mistake in the arguments, or a run that cannot resume; new runs that have not begun are removed.
        Interrupted: on SIGINT or SIGTERM, after everything was saved.
        StorageFailure: a run directory can no longer be written; it is as sound as if the run had been killed.
        CallbackFailure: one of your own functions raised; everything was saved.
    """
    end_if_unguarded()
    check_algorithm(algorithm)
    _check_arguments(resume, directory, wandb)
    watch = Watch(progress, Callbacks(callbacks, on_evaluation, stop_when))
    choose_device(options.get("device", "cpu"))
    place = None if directory is None else Path(os.path.abspath(directory))  # the task may chdir
    wanted = seed_range(seeds, first_seed)

    source = None
    if start_from is not None and resume and place and all(is_run(run_path(place, seed)) for seed in wanted):
        options = fork_options(RunDirectory.open(run_path(place, wanted[0])), options)
    elif start_from is not None:
        source = Source.find(start_from, wanted)
    configs, demonstrations, spec, task_notes = make_configs(algorithm, task, wanted, options, source)
    choose_device(configs[0].device)  # the task's module may have changed JAX's settings
    place = place or new_set_directory(configs[0].task, configs[0].algorithm)
    existing = _existing_runs(place, configs, resume, source, algorithm.cadence.has_schedule)
    if source:
        source.refuse_incompatible_state(algorithm, spec, configs[0])

    groups = choose_groups(wanted, existing, seeds_per_process, configs[0].device, task, algorithm)
    settings = evaluation_processes, environment_processes, tensorboard, wandb, watch.callbacks.interests, command
    template = Program((), algorithm, task, 1, *settings)
    directories = [[run_path(place, seed) for seed in group] for group in groups]
    programs = programs_of(template, directories, existing, configs[0])
    at_once = min(_workers(), len(groups_ahead(directories, existing, configs[0].steps)))
    notes = [memory_needed(programs, configs[0], spec, at_once), *task_notes]
    notes += [*_warmup_note(algorithm, configs[0]), *_effect_notes(algorithm)]
    if watch.callbacks.interests.evaluations and not configs[0].evaluation_interval:
        notes.append("note: evaluation_interval is 0: no callback receives evaluations, and none ends a run by them")

    runs = _create(place, configs, groups, existing, source, demonstrations)
    try:
        return _run(runs, programs, watch, notes)
    except InputError:  # so that the corrected call can use the directory
        _remove_unbegun(place, [run for run in runs.runs if run.seed not in existing])
        raise


def resume(
    directory: str | Path,
    *,
    steps: int | None = None,
    evaluation_processes: int | None = None,
    environment_processes: int | None = None,
    trust_task: bool = False,
    progress: bool = True,
    command: str | None = None,
    callbacks: Sequence[Callback] = (),
    on_evaluation: OnEvaluation | None = None,
    stop_when: StopWhen | None = None,
) -> TrainedRuns:
    """Resume a run, or every run of a set, from its newest checkpoint, with the settings in its manifest.

    `steps` makes the runs longer. `trust_task` lets the task, or a custom algorithm, import a module that nobody has
    named on this machine before (`csac.tasks.trust`); the other arguments are those of `train`.

    Raises:
        InputError: there is no such run, it cannot resume (the message says why), or its task is a Python function:
            then call `train` with it and `resume=True`.
        Interrupted, StorageFailure, CallbackFailure: as `train`.
    """
    end_if_unguarded()
    runs = TrainedRuns.open(directory)
    config = runs.config
    named_task(config, runs.path, trust_task, "call csac.train with it and resume=True")
    refuse_mixed(config, runs.runs)
    watch = Watch(progress, Callbacks(callbacks, on_evaluation, stop_when))
    choose_device(config.device)
    algorithm = algorithm_of(config, runs.path, trust_task)
    configs = [] if steps is None else [dataclasses.replace(run.config, steps=steps) for run in runs.runs]
    for run, config in zip(runs.runs, configs, strict=False):
        refuse_differences(run, config, algorithm.cadence.has_schedule)
    existing = {run.seed: run for run in runs.runs}
    groups = choose_groups(runs.seeds, existing, None, config.device, config.task)
    tensorboard = any(run.tensorboard.exists() for run in runs.runs)
    wandb = any((run.path / "wandb").exists() for run in runs.runs)
    settings = evaluation_processes, environment_processes, tensorboard, wandb, watch.callbacks.interests, command
    template = Program((), algorithm, config.task, 1, *settings)
    programs = programs_of(template, [[existing[seed].path for seed in group] for group in groups], existing, config)
    if configs:
        _set_configs(runs.runs, configs)
    return _run(runs, programs, watch, [])


def _check_arguments(resume: bool, directory: str | Path | None, wandb: bool | str) -> None:
    check_flag("resume", resume)
    if wandb:
        import_wandb()
    if directory is not None:
        check_path("directory", directory)
    elif resume:
        raise InputError("resume needs the `directory` of the runs (csac.resume(directory) does without a task)")


def _remove_unbegun(place: Path, runs: Sequence[RunDirectory]) -> None:
    """Remove the new runs that no process has begun, and their folder if nothing else is in it."""
    for run in runs:
        if RunDirectory.open(run.path).manifest.process is None:
            shutil.rmtree(run.path)
    with suppress(OSError):
        place.rmdir()


def _set_configs(runs: Sequence[RunDirectory], configs: Sequence[RunConfig]) -> None:
    """Give each run its new configuration. Raises InputError, before any is changed, if one cannot resume."""
    with ExitStack() as locks:
        for run in runs:
            locks.enter_context(run.locked())
            find_resume_point(run)
        for run, config in zip(runs, configs, strict=True):
            run.update_manifest(config=config)


def _existing_runs(
    place: Path, configs: Sequence[RunConfig], resume: bool, source: Source | None, has_schedule: bool
) -> dict[int, RunDirectory]:
    """Return the existing runs, to resume them. Raises InputError if they or the directory do not allow it."""
    existing = {}
    for config in configs:
        path = run_path(place, config.seed)
        if is_run(path):
            if not resume:
                raise InputError(f"{path} already holds a run: resume it, or leave the directory out for a new one")
            existing[config.seed] = run = RunDirectory.open(path)
            refuse_differences(run, config, has_schedule)
    known = (".", "seed-", "curve.png")
    unknown = [] if existing or not place.is_dir() else [p for p in place.iterdir() if not p.name.startswith(known)]
    if unknown or (place.exists() and not place.is_dir()):
        raise InputError(f"{place} is not empty and holds no set of runs: choose a new or an empty directory")
    if source:
        for config in configs:
            source.refuse_incompatible(config, has_schedule)
    refuse_mixed(configs[0], [RunDirectory.open(path) for path in sorted(place.glob("seed-*")) if is_run(path)])
    return existing


def _create(
    place: Path,
    configs: Sequence[RunConfig],
    groups: list[list[int]],
    existing: dict[int, RunDirectory],
    source: Source | None,
    demonstrations: Demonstrations | None,
) -> TrainedRuns:
    """Create the run of each configuration; give existing ones the settings that a resume may change, such as steps.

    New runs are created under temporary names and then renamed: a kill before that leaves none, rather than some or
    half of one. Raises InputError if an existing run is in use, or a directory cannot be written.
    """
    changed = [config for config in configs if config.seed in existing and config != existing[config.seed].config]
    _set_configs([existing[config.seed] for config in changed], changed)
    new = [config for config in configs if config.seed not in existing]
    temporary = {config.seed: temporary_path(run_path(place, config.seed)) for config in new}
    try:
        for config in new:
            program = next(group for group in groups if config.seed in group)
            manifest = Manifest(config=config, program=tuple(program))
            run = RunDirectory.create(temporary[config.seed], source.forked_manifest(manifest) if source else manifest)
            if source:
                source.copy_to(run)
            if demonstrations:
                demonstrations.write(run)
        for seed, path in temporary.items():
            RunDirectory.open(path).rename(run_path(place, seed))
    finally:
        for path in temporary.values():
            shutil.rmtree(path, ignore_errors=True)
    return TrainedRuns(place, [RunDirectory.open(run_path(place, config.seed)) for config in configs])


def _run(runs: TrainedRuns, programs: list[Program], watch: Watch, notes: list[str]) -> TrainedRuns:
    """Train every program that is not over, show progress, and draw the curve. Raises as `train`."""
    done = {run.path for run in runs.runs if watch.is_over(run)}
    programs = [program for program in programs if not done.issuperset(program.directories)]
    tidy_programs()
    watch.send("start", runs, notes)
    with ExitStack() as stack, stop_requested(watch.note) as request:
        stack.callback(watch.send, "close")

        def should_stop() -> bool:
            return request.is_set() or watch.callbacks.failure is not None

        if len(programs) == 1:
            begin_with(programs[0].threads)
            try:
                train_program(programs[0], watch, should_stop)
            except (InputError, StorageFailure):
                raise
            except Exception as error:
                record_failure(programs[0], watch, error)
        elif programs:
            turns = max(1, cores_to_use() // programs[0].threads) if runs.config.device == "cpu" else None
            supervise(programs, lambda _: watch, should_stop, _workers(), turns)
        runs = TrainedRuns(runs.path, [RunDirectory.open(run.path) for run in runs.runs])
        draw_curve(RunSet.open(runs.path), watch.note)
        watch.send("finish", runs)
    if failure := watch.callbacks.failure:
        raise failure
    if request.is_set() and any(run.manifest.state in ("running", "interrupted") for run in runs.runs):
        raise Interrupted(runs, request.received[0])
    return runs


def _workers() -> int:
    return PROCESSES_PER_CORE * cores_to_use()


def _warmup_note(algorithm: Algorithm, config: RunConfig) -> list[str]:
    first = algorithm.cadence.side_by_side(config.environments).first_update
    if config.steps >= first:
        return []
    return [f"note: no updates: steps ({config.steps:,}) < {first:,}, where the first one comes"]


def _effect_notes(algorithm: Algorithm) -> list[str]:
    idle = without_effect(algorithm).items()
    changed = [(name, why) for name, why in idle if getattr(algorithm, name) != getattr(type(algorithm), name, None)]
    return [f"note: {name} has no effect with {why}" for name, why in changed]
