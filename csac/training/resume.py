"""Resuming a run or forking another from its checkpoint: what is refused, what may change, what is rolled back."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

from csac.deploy.contract import Contract, write_json
from csac.record.manifest import OTHER_TASK, Continuation, Origin, differences
from csac.record.run import RunDirectory, Table, now
from csac.tasks.perturbations import continued, perturbations_of
from csac.training.checkpoint import Checkpoint, Checkpoints, newest_sound, sound_at, steps_in, taken_back
from csac.training.restore import copy, restore
from csac.types import InputError, Snapshot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from csac.record.manifest import Manifest
    from csac.tasks.perturbations import Perturbation

# What a run cannot change: with any other value it would be another run.
_FIXED = (
    "task",
    "environment_arguments",
    "perturbations",
    "algorithm",
    "hyperparameters",
    "seeds",
    "evaluation",
    "events",
)


class Restart(NamedTuple):
    """Where a run goes on: the step of its checkpoint (0 is its beginning), and who had failed by then."""

    step: int
    failures: dict[int, str]
    complaints: list[str]  # what was wrong with newer checkpoints, and what was mended
    pinned: list[int]  # steps of checkpoints to keep for good
    groups: Sequence[Sequence[int]] = ()  # the seeds that each process had trained together by then

    def parts(self, groups: Sequence[Sequence[int]]) -> list[list[int]]:
        """Return what is left of these groups to be trained, without the seeds that had failed.

        A group that is as it was keeps them: they are at rest in its files, and the numbers of the others depend on
        them at rounding level.
        """
        parts = []
        for group in map(list, groups):
            living = [seed for seed in group if seed not in self.failures]
            if living:
                parts.append(group if group in self.groups else living)
        return parts

    def notes(self, before: Manifest, now: Manifest) -> list[str]:
        """Return what the user should know of this continuation, a line each."""
        lines = [f"warning: {complaint}" for complaint in self.complaints]
        lines.append(f"going on from step {self.step:,}" if self.step else "no checkpoint yet: it begins anew")
        if changes := _machine_changes(before, now):
            lines.append(f"note: not the same to the last bit from here on, because {' and '.join(changes)}")
        if before.inexact_seeds:
            several = "s" * (len(before.inexact_seeds) > 1)
            seeds = f"seed{several} {', '.join(map(str, before.inexact_seeds))} restart{'' if several else 's'}"
            lines.append(f"note: {seeds} the episode in progress, which the checkpoint could not hold")
        return lines

    def continuation(self, before: Manifest, wanted: Manifest) -> Continuation:
        """Return what the manifest remembers of this."""
        exact = not (_machine_changes(before, wanted) or before.inexact_seeds)
        previous = {
            "steps": before.steps,
            "machine": vars(before.machine),
            "versions": before.versions,
            "commit": before.commit,
            "groups": before.groups,
        }
        return Continuation(now(), self.step, exact, tuple(self.complaints), wanted.command, previous)


BEGINNING = Restart(0, {}, [], [])


def refuse_differences(run: RunDirectory, wanted: Manifest, has_schedule: bool, defaults: Mapping[str, Any]) -> None:
    """Raise InputError, with what differs, where `wanted` is not a continuation of `run`.

    `defaults` are those of the hyperparameters: what a run did that was made before there was one of them.
    """
    made, asked = _fixed(run.manifest, defaults), _fixed(wanted, defaults)
    if made["algorithm"] != asked["algorithm"]:  # whose hyperparameters are others
        made, asked = ({"algorithm": each["algorithm"]} for each in (made, asked))
    if found := differences(made, asked):
        advice = f"Choose another directory; 'csac resume {run.path}' goes on as it was"
        raise InputError(f"{run.path} was trained otherwise: {'; '.join(found)}. {advice}")
    before = run.manifest.steps
    if wanted.steps < before:
        raise InputError(
            f"{run.path} is a run of {before:,} steps, which {wanted.steps:,} would shorten: give at least as many"
        )
    if wanted.steps > before and has_schedule:
        raise InputError(
            f"{run.path} cannot go on beyond its {before:,} steps: its learning rate was planned for them (a schedule)"
        )


def planned_perturbations(
    given: str | Perturbation | Iterable[str | Perturbation] | None,
    existing: RunDirectory | None,
    source: Source | None,
) -> tuple[Perturbation, ...]:
    """Return the perturbations of a run together with those that it was forked after.

    Args:
        given: those asked for now; None for those that were planned where it goes on or begins.
        existing: the run that goes on, if there is one.
        source: where a new run begins, if not anew.

    Raises:
        InputError: one of those asked for cannot be, or lies before the step where the run was or is forked.
    """
    asked = perturbations_of(() if given is None else given)
    if existing:
        origin = existing.manifest.forked_from
        before, begin = existing.manifest, origin.step if origin else 0
    elif source:
        before, begin = source.run.manifest, source.checkpoint.step
    else:
        return asked
    planned = perturbations_of(before.perturbations)
    return planned if given is None else continued(planned, asked, begin)


def roll_back(run: RunDirectory) -> Restart:
    """Bring a run's files back to its newest sound checkpoint, or to its beginning, and say where that is.

    Raises:
        InputError: rows are missing that the checkpoint counts on, all its checkpoints are damaged, or it has rows
            and no checkpoint, so that going on would be to begin anew.
    """
    checkpoint, complaints = newest_sound(run.checkpoints)
    if checkpoint is None and complaints:
        advice = "restore one from a copy, or train in another directory"
        raise InputError(f"no checkpoint of {run.path} is sound ({'; '.join(complaints)}): {advice}")
    if checkpoint is None and run.manifest.forked_from:
        raise InputError(
            f"{run.path} was stopped before its first checkpoint: repeat its command, --from included, with --resume"
        )
    if checkpoint is None and _would_lose_results(run):
        raise InputError(
            f"{run.path} has results and no checkpoint to go on from, and would begin anew: train in another directory"
        )
    complaints = [f"{complaint}; an earlier checkpoint is used" for complaint in complaints]
    complaints += restore(run.path, checkpoint)
    for unfinished in [*run.path.glob(".*.*"), *run.path.glob("policy/.*.*")]:
        if not unfinished.is_dir():
            unfinished.unlink()
    if checkpoint is None:
        Checkpoints(run.checkpoints, run.manifest.checkpoints.keep).discard_after(0)  # what a first one left unfinished
        return BEGINNING
    step, pinned = checkpoint.step, checkpoint.values["pinned"]
    Checkpoints(run.checkpoints, run.manifest.checkpoints.keep, pinned).discard_after(step)
    failures = {int(seed): reason for seed, reason in checkpoint.values["failures"].items()}
    return Restart(step, failures, complaints, pinned, checkpoint.values["groups"])


class Source(NamedTuple):
    """A checkpoint of a run that another run begins with."""

    run: RunDirectory
    checkpoint: Checkpoint

    @classmethod
    def find(cls, where: str | Path) -> Source:
        """Return the checkpoint at `DIRECTORY` (its newest sound one) or `DIRECTORY@STEP`.

        Raises:
            InputError: no such run or checkpoint, or a damaged one.
        """
        name, at, step = str(where).rpartition("@")
        if at and not os.path.exists(where):
            run = RunDirectory.open(name)
            if not _is_step(step):
                raise InputError(f"{where}: {step!r} is not a step; write DIRECTORY@STEP")
            return cls(run, sound_at(run.checkpoints, int(step)))
        run = RunDirectory.open(where)
        checkpoint, complaints = newest_sound(run.checkpoints)
        if checkpoint is None:
            raise InputError("; ".join(complaints) or f"{run.path} has no checkpoint yet")
        return cls(run, checkpoint)

    def refuse_misfit(
        self,
        wanted: Manifest,
        has_schedule: bool,
        defaults: Mapping[str, Any],
        misfit: Callable[[Snapshot], str | None],
    ) -> None:
        """Raise InputError where the new run cannot begin with this checkpoint; `misfit` says why its arrays do not.

        `defaults` are as in `refuse_differences`.
        """
        before = self.run.manifest
        names = ("algorithm", "events")  # of whose tables the new run's are a continuation
        found = differences({name: getattr(before, name) for name in names}, {n: getattr(wanted, n) for n in names})
        missing = sorted(set(wanted.seeds) - set(before.seeds))
        living = self._living(wanted)
        if missing:
            found.append(f"it has no seeds {', '.join(map(str, missing))}")
        elif not living:
            found.append(f"every seed asked for had failed by step {self.checkpoint.step}; begin with an earlier step")
        if not found and _normalises(before, defaults) != _normalises(wanted, defaults):
            found.append("its networks have learnt what they see with the other choice of normalise_observations")
        if not found and has_schedule and wanted.steps != before.steps:
            found.append(
                f"it was planned for {before.steps:,} steps, and its learning rate with it (a schedule): give as many"
            )
        if not found:
            with taken_back(self.checkpoint):
                problem = misfit(self.checkpoint.seed(living[0]).part("learner"))
                tasks = f" ({before.task}, and {wanted.task} now)" if before.task != wanted.task else ""
                found += [problem + tasks] if problem else []
        kept, size = (m.hyperparameters.get("replay_size", 0) for m in (before, wanted))
        if kept < self.checkpoint.step and kept < size:
            found.append(f"its replay kept {kept:,} transitions and no others, so replay_size cannot be {size:,}")
        if found:
            raise InputError(f"{self.run.path} does not fit: {'; '.join(found)}")
        if wanted.steps <= self.checkpoint.step:
            raise InputError(
                f"steps counts from the beginning: give more than the {self.checkpoint.step:,} made already"
            )

    def described(self, wanted: Manifest, defaults: Mapping[str, Any]) -> Origin:
        """Return what the manifest says of where the new run began, and of what is different in it."""
        changes = differences(_fixed(self.run.manifest, defaults), _fixed(wanted, defaults))
        origin, before = Origin(os.path.abspath(self.run.path), self.checkpoint.step, tuple(changes)), self.run.manifest
        if before.forked_from and before.forked_from.step == origin.step and not origin.has_other_task:
            # The checkpoint with which that run began: its episodes are those of the task before.
            of_task = [text for text in before.forked_from.changes if text.startswith(OTHER_TASK)]
            return replace(origin, changes=(*of_task, *changes))
        return origin

    def begun(self, wanted: Manifest, defaults: Mapping[str, Any]) -> Manifest:
        """Return the manifest with which the new run is made: which seeds begin their episode anew is known by now."""
        origin = self.described(wanted, defaults)
        anew = self._living(wanted) if origin.has_other_task else self.run.manifest.inexact_seeds
        inexact = tuple(seed for seed in wanted.seeds if seed in anew)
        return replace(wanted, forked_from=origin, inexact_seeds=inexact)

    def _living(self, wanted: Manifest) -> list[int]:
        return [seed for seed in wanted.seeds if str(seed) not in self.checkpoint.values["failures"]]

    def copy_to(self, run: RunDirectory, keep: int) -> None:
        """Give a new run the tables up to the checkpoint, and the checkpoint."""
        files = copy(self.checkpoint, run.path, run.manifest.seeds)
        failures = self.checkpoint.values["failures"].items()
        values = {**self.checkpoint.values, "failures": {k: v for k, v in failures if int(k) in run.manifest.seeds}}
        if self.run.contract.exists():
            run.contract.parent.mkdir(exist_ok=True)
            write_json(run.contract, Contract.load(self.run.contract).fields())  # without the checksums of its policies
        Checkpoints(run.checkpoints, keep).commit(self.checkpoint.step, files, values)


def refuse_other_source(run: RunDirectory, where: str | Path) -> None:
    """Raise InputError where a run that goes on did not begin with `where`, which may have trained on or be gone."""
    origin = run.manifest.forked_from
    if origin is None:
        raise InputError(f"{run.path} goes on and began with no other run: leave {where} out, or train elsewhere")
    name, _, step = str(where).rpartition("@")
    places = [where, *([name] if name and _is_step(step) and int(step) == origin.step else [])]
    if Path(origin.directory).resolve() not in [Path(place).resolve() for place in places]:
        began = f"{origin.directory}@{origin.step}"
        raise InputError(f"{run.path} goes on and began with {began}: leave {where} out, or train elsewhere")


def can_go_on(run: RunDirectory) -> bool:
    """Whether there is a checkpoint to go on from, or nothing to lose where the run begins anew."""
    return bool(steps_in(run.checkpoints)) or not (run.manifest.forked_from or _would_lose_results(run))


def _would_lose_results(run: RunDirectory) -> bool:
    """Whether a run without a checkpoint has rows that it would not make again by itself.

    One that was killed before its first checkpoint was due makes the very same rows again, as a cluster's scheduler
    expects that repeats its command.
    """
    manifest = run.manifest
    was_killed_early = manifest.checkpoints.interval and not manifest.last_checkpoint
    if was_killed_early and manifest.state not in ("finished", "failed"):
        return False
    return any(len(run.rows(table)) for table in get_args(Table))


def _fixed(manifest: Manifest, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a run cannot change, by name; seeds and the like as lists, so that they compare with JSON's."""
    fixed = {name: getattr(manifest, name) for name in _FIXED}
    fixed["evaluation"] = vars(manifest.evaluation)
    fixed["hyperparameters"] = {**defaults, **manifest.hyperparameters}
    return fixed


