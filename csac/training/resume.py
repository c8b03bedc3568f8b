"""Resuming and forking runs: which changes are refused, which are allowed, and what is rolled back."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from csac.algorithms import ALGORITHMS
from csac.record.config import differences
from csac.record.files import TEMPORARY, write_atomically
from csac.record.manifest import Continuation, Manifest, Origin
from csac.record.run import TABLES, RunDirectory, now
from csac.record.sets import RunSet, split_step
from csac.record.tables import continues
from csac.tasks.perturbations import continued, perturbations_of
from csac.training.checkpoint import (
    REPLAY,
    Checkpoint,
    Damaged,
    checkpoint_of,
    newest_sound,
    prune,
    steps_in,
    write_folder,
)
from csac.training.learner import incompatibility
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.record.config import RunConfig
    from csac.training.config import TrainOptions
    from csac.types import Algorithm, Spec

# Hyperparameters that a checkpoint's networks and optimisers depend on.
_KINDS = ("activation", "layer_norm")
_LEARNT_WITH = (
    *("normalise_observations", "normalise_rewards", "learning_rate_schedule", "critic_normalisation"),
    *(f"{network}{kind}" for network in ("", "actor_", "critic_") for kind in _KINDS),
)

# The fields of the configuration that may not differ in a fork, and the only ones that may when a run is resumed.
_SAME_IN_FORKS = ("events", "environments", "hindsight")
_MAY_DIFFER = ("steps", "device", "checkpoint_interval", "keep_checkpoints")


class ResumePoint(NamedTuple):
    """Where a run resumes: its checkpoint, or None for its beginning, and notes for the user."""

    checkpoint: Checkpoint | None
    notes: list[str]

    @property
    def step(self) -> int:
        """The step of the checkpoint, or 0 for the beginning."""
        return self.checkpoint.step if self.checkpoint else 0


def refuse_differences(run: RunDirectory, wanted: RunConfig, has_schedule: bool) -> None:
    """Raise InputError, with what differs, if `wanted` is not a continuation of `run`."""
    before = run.config
    old, new = _fixed(before), _fixed(wanted)
    if before.algorithm != wanted.algorithm:  # their hyperparameters are not comparable
        old, new = {"algorithm": before.algorithm}, {"algorithm": wanted.algorithm}
    if found := differences(old, new):
        advice = f"choose another directory, or resume it as it was: csac resume {run.path}"
        raise InputError(f"config differs from the saved run {run.path}: {'; '.join(found)}; {advice}")
    if wanted.steps < before.steps:
        raise InputError(f"{run.path} is a run of {before.steps:,} steps: steps={wanted.steps:,} would shorten it")
    if wanted.steps > before.steps and has_schedule:
        reason = "its learning rate has a schedule that ends there: train a new run"
        raise InputError(f"{run.path} cannot go beyond {before.steps:,} steps: {reason}")


def refuse_mixed(config: RunConfig, runs: Sequence[RunDirectory]) -> None:
    """Raise InputError if a set's runs differ from this configuration in more than seeds and steps."""
    for run in runs:
        refuse_differences(run, replace(config, seed=run.seed, steps=run.config.steps), has_schedule=False)


def roll_back(runs: Sequence[RunDirectory]) -> list[ResumePoint]:
    """Roll the runs of a program back to their newest common sound checkpoint, or to their beginning.

    Raises InputError if no checkpoint is sound, or if there are results but no checkpoint to resume from.
    """
    for run in runs:
        _remove_unfinished(run)
    points = [find_resume_point(run) for run in runs]
    while len({point.step for point in points}) > 1:
        until = min(point.step for point in points)
        pairs = zip(runs, points, strict=True)
        points = [find_resume_point(run, until) if point.step > until else point for run, point in pairs]
    for run, point in zip(runs, points, strict=True):
        point.notes.extend(_restore(run, point))
    return points


def find_resume_point(run: RunDirectory, until: int | None = None) -> ResumePoint:
    """Return a run's newest sound checkpoint, of step `until` at most, or its beginning.

    Raises InputError if no checkpoint is sound, or if the run cannot restart from the beginning.
    """
    checkpoint, complaints = newest_sound(run.checkpoints, until)
    if checkpoint is None and complaints:
        raise InputError(f"no checkpoint of {run.path} is sound ({'; '.join(complaints)}): restore one, or train anew")
    if checkpoint is None and run.manifest.forked_from:
        raise InputError(f"{run.path} was stopped before its first checkpoint: repeat its command in a new directory")
    results_are_final = run.manifest.state == "finished" or not run.config.checkpoint_interval
    if checkpoint is None and results_are_final and any(len(run.rows(table)) for table in TABLES):
        raise InputError(f"{run.path} has results and no checkpoint to go on from: train in another directory")
    return ResumePoint(checkpoint, [f"warning: {text}; an earlier checkpoint is used" for text in complaints])


