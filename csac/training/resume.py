"""Going on with a run, or beginning another from its checkpoint: what fits, what has changed, what is undone."""

from __future__ import annotations

import dataclasses
import shutil
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from csac.algorithms import ALGORITHMS
from csac.record.run import RunDirectory
from csac.tasks.perturbations import continued, perturbations_of
from csac.training.checkpoint import FOLDER, Checkpoint, Checkpoints, newest_sound, sound_at, taken_back
from csac.training.learner import misfit
from csac.training.restore import copy, restore
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from csac.tasks.perturbations import Perturbation
    from csac.types import Algorithm, Spec

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
_BEFORE_THERE_WERE = {"perturbations": [], "events": []}  # in manifests that are older


class Point(NamedTuple):
    """Where a run goes on: the step of its checkpoint (0 is its beginning), and who had failed by then."""

    step: int
    failures: dict[int, str]
    complaints: list[str]  # what was wrong with newer checkpoints, and what was mended
    pinned: list[int]  # steps of checkpoints to keep for good

    def notes(self, before: dict[str, Any], now: dict[str, Any]) -> list[str]:
        """Return what the user should know of this continuation, a line each."""
        lines = [f"warning: {complaint}" for complaint in self.complaints]
        lines.append(f"going on from step {self.step:,}" if self.step else "no checkpoint yet: it begins anew")
        if changes := _machine_changes(before, now):
            lines.append(f"note: not the same to the last bit from here on, because {' and '.join(changes)}")
        if inexact := before.get("inexact_seeds"):
            seeds = ", ".join(map(str, inexact))
            lines.append(f"note: this task cannot be saved in mid-episode: seeds {seeds} begin their episode anew")
        return lines

    def history_entry(self, before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
        """Return what the manifest remembers of this continuation."""
        moment = datetime.now().astimezone().isoformat(timespec="seconds")
        exact = not (_machine_changes(before, now) or before.get("inexact_seeds"))
        previous = {name: before[name] for name in ("steps", "machine", "versions", "groups") if name in before}
        return {
            "resumed": moment,
            "step": self.step,
            "exact": exact,
            "complaints": self.complaints,
            "command": now["command"],
            "previous": previous,
        }


BEGINNING = Point(0, {}, [], [])


def refuse_differences(run: RunDirectory, wanted: dict[str, Any], algorithm: Algorithm) -> None:
    """Raise InputError, with what differs, where `wanted` is not a continuation of `run`."""
    differences = _differences(_fixed(run.manifest), _fixed(wanted))
    if differences:
        raise InputError(f"{run.path} was trained otherwise: {'; '.join(differences)}. Choose another directory")
    before, now = run.manifest["steps"], wanted["steps"]
    if now < before:
        raise InputError(f"{run.path} is a run of {before:,} steps, which {now:,} would shorten: give at least as many")
    if now > before and algorithm.has_schedule:
        raise InputError(
            f"{run.path} cannot go on beyond its {before:,} steps: its learning rate was planned for them (a schedule)"
        )


def with_past(
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
        before, begin = existing.manifest, existing.manifest.get("forked_from", {}).get("step", 0)
    elif source:
        before, begin = source.run.manifest, source.checkpoint.step
    else:
        return asked
    planned = perturbations_of(before.get("perturbations", []))
    return planned if given is None else continued(planned, asked, begin)


def roll_back(run: RunDirectory) -> Point:
    """Bring a run's files back to its newest sound checkpoint, or to its beginning, and say where that is.

    Raises:
        InputError: rows are missing that the checkpoint counts on, or all its checkpoints are damaged.
    """
    folder = run.path / FOLDER
    checkpoint, complaints = newest_sound(folder)
    if checkpoint is None and complaints:
        raise InputError(f"no checkpoint of {run.path} is sound: {'; '.join(complaints)}")
    if checkpoint is None and "forked_from" in run.manifest:
        raise InputError(f"{run.path} was stopped before it had its first checkpoint: remove it and train --from again")
    step = checkpoint.step if checkpoint else 0
    complaints = [f"{complaint}; an earlier checkpoint is used" for complaint in complaints]
    complaints += restore(run.path, checkpoint)
    for unfinished in [*run.path.glob(".*.*"), *run.path.glob("policy/*.tmp")]:
        unfinished.unlink()
    values = checkpoint.values if checkpoint else {"failures": {}, "pinned": []}
    if folder.exists():
        keep = run.manifest.get("checkpoints", {}).get("keep", 0)
        Checkpoints(folder, keep, values["pinned"]).discard_after(step)
    failures = {int(seed): reason for seed, reason in values["failures"].items()}
    return Point(step, failures, complaints, values["pinned"])


def algorithm_of(manifest: dict[str, Any]) -> Algorithm:
    """Return the algorithm of a run with its hyperparameters. Raises InputError where this csac does not know them."""
    name = manifest["algorithm"]
    if name not in ALGORITHMS:
        raise InputError(f"the run's algorithm {name!r} is not known: choose a run of {' or '.join(ALGORITHMS)}")
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in manifest.get("hyperparameters", {}).items()}
    unknown = values.keys() - {field.name for field in dataclasses.fields(ALGORITHMS[name])}
    if unknown:
        raise InputError(f"the run has hyperparameters that this csac does not know: {', '.join(sorted(unknown))}")
    make: Any = ALGORITHMS[name]
    return make(**values)


def arguments_of(run: RunDirectory) -> dict[str, Any]:
    """Return the arguments of `train` that a run was started with, as far as they belong to what it computes.

    Raises:
        InputError: the manifest does not have them, or its task is a Python function.
    """
    manifest = run.manifest
    if manifest.get("task_is_callable"):
        raise InputError(
            f"the task of {run.path} is a Python function: call csac.train with it, this directory and resume=True"
        )
    try:
        return {
            "task": manifest["task"],
            "seeds": len(manifest["seeds"]),
            "first_seed": manifest["seeds"][0],
            "evaluation_interval": manifest["evaluation"]["interval"],
            "evaluation_episodes": manifest["evaluation"]["episodes"],
            "environment_arguments": manifest["environment_arguments"],
            "perturbations": manifest.get("perturbations", []),
            "device": manifest["device"],
            "checkpoint_interval": manifest["checkpoints"]["interval"],
            "keep_checkpoints": manifest["checkpoints"]["keep"],
        }
    except (KeyError, IndexError, TypeError) as error:
        raise InputError(f"{run.path / 'manifest.json'} does not say how to go on ({error!r})") from None


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
        if not at or Path(where).exists():
            name, step = str(where), ""
        run = RunDirectory.open(name)
        if step and not step.replace("_", "").isdigit():
            raise InputError(f"{where}: {step!r} is not a step; write DIRECTORY@STEP")
        if step:
            return cls(run, sound_at(run.path / FOLDER, int(step)))
        checkpoint, complaints = newest_sound(run.path / FOLDER)
        if checkpoint is None:
            raise InputError("; ".join(complaints) or f"{run.path} has no checkpoint yet")
        return cls(run, checkpoint)

    def refuse_misfit(self, wanted: dict[str, Any], algorithm: Algorithm, spec: Spec) -> None:
        """Raise InputError where the new run cannot begin with this checkpoint."""
        before = {"events": [], **self.run.manifest}
        names = ("algorithm", "events")  # of whose tables the new run's are a continuation
        differences = _differences({name: before[name] for name in names}, {name: wanted[name] for name in names})
        missing = sorted(set(wanted["seeds"]) - set(before["seeds"]))
        if missing:
            differences.append(f"it has no seeds {', '.join(map(str, missing))}")
        if not differences:
            with taken_back(self.checkpoint):
                saved = self.checkpoint.seed(wanted["seeds"][0]).part("learner")
                differences += filter(None, [misfit(algorithm, spec, wanted["steps"], saved)])
        if differences:
            raise InputError(f"{self.run.path} does not fit: {'; '.join(differences)}")
        if wanted["steps"] <= self.checkpoint.step:
            raise InputError(
                f"steps counts from the beginning: give more than the {self.checkpoint.step:,} made already"
            )
        if algorithm.has_schedule and wanted["steps"] != before["steps"]:
            raise InputError(
                f"{self.run.path} was planned for {before['steps']:,} steps, and its learning rate with it "
                "(a schedule): give as many"
            )

    def described(self, wanted: dict[str, Any]) -> dict[str, Any]:
        """Return what the manifest says of where the new run began, and of what is different in it."""
        changes = _differences(_fixed(self.run.manifest), _fixed(wanted))
        return {"directory": str(self.run.path), "step": self.checkpoint.step, "changes": changes}

    def copy_to(self, run: RunDirectory, keep: int) -> None:
        """Give a new run the tables up to the checkpoint, and the checkpoint."""
        files = copy(self.checkpoint, run.path)
        if (self.run.path / "policy" / "contract.json").exists():
            (run.path / "policy").mkdir()
            shutil.copyfile(self.run.path / "policy" / "contract.json", run.path / "policy" / "contract.json")
        Checkpoints(run.path / FOLDER, keep).commit(self.checkpoint.step, files, self.checkpoint.values)


def _fixed(manifest: dict[str, Any]) -> dict[str, Any]:
    fixed = {name: manifest.get(name, _BEFORE_THERE_WERE.get(name)) for name in _FIXED}
    if fixed["algorithm"] in ALGORITHMS and isinstance(fixed["hyperparameters"], dict):
        # The default of a hyperparameter that an older run has not got is what it did.
        defaults = {field.name: field.default for field in dataclasses.fields(ALGORITHMS[fixed["algorithm"]])}
        fixed["hyperparameters"] = {**defaults, **fixed["hyperparameters"]}
    return fixed


def _differences(before: dict[str, Any], now: dict[str, Any], prefix: str = "") -> list[str]:
    """Return "name is X, not Y" for each value that differs, in nested dicts too."""
    lines = []
    for name in sorted(before.keys() | now.keys()):
        old, new = _plain(before.get(name)), _plain(now.get(name))
        if isinstance(old, dict) and isinstance(new, dict):
            lines += _differences(old, new, f"{name}." if name == "evaluation" else "")
        elif old != new:
            lines.append(f"{prefix}{name} is {old!r}, not {new!r}")
    return lines


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _machine_changes(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Return what decides the last bits and is not what it was."""
    pairs = {
        "processor": (before.get("machine", {}).get("processor"), now["machine"]["processor"]),
        "number of cores": (before.get("machine", {}).get("cores"), now["machine"]["cores"]),
        "grouping of the seeds": (before.get("groups"), now["groups"]),
        "device": (before.get("device"), now["device"]),
    }
    for package in ("jaxlib", "jax", "mujoco", "gymnasium", "numpy", "optax"):
        pairs[package] = (before.get("versions", {}).get(package), now["versions"].get(package))
    return [f"the {name} was {old} and is {new}" for name, (old, new) in pairs.items() if old != new]
