"""A study: tasks x methods x conditions x seeds, as data; shortened, narrowed, and read from a TOML file."""

from __future__ import annotations

import itertools
import json
import math
import tomllib
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from csac.presets import hyperparameters as preset_of
from csac.record.manifest import SEED_LIMIT, STEPS_LIMIT
from csac.studies import paper
from csac.studies.cells import Cell, complete, similar
from csac.tasks.perturbations import Perturbation, perturbations_of, refuse_late
from csac.tasks.registry import adapter_of, check_events, registered
from csac.training.options import LONGEST_INTERVAL, MOST_EPISODES
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

ANALYSES = ("curves", "returns", "efficiency", "robustness", "cases", "success")
FEWEST_POINTS = 20  # evaluations of a shortened run: it is evaluated more often once it would have fewer
WARMUP_SHARE = 0.1  # of a shortened run that is warm-up at most
MOST_CELLS = 100_000


@dataclass(frozen=True)
class Method:
    """One algorithm with its hyperparameters, and the column of the paper that it reproduces."""

    label: str
    algorithm: str
    preset: str | None = None
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    published: str | None = None
    common: Mapping[str, Any] = field(default_factory=dict)
    """What it has in common with the others of its algorithm, where neither it nor its preset says otherwise."""

    def hyperparameters_on(self, task: str) -> dict[str, Any]:
        """Return every hyperparameter on this task. Raises InputError for one that there is not."""
        preset = preset_of(self.preset, self.algorithm, task) if self.preset else {}
        return complete(self.algorithm, {**self.common, **preset, **self.hyperparameters})


class Entry(NamedTuple):
    """A cell, and what it stands for in a study."""

    method: Method
    condition: tuple[str, ...]
    cell: Cell