def can_resume(run: RunDirectory) -> bool:
    """Return whether `find_resume_point` finds one."""
    with suppress(InputError):
        return bool(find_resume_point(run))
    return False


def _restore(run: RunDirectory, point: ResumePoint) -> list[str]:
    """Restore the tables and the best policy from a checkpoint; return a warning for each that was damaged."""
    checkpoint, notes = point.checkpoint, []
    if checkpoint:
        prune(run.checkpoints, 0, newest=checkpoint.step)
    for step in steps_in(run.checkpoints) if not checkpoint else ():  # of seeds without a common one
        shutil.rmtree(run.checkpoints / f"step_{step}")
    for table in TABLES:
        path = run.table(table)
        if not checkpoint or path.name not in checkpoint.files:
            path.unlink(missing_ok=True)
            continue
        content = checkpoint.read(path.name)
        if not (path.is_file() and continues(path.read_bytes(), content)):
            notes.append(f"warning: {path} had changed since the checkpoint; it is restored")
        write_atomically(path, content)
    best = run.policy_file("best")
    try:
        if checkpoint and best.name in checkpoint.files:
            run.policies.mkdir(exist_ok=True)
            write_atomically(best, checkpoint.read(best.name))
        else:
            best.unlink(missing_ok=True)
    except Damaged as error:
        notes.append(f"warning: {error}; the best policy is one of later evaluations")
        best.unlink(missing_ok=True)
    return notes


def _remove_unfinished(run: RunDirectory) -> None:
    """Remove the files that a process was writing when it was killed."""
    for folder in (run.path, run.policies, run.checkpoints, run.checkpoints / REPLAY):
        for path in folder.glob(TEMPORARY):
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def continuation(manifest: Manifest, current: Manifest, point: ResumePoint) -> tuple[Continuation, list[str]]:
    """Return the entry of a resume in the manifest's history, and the lines for the user."""
    changes = machine_changes(manifest, current)
    lines = [*point.notes, f"resuming at step {point.step:,}" if point.step else "no checkpoint yet: starting anew"]
    if changes:
        lines.append(f"note: not bit for bit the same from here on: {' and '.join(changes)}")
    restarts = bool(point.step and manifest.restarts_episode)
    if restarts:
        lines.append("note: the episode in progress restarts: its environment cannot be saved")
    exact = not (changes or restarts)
    previous = {
        "steps": manifest.config.steps,
        "machine": vars(manifest.machine),
        "versions": manifest.versions,
        "commit": manifest.commit,
    }
    return Continuation(now(), point.step, exact, tuple(point.notes), current.command, previous), lines


def record_inexact(run: RunDirectory, note: str) -> None:
    """Record in the manifest why the resume in progress is not exact; the start of a fork is not a resume."""
    if run.manifest.history:
        *before, entry = run.manifest.history
        entry = replace(entry, exact=False, notes=(*entry.notes, note))
        run.update_manifest(history=(*before, entry))


def machine_changes(before: Manifest, current: Manifest) -> list[str]:
    """Return which of the things that affect the last bits of a run's numbers have changed."""
    pairs: dict[str, tuple[Any, Any]] = {
        "processor": (before.machine.processor, current.machine.processor),
        "number of cores": (before.machine.cores, current.machine.cores),
        "GPU": (before.machine.gpu, current.machine.gpu),
        "XLA_FLAGS": (before.machine.xla_flags, current.machine.xla_flags),
        "precision of products": (before.machine.matmul_precision, current.machine.matmul_precision),
        "number of seeds in the program": (len(before.program), len(current.program)),
        "commit of csac": (before.commit, current.commit),
    }
    for package in sorted(before.versions.keys() | current.versions.keys()):
        pairs[f"version of {package}"] = (before.versions.get(package), current.versions.get(package))
    return [f"the {name} was {old} and is {new}" for name, (old, new) in pairs.items() if old != new]


def fork_options(run: RunDirectory, options: TrainOptions) -> TrainOptions:
    """Return the options to resume existing forks with, without their sources: these may be gone or have trained on."""
    config, origin, given = run.config, run.manifest.forked_from, options.get("perturbations")
    planned: Any = config.perturbations
    if given is not None and origin:
        planned = continued(perturbations_of(planned), perturbations_of(given), origin.step)
    events = config.events if options.get("events") is None else options.get("events")
    return {**options, "perturbations": planned, "events": events, "demonstrations": config.demonstrations}


