"""Group runs into the arms of a comparison, label the arms, and collect the results of their seeds."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import shlex
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.algorithms import ALGORITHMS
from csac.presets import PRESETS, hyperparameters
from csac.record.config import RunConfig
from csac.record.run import RunDirectory, is_run
from csac.record.sets import RunSet, find_sets, run_path
from csac.record.statistics import evaluation_matrix, maximum_average_return
from csac.record.tables import joined
from csac.tasks.perturbations import by_step, perturbations_of
from csac.tasks.registry import events_of
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from csac.studies.study import Study

FITTED = ("warmup_steps", "replay_size")  # to the length of a run, without leaving the preset
NO_SETTING = ("task", "algorithm", "seed", "perturbations", "events", "device", "checkpoint_interval")
NO_SETTING += ("keep_checkpoints", "task_is_callable", "hyperparameters", "environment_arguments")


@dataclass
class Arm:
    """The runs of one method on one task under one condition, which differ only in their seeds."""

    label: str
    task: str
    condition: tuple[str, ...]
    runs: list[RunDirectory] = field(default_factory=list)
    missing: list[int] = field(default_factory=list)
    """Seeds of the study that have not started."""
    published: str | None = None
    """The column of the paper's tables to compare with."""
    until: int | None = None
    """The last step whose evaluations count."""

    @property
    def config(self) -> RunConfig:
        """The configuration of the first run."""
        return self.runs[0].config

    @property
    def failures(self) -> dict[int, str]:
        """The failure reason of each failed seed."""
        return {run.seed: run.manifest.failure for run in self.runs if run.manifest.state == "failed"}

    @functools.cached_property
    def incomplete(self) -> dict[int, int]:
        """The last evaluated step of each seed that is behind or has not started; such a seed is in no statistic."""
        ends = {seed: int(rows["step"].max(initial=0)) for seed, rows in self._sound.items()}
        ended_early = {
            run.seed
            for run in self.runs
            if run.manifest.state == "finished" and run.manifest.steps_done < run.config.steps
        }
        longest = max(ends.values(), default=0)
        behind = {seed: end for seed, end in ends.items() if not end or (end < longest and seed not in ended_early)}
        return behind | dict.fromkeys(self.missing, 0)

    @functools.cached_property
    def rows(self) -> np.ndarray:
        """The rows of evaluations.csv of the seeds that neither failed nor are incomplete."""
        return joined("evaluations", (rows for seed, rows in self._sound.items() if seed not in self.incomplete))

    @property
    def marks(self) -> list[tuple[int, str]]:
        """The perturbations: the step of each, and its text."""
        return by_step(perturbations_of(self.condition))

    @property
    def place(self) -> str:
        """The task and its perturbations."""
        return ", ".join([self.task, *(f"{text} after step {step:,}" if step else text for step, text in self.marks)])

    def best(self) -> tuple[np.ndarray, int]:
        """Return each seed's return at the step of the maximum average return, and that step."""
        steps, _, returns = evaluation_matrix(self.rows)
        if not len(steps):
            return np.zeros(0), 0
        _, step = maximum_average_return(self.rows)
        return returns[:, int(np.flatnonzero(steps == step)[0])], step

    @functools.cached_property
    def _sound(self) -> dict[int, np.ndarray]:
        tables = {run.seed: run.evaluations for run in self.runs if run.manifest.state != "failed"}
        return {s: rows if self.until is None else rows[rows["step"] <= self.until] for s, rows in tables.items()}


def gather(study: Study, directory: Path) -> list[Arm]:
    """Return every arm of a study with its runs, task by task. Raises InputError for runs of another configuration."""
    arms: dict[tuple[str, tuple[str, ...], str], Arm] = {}
    for wanted in study.runs():
        method, config, _ = wanted
        new_arm = Arm(method.label, config.task, config.perturbations, published=method.published)
        arm = arms.setdefault((config.task, config.perturbations, method.label), new_arm)
        if run := wanted.open(directory):
            arm.runs.append(run)
        else:
            arm.missing.append(config.seed)
    return sorted(arms.values(), key=lambda arm: study.tasks.index(arm.task))