@dataclass(frozen=True)
class Study:
    """What is trained to answer a question. Steps are environment steps per seed; nothing here is shortened yet.

    Raises:
        InputError: more cells than anybody runs, or seeds with labels that there are not.
    """

    name: str
    title: str
    tasks: tuple[str, ...]
    methods: tuple[Method, ...]
    seeds: int = 5
    first_seed: int = 0
    steps: int = 1_000_000
    steps_on: Mapping[str, int] = field(default_factory=dict)
    """Tasks on which it is another number of steps."""
    evaluation_interval: int = 5_000
    evaluation_episodes: int = 10
    conditions: tuple[tuple[str, ...], ...] = ((),)
    """Each a set of perturbations; the empty one changes nothing."""
    environment_arguments: Mapping[str, Any] = field(default_factory=dict)
    events: tuple[str, ...] = ()
    rollouts: int = 0
    """Fresh episodes that each finished policy is tested on."""
    analyses: tuple[str, ...] = ("curves", "returns")
    """What its report shows."""
    claims: bool = True
    """Whether the paper's claims are held against it."""
    scale: float = 1.0

    def __post_init__(self) -> None:
        if (last := self.first_seed + self.seeds - 1) >= SEED_LIMIT:
            raise InputError(f"the last seed would be {last:,}: seeds are below {SEED_LIMIT:,}")
        cells = math.prod([len(self.tasks), len(self.methods), len(self.conditions), self.seeds])
        if cells > MOST_CELLS:
            raise InputError(
                f"{self.name} would have {cells:,} cells, and {MOST_CELLS:,} is the most: "
                "give fewer seeds, tasks, methods or conditions"
            )

    def shortened(self, scale: float) -> Study:
        """Return the study with every run shortened to this share of its steps."""
        if not 0 < scale <= 1:
            raise InputError(f"scale is a share of the steps, more than 0 and at most 1, not {scale:g}")
        return replace(self, scale=self.scale * scale)

    def narrowed(
        self,
        tasks: Sequence[str] | None = None,
        algorithms: Sequence[str] | None = None,
        seeds: int | None = None,
    ) -> Study:
        """Return the study on some of its tasks, with some of its algorithms or methods, with another number of seeds.

        Raises:
            InputError: one that the study does not have, or too many seeds.
        """
        if seeds is not None and seeds < 1:
            raise InputError(f"seeds must be at least 1, not {seeds}")
        return replace(
            self,
            tasks=self.tasks if tasks is None else _some(tasks, self.tasks, f"{self.name} has no task"),
            methods=self.methods if algorithms is None else self._some_methods(algorithms),
            seeds=self.seeds if seeds is None else seeds,
        )

    @property
    def names(self) -> list[str]:
        """By which its methods may be chosen: those of their algorithms, and their labels."""
        return list(dict.fromkeys(name for method in self.methods for name in (method.algorithm, method.label)))

    def _some_methods(self, wanted: Sequence[str]) -> tuple[Method, ...]:
        chosen = _some(wanted, self.names, f"{self.name} has no algorithm or method")
        return tuple(method for method in self.methods if {method.algorithm, method.label} & set(chosen))

    def steps_for(self, task: str) -> int:
        """Return the steps of a run on this task, shortened."""
        return max(1, round(self.steps_on.get(task, self.steps) * self.scale))

    def interval_for(self, task: str) -> int:
        """Return the steps between two evaluations: as planned, or less where there would be too few of them."""
        interval = self.evaluation_interval
        return interval if self.scale == 1 else max(1, min(interval, self.steps_for(task) // FEWEST_POINTS))

    @property
    def rollouts_each(self) -> int:
        """Fresh episodes for each policy, fewer where the runs are shorter."""
        return math.ceil(self.rollouts * self.scale)

    def conditions_for(self) -> tuple[tuple[str, ...], ...]:
        """Return the conditions, at steps that are shortened as the runs are."""
        shortened = (
            tuple(str(replace(one, step=round(one.step * self.scale))) for one in perturbations_of(condition))
            for condition in self.conditions
        )
        return tuple(dict.fromkeys(shortened))  # two may now be the same

    def entries(self) -> list[Entry]:
        """Return every cell: seed by seed, so that an unfinished study compares all methods on fewer seeds."""
        parts = itertools.product(self.tasks, self.conditions_for(), self.methods)
        firsts = [Entry(method, part, self._first_cell(task, method, part)) for task, part, method in parts]
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        return [one._replace(cell=replace(one.cell, seed=seed)) for seed in seeds for one in firsts]

    def _first_cell(self, task: str, method: Method, condition: tuple[str, ...]) -> Cell:
        steps = self.steps_for(task)
        refuse_late(map(Perturbation.parse, condition), steps)
        hyperparameters = method.hyperparameters_on(task)
        if self.scale < 1 and "warmup_steps" in hyperparameters:
            longest = max(1, round(WARMUP_SHARE * steps))
            hyperparameters["warmup_steps"] = min(hyperparameters["warmup_steps"], longest)
        return Cell.make(
            task,
            method.algorithm,
            hyperparameters,
            steps=steps,
            seed=self.first_seed,
            evaluation_interval=self.interval_for(task),
            evaluation_episodes=self.evaluation_episodes,
            perturbations=condition,
            environment_arguments=self.environment_arguments,
            events=self.events,
        )


def cells_of(studies: Iterable[Study]) -> list[Cell]:
    """Return every cell of these studies, once, in an order that depends on nothing else."""
    return list({entry.cell.key: entry.cell for study in studies for entry in study.entries()}.values())


def read_study(path: str | Path) -> Study:
    """Return the study that a TOML file describes; docs/studies.md says what it may hold.

    Raises:
        InputError: no such file, or anything in it that is not understood.
    """
    path = Path(path)
    try:
        told = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # of the text, of TOML, of numbers and nests that are too long
        raise InputError(f"{path} is not TOML: {error}") from None
    try:
        study = _study(path.stem, told)
        _refuse_twins(study)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return study


def _refuse_twins(study: Study) -> None:
    """Make every cell. Raises InputError for one that cannot be, and for two methods that are the same runs."""
    cells: dict[str, list[Cell]] = {}
    for method, _, cell in replace(study, seeds=1).entries():
        cells.setdefault(method.label, []).append(cell)
    seen: dict[tuple[str, ...], str] = {}
    for label, several in cells.items():
        keys = tuple(cell.key for cell in several)
        if keys in seen:
            raise InputError(f"the methods {seen[keys]!r} and {label!r} are the same: leave one of them out")
        seen[keys] = label


def _study(name: str, told: dict[str, Any]) -> Study:
    _refuse_unknown(told, _KEYS, "a study")
    missing = [key for key in ("tasks", "methods") if not told.get(key)]
    if missing:
        raise InputError(f"{' and '.join(missing)} missing: a study names its tasks and its methods")
    values = {key: _KEYS[key](key, value) for key, value in told.items()}
    common = values.pop("common", {})
    for algorithm, hyperparameters in common.items():
        complete(algorithm, hyperparameters)
    values["methods"] = tuple(replace(one, common=common.get(one.algorithm, {})) for one in values["methods"])
    for key, (least, most) in _RANGES.items():
        if key in values:
            _check_range(key, values[key], least, most)
    written = [list(map(str, perturbations_of(one))) for one in values.get("conditions", ())]
    for key, items in (("tasks", list(map(repr, values["tasks"]))), ("conditions", list(map(json.dumps, written)))):
        if twice := _twice(items):
            raise InputError(f"{key} has {twice} twice: its runs would count twice")
    check_events(values.get("events", ()))
    for task in values["tasks"]:
        if ":" not in task and adapter_of(task) is None:  # others may be known to the machines that train alone
            registered(task)
    for task, steps in values.get("steps_on", {}).items():
        _some([task], values["tasks"], "steps_on: the study has no task")
        _check_range(f"steps_on.{task}", steps, 1, STEPS_LIMIT)
    _some(values.get("analyses", ()), ANALYSES, "analyses: there is no")
    labels = [method.label for method in values["methods"]]
    for label in labels:
        if not label.strip() or not label.isprintable():
            raise InputError(f"{label!r} is no label: it is a line of text")
    if twice := _twice(list(map(repr, labels))):
        raise InputError(f"two methods are called {twice}: give each a label of its own")
    return Study(**{"name": name, "title": name, **values})


def _twice(items: Iterable[str]) -> str | None:
    """Return the first of the items that is there again."""
    return next((item for item, count in Counter(items).items() if count > 1), None)


def _check_range(key: str, value: int, least: int, most: int) -> None:
    if value < least:
        raise InputError(f"{key} must be {'at least 1' if least else '0 or more'}, not {value}")
    if value > most:
        raise InputError(f"{key} must be at most {most:,}, not {value:,}")


def _methods(key: str, told: Any) -> tuple[Method, ...]:
    if not isinstance(told, list) or not all(isinstance(item, dict) for item in told):
        raise InputError("methods are written as [[methods]] tables")
    return tuple(method for item in told for method in _swept(item))


def _swept(told: dict[str, Any]) -> list[Method]:
    """Return the methods of one table: one, or one for each combination of what it sweeps."""
    _refuse_unknown(told, _METHOD_KEYS, "a method")
    if "algorithm" not in told:
        raise InputError("a method needs an algorithm")
    values = {key: _METHOD_KEYS[key](key, value) for key, value in told.items()}
    if (published := values.get("published")) is not None:
        _some([published], paper.COLUMNS, "published: the paper has no")
    sweep, given = values.pop("sweep", {}), values.get("hyperparameters", {})
    for name, several in sweep.items():
        if not isinstance(several, list) or not several:
            raise InputError(f"sweep.{name} is a list of values, not {several!r}")
    if (count := math.prod(map(len, sweep.values()))) > MOST_CELLS:
        raise InputError(f"a sweep would be {count:,} methods, and a study has at most {MOST_CELLS:,} cells")
    complete(values["algorithm"], {**given, **{name: several[0] for name, several in sweep.items()}})
    methods = []
    for combination in itertools.product(*sweep.values()):
        chosen = dict(zip(sweep, combination, strict=True))
        label = ", ".join([values.get("label", values["algorithm"]), *(f"{k} {v}" for k, v in chosen.items())])
        methods.append(Method(**{**values, "label": label, "hyperparameters": {**given, **chosen}}))
    return methods


def _refuse_unknown(told: Mapping[str, Any], known: Mapping[str, Any], what: str) -> None:
    for key in told:
        if key not in known:
            raise InputError(f"{what} has no {key!r}{similar(key, known)}")


def _some(wanted: Iterable[str], known: Iterable[str], complaint: str) -> tuple[str, ...]:
    known = list(known)
    for name in wanted:
        if name not in known:
            raise InputError(f"{complaint} {name!r}{similar(name, known)}")
    return tuple(name for name in known if name in set(wanted))


def _of(kind: type, words: str) -> Callable[[str, Any], Any]:
    def read(key: str, value: Any) -> Any:
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise InputError(f"{key} is {words}, not {value!r}")
        return value

    return read


def _texts(key: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise InputError(f"{key} is a list of texts, not {value!r}")
    return tuple(value)


def _conditions(key: str, value: Any) -> tuple[tuple[str, ...], ...]:
    if not isinstance(value, list) or not value or not all(isinstance(item, list) for item in value):
        raise InputError(f'{key} is a list of lists, such as [[], ["friction=1.5@300000"]], not {value!r}')
    return tuple(_texts(key, item) for item in value)


def _arguments(key: str, value: Any) -> dict[str, Any]:
    table = _of(dict, "a table")(key, value)
    try:
        json.dumps(table)
    except TypeError:  # TOML has dates and times
        raise InputError(f"{key} holds numbers, texts, lists and tables alone, not {value!r}") from None
    return table


def _common(key: str, value: Any) -> dict[str, dict[str, Any]]:
    tables = _of(dict, "a table of algorithms")(key, value)
    return {name: _of(dict, "a table of hyperparameters")(f"{key}.{name}", given) for name, given in tables.items()}


def _steps_on(key: str, value: Any) -> dict[str, int]:
    table = _of(dict, "a table of tasks and steps")(key, value)
    return {task: _of(int, "a whole number of steps")(f"{key}.{task}", steps) for task, steps in table.items()}


_KEYS: Mapping[str, Callable[[str, Any], Any]] = {
    "title": _of(str, "a text"),
    "tasks": _texts,
    "methods": _methods,
    "common": _common,
    "seeds": _of(int, "a whole number"),
    "first_seed": _of(int, "a whole number"),
    "steps": _of(int, "a whole number"),
    "steps_on": _steps_on,
    "evaluation_interval": _of(int, "a whole number"),
    "evaluation_episodes": _of(int, "a whole number"),
    "conditions": _conditions,
    "environment_arguments": _arguments,
    "events": _texts,
    "rollouts": _of(int, "a whole number"),
    "analyses": _texts,
}

_RANGES: Mapping[str, tuple[int, int]] = {
    "seeds": (1, SEED_LIMIT),
    "first_seed": (0, SEED_LIMIT - 1),
    "steps": (1, STEPS_LIMIT),
    "evaluation_interval": (1, LONGEST_INTERVAL),
    "evaluation_episodes": (1, MOST_EPISODES),
    "rollouts": (0, MOST_EPISODES),
}

_METHOD_KEYS: Mapping[str, Callable[[str, Any], Any]] = {
    "label": _of(str, "a text"),
    "algorithm": _of(str, "a text"),
    "preset": _of(str, "a text"),
    "hyperparameters": _of(dict, "a table"),
    "sweep": _of(dict, "a table of lists"),
    "published": _of(str, "a text"),
}