class Source(NamedTuple):
    """Checkpoints of one step, one for each seed, from which new runs are forked."""

    path: Path
    runs: dict[int, RunDirectory]
    checkpoints: dict[int, Checkpoint]
    step: int

    @classmethod
    def find(cls, where: str | Path, seeds: Sequence[int]) -> Source:
        """Return the checkpoints at `DIRECTORY` (the newest) or `DIRECTORY@STEP`, of a set or of one run.

        Raises InputError if there is no such run, seed or checkpoint, or if it is damaged.
        """
        name, step = split_step(where)
        found = RunSet.open(name)
        runs = {seed: found.run(seed) for seed in seeds}
        if step is None:
            step = min(max(steps_in(run.checkpoints), default=0) for run in runs.values())
        checkpoints = {seed: checkpoint_of(run.checkpoints, step) for seed, run in runs.items()}
        return cls(found.path, runs, checkpoints, step)

    def perturbations(self, seed: int, given: Any) -> tuple[str, ...]:
        """Return the source's perturbations before the checkpoint and those `given`, or with None all the source's."""
        planned = perturbations_of(self.runs[seed].config.perturbations)
        return tuple(map(str, planned if given is None else continued(planned, perturbations_of(given), self.step)))

    def refuse_incompatible(self, wanted: RunConfig, has_schedule: bool) -> None:
        """Raise InputError if a new run of this configuration cannot start from its checkpoint."""
        before = self.runs[wanted.seed].config
        if before.algorithm != wanted.algorithm:
            raise InputError(f"{self.path} does not fit: its algorithm is {before.algorithm}, not {wanted.algorithm}")
        old, new = ({name: getattr(one, name) for name in _SAME_IN_FORKS} for one in (before, wanted))
        found = differences(old, new)
        old, new = before.hyperparameters, wanted.hyperparameters
        others = [name for name in _LEARNT_WITH if name in old and old[name] != new.get(name)]
        found += [f"its networks have learnt with {name} {old[name]}" for name in others]
        if has_schedule and wanted.steps != before.steps and not others:
            found.append(f"its learning rate has a schedule over {before.steps:,} steps: give as many")
        kept, size = old.get("replay_size", 0), new.get("replay_size", 0)
        if kept < self.checkpoints[wanted.seed].transitions[1] and kept < size:
            found.append(f"its replay kept {kept:,} transitions: replay_size cannot be {size:,}")
        if found:
            raise InputError(f"{self.path} does not fit: {'; '.join(found)}")
        if wanted.steps <= self.step:
            raise InputError(f"steps counts from the beginning: give more than the {self.step:,} made already")

    def refuse_incompatible_state(self, algorithm: Algorithm, spec: Spec, wanted: RunConfig) -> None:
        """Raise InputError if the checkpoint's learned state does not fit the new run's algorithm and task."""
        learnt = self.checkpoints[wanted.seed].state().part("learner")
        if problem := incompatibility(algorithm, spec, wanted.steps, learnt):
            found = [*differences(_fixed(self.runs[wanted.seed].config), _fixed(wanted)), problem]
            raise InputError(f"{self.path} does not fit: {'; '.join(found)}")

    def forked_manifest(self, manifest: Manifest) -> Manifest:
        """Return the manifest of a new run, with its origin."""
        before = self.runs[manifest.config.seed]
        changes = tuple(differences(_fixed(before.config), _fixed(manifest.config)))
        earlier = before.manifest.forked_from
        origin = Origin(str(before.path), self.step, changes, (*earlier.earlier, *earlier.changes) if earlier else ())
        is_other = origin.changed("task ", "environment_arguments")
        origin = replace(origin, task_since=self.step if is_other else earlier.task_since if earlier else 0)
        restarts = before.manifest.restarts_episode or origin.changed("task ")
        return replace(manifest, forked_from=origin, restarts_episode=restarts)

    def copy_to(self, run: RunDirectory) -> None:
        """Copy the tables and the checkpoint to a new run; transitions are hard-linked if the file system can."""
        checkpoint = self.checkpoints[run.seed]
        (run.checkpoints / REPLAY).mkdir(parents=True, exist_ok=True)
        contents: dict[str, bytes] = {}
        for name in checkpoint.files:
            if name.startswith(f"{REPLAY}/"):
                try:
                    os.link(checkpoint.folder / name, run.checkpoints / name)
                except OSError:  # the file system has no hard links
                    write_atomically(run.checkpoints / name, checkpoint.read(name))
                continue
            contents[name] = checkpoint.read(name)
            if name.endswith(".csv"):
                write_atomically(run.path / name, contents[name])
        folder = checkpoint.folder / f"step_{checkpoint.step}"
        contents["checkpoint.json"] = (folder / "checkpoint.json").read_bytes()
        write_folder(run.checkpoints / folder.name, contents)


def _fixed(config: RunConfig) -> dict[str, Any]:
    """Return the fields that must not differ; a hyperparameter newer than the run has its default."""
    fixed = {name: value for name, value in asdict(config).items() if name not in _MAY_DIFFER}
    if config.algorithm in ALGORITHMS:
        fixed["hyperparameters"] = asdict(ALGORITHMS[config.algorithm]()) | config.hyperparameters
    return fixed