def read_arms(
    paths: Sequence[Path],
    labelled: Sequence[tuple[str, Sequence[Path]]] = (),
    until: int | None = None,
    on_damaged: Callable[[InputError], None] | None = None,
) -> list[Arm]:
    """Group the runs at and below these paths into arms: by label, or by configuration apart from the seed."""
    found: dict[tuple[Any, ...], dict[Path, list[RunDirectory]]] = {}  # by label or configuration, then by folder
    seen: set[Path] = set()
    for label, path in [*((label, path) for label, some in labelled for path in some), *(("", path) for path in paths)]:
        for run in _runs(path, on_damaged):
            if not label and run.path in seen:
                continue
            seen.add(run.path)
            config = run.config
            origin = run.manifest.forked_from
            changes = [*origin.earlier, *origin.changes] if origin else []
            fork = [origin.step, changes] if origin and changes else []
            alike = json.dumps([config.algorithm, settings(config), fork], sort_keys=True)
            key = label, alike * (not label), config.task, config.perturbations
            folders = found.setdefault(key, {})
            if label and run.seed in [other.seed for runs in folders.values() for other in runs]:
                raise InputError(f"{label}: {run.path} is a second run of seed {run.seed}; label them apart")
            folders.setdefault(_set_of(run), []).append(run)
    arms: list[Arm] = []
    for (label, _, task, perturbations), folders in found.items():
        together = [run for runs in folders.values() for run in runs]
        is_one = len({run.seed for run in together}) == len(together)  # else each folder has the same seeds anew
        several = [together] if is_one else folders.values()
        arms += [Arm(label, task, perturbations, runs, until=until) for runs in several]
    for arm, label in zip(arms, labels(arms), strict=True):
        arm.label = label
    return arms


def _set_of(run: RunDirectory) -> Path:
    """Return the folder of a run's set; of a run alone, its own."""
    return run.path.parent if run.path == run_path(run.path.parent, run.seed) else run.path


def _runs(path: Path, on_damaged: Callable[[InputError], None] | None) -> list[RunDirectory]:
    if is_run(path):
        return [RunDirectory.open(path)]
    found = [run for runs in find_sets(path, on_damaged) for run in runs.runs]
    return found or RunSet.open(path).runs  # raises an error that says what is there instead


def labels(arms: Sequence[Arm]) -> list[str]:
    """Return a label for each arm: its own, or its algorithm and preset with the settings in which such arms differ.

    A setting that distinguishes arms on one task is named on every task, so that a method has one label.
    """
    names = [arm.label or name_of(arm.config) for arm in arms]
    distinguishing: dict[str, list[str]] = {}
    for name in names:
        namesakes = [arm for arm, its in zip(arms, names, strict=True) if its == name and not arm.label]
        groups = by_place(sorted(namesakes, key=lambda arm: arm.place)).values()
        differences = [item for group in groups for item in differing([settings(arm.config) for arm in group])]
        if namesakes and name == namesakes[0].config.title:  # no preset: its values may differ between tasks
            differences += differing([_hyperparameters(arm.config) for arm in namesakes])
        distinguishing[name] = list(dict.fromkeys(differences))
    full = [
        ", ".join([name, *(f"{item} {plain(settings(arm.config).get(item))}" for item in distinguishing[name])])
        for arm, name in zip(arms, names, strict=True)
    ]
    keys = [(label, arm.place) for arm, label in zip(arms, full, strict=True)]
    return [
        f"{label}, {_set_of(arm.runs[0])}" if keys.count((label, arm.place)) > 1 else label
        for arm, label in zip(arms, full, strict=True)
    ]


def name_of(config: RunConfig) -> str:
    """Return the algorithm, the preset that a run follows, if any, and the `FITTED` values that differ from it."""
    name, actual = config.title, _hyperparameters(config)
    make: Any = ALGORITHMS.get(config.algorithm)
    for preset in PRESETS:
        with suppress(InputError):  # a preset may lack the algorithm
            given: Any = hyperparameters(preset, config.algorithm, config.task)
            changed = differing([actual, dataclasses.asdict(make(**given))])
            if set(changed) <= set(FITTED):
                return ", ".join([f"{name} ({preset})", *(f"{item} {plain(actual.get(item))}" for item in changed)])
    return name


