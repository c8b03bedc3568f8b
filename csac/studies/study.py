"""Read a study (tasks x methods x conditions x seeds) from a TOML file and expand it into run configurations."""

from __future__ import annotations

import dataclasses
import itertools
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import jax

from csac.algorithms import ALGORITHMS
from csac.checks import did_you_mean, without_controls
from csac.presets import hyperparameters as preset_of
from csac.record import manifest as manifests
from csac.record.config import RunConfig
from csac.record.run import RunDirectory, is_run
from csac.studies import paper
from csac.tasks.perturbations import perturbations_of, refuse_late
from csac.tasks.registry import check_events, events_of
from csac.training.config import algorithm_of, seed_range
from csac.training.resume import refuse_differences
from csac.types import InputError, Spec

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from csac.types import Algorithm

FEWEST_POINTS = 20  # evaluations of a shortened run; its evaluation interval is shortened to keep as many
WARMUP_SHARE = 0.1  # of a shortened run that may be warm-up
NAMED = Path(__file__).parent / "named"

Analysis = Literal["curves", "returns", "efficiency", "robustness", "cases", "success"]


@dataclass(frozen=True, kw_only=True)
class Method:
    """One algorithm with its hyperparameters, and the column of the paper that it reproduces."""

    algorithm: str
    label: str = ""
    preset: str | None = None
    hyperparameters: dict[str, Any] = field(default_factory=dict)
    sweep: dict[str, Any] = field(default_factory=dict)
    """Lists of values: each combination is a method."""
    published: str | None = None

    def __post_init__(self) -> None:
        _refuse_unknown([self.algorithm], ALGORITHMS, "there is no algorithm")
        _refuse_unknown([self.published] if self.published else [], paper.COLUMNS, "published: the paper has no")
        object.__setattr__(self, "label", self.label or self.algorithm)

    def swept(self) -> list[Method]:
        """Return a method for each combination of the sweep."""
        for name, values in self.sweep.items():
            if not isinstance(values, list) or not values:
                raise InputError(f"sweep.{name} is a list of values, not {values!r:.40}")
        found = []
        for values in itertools.product(*self.sweep.values()):
            chosen = dict(zip(self.sweep, values, strict=True))
            label = ", ".join([self.label, *(f"{name} {value}" for name, value in chosen.items())])
            own = {**self.hyperparameters, **chosen}
            found.append(dataclasses.replace(self, label=label, hyperparameters=own, sweep={}))
        return found

    def on(self, task: str, common: Mapping[str, Any]) -> Algorithm:
        """Return the algorithm on a task: the preset overrides `common`, and own hyperparameters override both."""
        preset = preset_of(self.preset, self.algorithm, task) if self.preset else {}
        make: Any = ALGORITHMS[self.algorithm]
        return make(**{**common, **preset, **self.hyperparameters})


class StudyRun(NamedTuple):
    """One run of a study, and its folder below the study's directory."""

    method: Method
    config: RunConfig
    folder: Path

    @property
    def name(self) -> str:
        """The name of the run in messages."""
        one = self.config
        several = [f"{one.environments} environments"] * (one.environments > 1)
        return ", ".join([f"{self.method.label} on {one.task}", *one.perturbations, *several, f"seed {one.seed}"])

    def open(self, directory: Path) -> RunDirectory | None:
        """Return the run, or None if it has not started. Raises InputError if its configuration is another one."""
        if not is_run(directory / self.folder):
            return None
        run = RunDirectory.open(directory / self.folder)
        refuse_differences(run, self.config, algorithm_of(self.config).cadence.has_schedule)
        return run

    def is_over(self, directory: Path) -> bool:
        """Return whether the run is finished or has failed. Raises InputError like `open`."""
        run = self.open(directory)
        state = run.manifest.state if run else "waiting"
        return state == "failed" or bool(run and state == "finished" and run.config.steps >= self.config.steps)


