"""Train the unfinished runs of a study, in processes on this machine or on a Ray cluster."""

from __future__ import annotations

import shutil
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from csac.console.waiting import progress_shown
from csac.processes import cores_to_use
from csac.record.manifest import Manifest
from csac.record.rendering import number
from csac.record.run import RunDirectory, is_run
from csac.record.statistics import last_evaluations
from csac.tasks.environment import Environment
from csac.tasks.perturbations import perturbations_of
from csac.tasks.trust import remember
from csac.training.config import algorithm_of
from csac.training.program import Program, threads_of
from csac.training.resume import find_resume_point
from csac.training.signals import stop_requested
from csac.training.supervisor import supervise
from csac.training.watch import Watcher

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from rich.console import Console

    from csac.record.config import RunConfig
    from csac.studies.ray import Cluster
    from csac.studies.study import StudyRun


class Execution(NamedTuple):
    """Options for executing the runs of a study."""

    workers: int = 1
    """Number of runs that train in parallel on this machine."""
    cluster: Cluster | None = None
    """The Ray cluster to train on instead."""
    wandb: bool = False
    keep_checkpoints: bool = False
    command: str | None = None


def run_study(runs: Sequence[StudyRun], directory: Path, execution: Execution, console: Console) -> int | None:
    """Train the unfinished runs. Return the signal that stopped them, if any; every run is then saved."""
    directory = directory.absolute()
    waiting = {directory / run.folder: run for run in runs if not run.is_over(directory)}
    for path in [path for path in waiting if is_run(path) and RunDirectory.open(path).state == "running"]:
        console.print(f"{waiting.pop(path).name}: another process trains it", soft_wrap=True)
    if execution.cluster is None:  # the nodes of a cluster may have tasks that this machine lacks
        try_tasks(run.config for run in waiting.values())
    for path, run in waiting.items():  # before any is changed
        if is_run(path) and run.config.steps > (existing := RunDirectory.open(path)).config.steps:
            find_resume_point(existing)
    programs = [_program(path, run, execution) for path, run in waiting.items()]
    try:
        with (
            stop_requested(lambda text: console.print(text)) as request,
            progress_shown(console, "training", "steps") as show,
        ):
            progress = Progress(waiting, console, show)
            if programs and execution.cluster:
                execution.cluster.run(programs, progress.of, request.is_set)
            elif programs:
                turns = max(1, cores_to_use() // programs[0].threads)
                supervise(programs, progress.of, request.is_set, execution.workers, turns)
    finally:  # also of a full disk: the replay buffer takes most of the space
        for path in waiting if not execution.keep_checkpoints else ():
            if RunDirectory.open(path).manifest.state == "finished":
                shutil.rmtree(path / "checkpoint", ignore_errors=True)
    return request.received[0] if request.received else None


def try_tasks(configs: Iterable[RunConfig]) -> None:
    """Make each task once and apply its perturbations, so that mistakes are reported before anything is written."""
    parts = [(config.task, config.environment_arguments, config.perturbations) for config in configs]
    for task, arguments, perturbations in {str(one): one for one in parts}.values():
        with closing(Environment(task, arguments)) as environment:
            remember(task)
            for change in perturbations_of(perturbations):
                environment.perturb({change.kind: change.value})


def _program(path: Path, run: StudyRun, execution: Execution) -> Program:
    """Return the program that trains a run, after creating its directory or updating its configuration."""
    cores = execution.cluster.cores if execution.cluster else cores_to_use()
    threads = cores if execution.cluster else max(1, cores // execution.workers)
    if is_run(path):
        existing = RunDirectory.open(path)
        if run.config != existing.config:
            # A run that is over has to look unfinished until its turn comes, which a signal may prevent.
            state = existing.manifest.state
            with existing.locked():
                existing.update_manifest(config=run.config, state="interrupted" if state == "finished" else state)
        threads = threads_of([existing], cores, threads)
    else:
        RunDirectory.create(path, Manifest(config=run.config, program=(run.config.seed,)))
    return Program(
        (path,), algorithm_of(run.config), run.config.task, threads, wandb=execution.wandb, command=execution.command
    )


class Progress:
    """Pass the steps done by a study's runs, and their total, to `show`; print a line for each run that ends."""

    def __init__(self, runs: Mapping[Path, StudyRun], console: Console, show: Callable[[int, int], None]) -> None:
        self.runs, self.console, self._show = runs, console, show
        self.done = {path: RunDirectory.open(path).manifest.last_checkpoint for path in runs}
        self.over: set[Path] = set()
        self._before = sum(self.done.values())
        self._total = sum(run.config.steps for run in runs.values()) - self._before

    def of(self, program: Program) -> RunProgress:
        """Return the watcher of a program."""
        return RunProgress(self, program.directories[0])

    def advanced(self, path: Path, step: int) -> None:
        """Record how many steps a run has made."""
        self.done[path] = step
        self._show(sum(self.done.values()) - self._before, self._total)
        if step >= self.runs[path].config.steps and path not in self.over:
            self.ended(path, "finished")

    def ended(self, path: Path, outcome: str) -> None:
        """Record that a run is over, and print its outcome."""
        self.over.add(path)
        returns = last_evaluations(RunDirectory.open(path).evaluations, points=1)
        last = f", last return {number(next(iter(returns.values())))}" if returns else ""
        text = f"{len(self.over)} of {len(self.runs)}: {self.runs[path].name}: {outcome}{last}"
        self.console.print(text, soft_wrap=True)


@dataclass(frozen=True)
class RunProgress(Watcher):
    """Pass the events of one run to the `Progress` of its study."""

    study: Progress
    path: Path

    def progress(self, steps: Mapping[int, int]) -> None:
        """Record how many steps the run has made."""
        for step in steps.values():
            self.study.advanced(self.path, step)

    def failed(self, seed: int, step: int, reason: str) -> None:
        """Record that the run failed."""
        self.study.ended(self.path, f"failed at step {step:,}: {reason}")

    def note(self, text: str) -> None:
        """Print a line about the run."""
        self.study.console.print(f"{self.study.runs[self.path].name}: {text}", soft_wrap=True)