def settings(config: RunConfig) -> dict[str, Any]:
    """Return the settings that a run's results depend on, apart from task, algorithm and perturbations."""
    options = {name: value for name, value in vars(config).items() if name not in NO_SETTING}
    arguments = {f"environment: {name}": value for name, value in config.environment_arguments.items()}
    return {**_hyperparameters(config), **options, **arguments}


def _hyperparameters(config: RunConfig) -> dict[str, Any]:
    """Return a run's hyperparameters; one newer than the run has its default."""
    make: Any = ALGORITHMS.get(config.algorithm)
    return {**(dataclasses.asdict(make()) if make else {}), **config.hyperparameters}


def differing(several: Sequence[dict[str, Any]]) -> list[str]:
    """Return the names of the settings that differ between these, or that some of them lack."""
    names = dict.fromkeys(name for own in several for name in own)
    return [name for name in names if len({plain(own.get(name)) for own in several}) > 1]


def plain(value: Any) -> str:
    """Format the value of a setting for people."""
    if isinstance(value, tuple | list):
        return " ".join(map(str, value))
    if isinstance(value, float):
        return f"{value:g}"
    return "none" if value is None else f"{value:,}" if type(value) is int else str(value)


def train_command(config: RunConfig, seeds: Sequence[int]) -> str:
    """Return the `csac train` command that trains these seeds of a configuration."""
    words = ["csac", "train", config.task, "--algorithm", config.algorithm, "--steps", str(config.steps)]
    words += ["--seeds", str(seeds[-1] - seeds[0] + 1), *(["--first-seed", str(seeds[0])] if seeds[0] else [])]
    default = RunConfig(task=config.task)
    evaluated = ("evaluation_interval", "evaluation_episodes", "evaluation_environments")
    for name in ("environments", *evaluated, "device", "hindsight"):
        words += option(name, getattr(config, name)) if getattr(config, name) != getattr(default, name) else []
    words += [word for change in config.perturbations for word in ("--perturb", change)]
    words += ["--env-kwargs", json.dumps(config.environment_arguments)] * bool(config.environment_arguments)
    if more := [name for name in config.events if name not in events_of(config.task)]:
        words += ["--events", ",".join(more)]
    return shlex.join([*words, *_options(config)])


def _options(config: RunConfig) -> list[str]:
    """Return the options of hyperparameters that differ from the defaults, or from a preset if that is shorter."""
    make: Any = ALGORITHMS.get(config.algorithm)
    choices = []
    for preset in (None, *PRESETS):
        with suppress(InputError):
            given = hyperparameters(preset, config.algorithm, config.task) if preset else {}
            values = json.loads(json.dumps(dataclasses.asdict(make(**given)))) if make else {}
            changed = {name: own for name, own in config.hyperparameters.items() if own != values.get(name)}
            options = [word for name, value in changed.items() for word in option(name, value)]
            choices.append([*(["--preset", preset] if preset else []), *options])
    return min(choices, key=len)


def option(name: str, value: Any) -> list[str]:
    """Return the words of one option; for None there are none, since leaving the option out means None."""
    flag = name.replace("_", "-")
    if value is None:
        return []
    if isinstance(value, bool):
        return [f"--{flag}" if value else f"--no-{flag}"]
    return [f"--{flag}", *map(str, value if isinstance(value, list | tuple) else (value,))]


def seconds_per_step(run: RunDirectory) -> float | None:
    """Return the median seconds per step between evaluations in a run's log; interruptions do not count."""
    evaluations = []
    with suppress(OSError, ValueError):
        for line in (run.path / "log.txt").read_text(encoding="utf-8").splitlines():
            moment, word, step, *_ = [*line.split(" "), "", ""]
            if word == "step" and step.endswith(":"):
                evaluations.append((datetime.fromisoformat(moment), int(step[:-1])))
    paces = [
        (later - before).total_seconds() / (step - start)
        for (before, start), (later, step) in itertools.pairwise(evaluations)
        if step > start
    ]
    return median(paces) if paces else None


def by_place(arms: Iterable[Arm]) -> dict[str, list[Arm]]:
    """Group arms by their `place`, that is by task and perturbations."""
    arms = list(arms)
    return {place: [arm for arm in arms if arm.place == place] for place in dict.fromkeys(arm.place for arm in arms)}