def _is_step(text: str) -> bool:
    return bool(text.isascii() and re.fullmatch(r"\d+(_\d+)*", text) and len(text) <= 20)


def _normalises(manifest: Manifest, defaults: Mapping[str, Any]) -> bool:
    """Whether the networks of a run see observations on a common scale. PPO has the statistics in any case."""
    return bool({**defaults, **manifest.hyperparameters}.get("normalise_observations"))


def _machine_changes(before: Manifest, wanted: Manifest) -> list[str]:
    """Return what decides the last bits and is not what it was."""
    pairs = {
        "processor": (before.machine.processor, wanted.machine.processor),
        "number of usable cores": (before.machine.cores, wanted.machine.cores),
        "grouping of the seeds": ([list(group) for group in before.groups], [list(group) for group in wanted.groups]),
        "device": (before.machine.gpu or before.device, wanted.machine.gpu or wanted.device),
    }
    settings = {
        "XLA_FLAGS": (before.machine.xla_flags, wanted.machine.xla_flags),
        "precision of products": (before.machine.matmul_precision, wanted.machine.matmul_precision),
    }
    pairs |= {name: tuple(map(_or_none, pair)) for name, pair in settings.items() if None not in pair}
    for package in sorted(before.versions.keys() | wanted.versions.keys()):
        pairs[f"version of {package}"] = (before.versions.get(package), wanted.versions.get(package))
    pairs["commit of csac"] = (before.commit, wanted.commit)
    return [f"the {name} was {old} and is {new}" for name, (old, new) in pairs.items() if old != new]


def _or_none(setting: str | None) -> str:
    return setting or "not set"