@dataclass(frozen=True, kw_only=True)
class Study:
    """The runs that answer a question. Steps are environment steps per seed, before `scale` shortens them."""

    name: str
    title: str = ""
    tasks: tuple[str, ...]
    methods: tuple[Method, ...]
    common: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Algorithm -> hyperparameters that all its methods share."""
    seeds: int = 5
    first_seed: int = 0
    steps: int = 1_000_000
    steps_on: dict[str, int] = field(default_factory=dict)
    """Tasks with another number of steps."""
    environments: int = 1
    """Environments that each seed steps in parallel."""
    evaluation_interval: int = 5_000
    evaluation_episodes: int = 10
    conditions: tuple[tuple[str, ...], ...] = ((),)
    """Sets of perturbations; the empty set changes nothing."""
    environment_arguments: dict[str, Any] = field(default_factory=dict)
    events: tuple[str, ...] = ()
    analyses: tuple[Analysis, ...] = ("curves", "returns")
    """The sections of its report."""
    scale: float = 1.0
    device: Literal["cpu", "gpu"] = "cpu"

    def __post_init__(self) -> None:
        if not (self.tasks and self.methods and self.conditions):
            raise InputError("a study needs tasks and methods")
        if not 0 < self.scale <= 1:
            raise InputError(f"scale is a share of the steps, more than 0 and at most 1, not {self.scale:g}")
        object.__setattr__(self, "title", self.title or self.name)
        object.__setattr__(self, "methods", tuple(one for method in self.methods for one in method.swept()))
        _refuse_unknown(self.steps_on, self.tasks, "steps_on: the study has no task")
        check_events(self.events)

    def narrowed(self, tasks: Sequence[str] = (), methods: Sequence[str] = (), seeds: int | None = None) -> Study:
        """Return the study with only these tasks and these methods or algorithms, and with this number of seeds."""
        names = dict.fromkeys(name for one in self.methods for name in (one.label, one.algorithm))
        _refuse_unknown(tasks, self.tasks, f"{self.name} has no task")
        _refuse_unknown(methods, names, f"{self.name} has no method")
        return dataclasses.replace(
            self,
            tasks=tuple(task for task in self.tasks if task in tasks or not tasks),
            methods=tuple(one for one in self.methods if {one.label, one.algorithm} & {*methods} or not methods),
            steps_on={task: steps for task, steps in self.steps_on.items() if task in tasks or not tasks},
            seeds=self.seeds if seeds is None else seeds,
        )

    def runs(self) -> list[StudyRun]:
        """Return every run, seed by seed, so that an unfinished study compares all methods on fewer seeds."""
        seeds = seed_range(self.seeds, self.first_seed)
        parts = itertools.product(self.tasks, self.conditions, self.methods)
        firsts = [self._run(task, condition, method, seeds[0]) for task, condition, method in parts]
        folders = [str(run.folder).casefold() for run in firsts]  # a Mac's disk ignores case
        if twice := [run for run, name in zip(firsts, folders, strict=True) if folders.count(name) > 1]:
            raise InputError(f"two methods, tasks or conditions have the folder {twice[0].folder.parent}: rename one")
        return [
            run._replace(config=dataclasses.replace(run.config, seed=seed), folder=run.folder.with_name(f"seed-{seed}"))
            for seed in seeds
            for run in firsts
        ]

    def _run(self, task: str, condition: tuple[str, ...], method: Method, seed: int) -> StudyRun:
        steps, interval = self.steps_on.get(task, self.steps), self.evaluation_interval
        algorithm = method.on(task, self.common.get(method.algorithm, {}))
        changes = perturbations_of(condition)
        if self.scale < 1:
            steps = max(1, round(steps * self.scale / self.environments)) * self.environments
            interval = max(1, min(interval, steps // FEWEST_POINTS)) if interval else 0
            changes = [dataclasses.replace(change, step=round(change.step * self.scale)) for change in changes]
            algorithm = _with_short_warmup(algorithm, steps)
        refuse_late(changes, steps)
        jax.eval_shape(lambda: algorithm.memory(Spec(1, 1, self.environments), steps))  # refuses what does not fit
        config = RunConfig(
            task=task,
            algorithm=method.algorithm,
            hyperparameters=dataclasses.asdict(algorithm),  # pyright: ignore[reportArgumentType]
            seed=seed,
            steps=steps,
            environments=self.environments,
            device=self.device,
            evaluation_interval=interval,
            evaluation_episodes=self.evaluation_episodes,
            environment_arguments=self.environment_arguments,
            perturbations=tuple(map(str, changes)),
            events=events_of(task, self.events),
        )
        words = (method.label, task, "+".join(config.perturbations))
        return StudyRun(method, config, Path(*filter(None, map(_folder, words)), f"seed-{seed}"))


def _with_short_warmup(algorithm: Any, steps: int) -> Any:
    warmup = getattr(algorithm, "warmup_steps", 0)
    longest = max(1, round(WARMUP_SHARE * steps))
    return dataclasses.replace(algorithm, warmup_steps=longest) if warmup > longest else algorithm


def _folder(words: str) -> str:
    return "-".join(re.findall(r"[\w.=@+]+", words)).strip(".")


def named() -> list[str]:
    """Return the names of the studies that come with csac."""
    return sorted(path.stem for path in NAMED.glob("*.toml"))


def find(name: str) -> Study:
    """Return the study of this name that comes with csac, or the one in the TOML file of this name."""
    if name in named():
        return read_study(NAMED / f"{name}.toml")
    if not name.endswith(".toml") and not Path(name).is_file():
        _refuse_unknown([name], named(), "there is no file and no study")
    return read_study(Path(name))


def read_study(path: Path) -> Study:
    """Read a study from a TOML file; docs/studies.md describes the format. Raises InputError."""
    try:
        fields = tomllib.loads(without_controls(path.read_bytes()).decode("utf-8-sig"))
        _refuse_unknown(fields, _names(Study), "a study has no")
        for method in manifests.parsed(tuple[dict[str, Any], ...], fields.get("methods", []), "methods"):
            _refuse_unknown(method, _names(Method), "a method has no")
        study = manifests.parsed(Study, {**fields, "name": path.stem}, "")
        _refuse_unknown(study.common, [one.algorithm for one in study.methods], "common: no method has the algorithm")
        study.runs()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (ValueError, RecursionError) as error:  # from parsing TOML and its numbers
        raise InputError(f"{path} is not TOML: {error}") from None
    return study


def _names(kind: Any) -> list[str]:
    return [item.name for item in dataclasses.fields(kind) if item.name not in ("name", "scale", "device")]


def _refuse_unknown(wanted: Iterable[str], known: Iterable[str], complaint: str) -> None:
    known = list(known)
    for name in wanted:
        if name not in known:
            hint = did_you_mean(name, known) or f"there is {', '.join(known)}"
            raise InputError(f"{complaint} {name!r}: {hint}")
