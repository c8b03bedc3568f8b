"""manifest.json as a value: what a run is, how far it is and what has happened to it, each field with its type.

What older runs lack has a default: what they did. What is not of its type is refused with its name, so that nobody
who reads a manifest has to look.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
import types
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from csac.types import InputError

SCHEMA_VERSION = 1

State = Literal["running", "finished", "failed", "interrupted"]
STEPS_LIMIT = 2**31 - 1  # learners count their steps in 32 bits
SEED_LIMIT = 2**32  # a key is made of a seed's lowest 32 bits, so that a larger one would be another's twin


@dataclass(frozen=True)
class EvaluationPlan:
    """When a run is evaluated."""

    interval: int = 5_000
    """Environment steps between evaluations."""
    episodes: int = 10
    """Episodes of each evaluation."""
    first_seed: int = 1_000_000
    """What the first of them is reset with; the next ones with the numbers after it."""


@dataclass(frozen=True)
class CheckpointPlan:
    """When a run is saved."""

    interval: int = 50_000
    """Environment steps between checkpoints; 0 makes none."""
    keep: int = 2
    """How many of the newest to keep; 0 keeps all."""


@dataclass(frozen=True)
class Machine:
    """What the last bits of a run depend on, and where it runs."""

    processor: str = ""
    cores: int = 0
    """Cores that the process may use: XLA divides its work for so many."""
    host: str = ""
    gpu: str = ""
    """Its model, where the run computes on one."""
    xla_flags: str | None = None
    """What XLA is told beside its defaults: by the user's XLA_FLAGS, and on a GPU by csac. None: not recorded."""
    matmul_precision: str | None = None
    """Of products, where it is not JAX's default. None: not recorded."""


OTHER_TASK = "task is "  # how a change of the task begins


@dataclass(frozen=True)
class Origin:
    """The checkpoint of another run that a run began with, and what is different in this one."""

    directory: str
    step: int
    changes: tuple[str, ...] = ()

    @property
    def has_other_task(self) -> bool:
        """Whether the checkpoint is of another task."""
        return any(text.startswith(OTHER_TASK) for text in self.changes)

    @property
    def has_other_returns(self) -> bool:
        """Whether returns before it are of another task, or of this one made with other arguments."""
        return any(text.startswith((OTHER_TASK, "environment_arguments")) for text in self.changes)


@dataclass(frozen=True)
class Continuation:
    """That a run was taken up again: when, at which step, and whether it goes on bit for bit."""

    resumed: str
    step: int
    exact: bool
    complaints: tuple[str, ...] = ()
    command: str | None = None
    previous: dict[str, Any] = field(default_factory=dict)
    """What was otherwise before: steps, machine, versions, commit, groups."""


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """A run's manifest. Steps are environment steps per seed; seeds are their labels.

    Raises:
        InputError: numbers that no run can have.
    """

    task: str
    task_is_callable: bool = False
    environment_arguments: dict[str, Any] = field(default_factory=dict)
    perturbations: tuple[str, ...] = ()
    algorithm: str
    hyperparameters: dict[str, Any] = field(default_factory=dict)
    preset: str | None = None
    """The preset that all of these hyperparameters follow, if one does."""
    seeds: tuple[int, ...]
    groups: tuple[tuple[int, ...], ...] = ()
    """The seeds of each group: a seed's numbers depend on it at rounding level."""
    steps: int
    evaluation: EvaluationPlan = EvaluationPlan()
    events: tuple[str, ...] = ()
    checkpoints: CheckpointPlan = CheckpointPlan()
    device: Literal["cpu", "gpu"] = "cpu"
    machine: Machine = Machine()
    versions: dict[str, str] = field(default_factory=dict)
    commit: str | None = None
    command: str | None = None
    process: int | None = None
    forked_from: Origin | None = None
    created: str = ""
    state: State = "running"
    steps_done: int = 0
    last_checkpoint: int = 0
    """Step of the newest checkpoint that was made; 0 before the first."""
    failures: dict[int, str] = field(default_factory=dict)
    """How each seed that failed did."""
    inexact_seeds: tuple[int, ...] = ()
    """Seeds whose environment cannot be saved in mid-episode."""
    history: tuple[Continuation, ...] = ()

    def __post_init__(self) -> None:
        if not self.seeds or not all(0 <= seed < SEED_LIMIT for seed in self.seeds):
            raise InputError(f"seeds are {list(self.seeds)!r:.60}, and are one or more from 0 to {SEED_LIMIT - 1}")
        if not 1 <= self.steps <= STEPS_LIMIT or not 0 <= self.steps_done <= STEPS_LIMIT:
            raise InputError(
                f"steps are {self.steps} with {self.steps_done} done, and lie between 1 and {STEPS_LIMIT:,}"
            )
        if self.evaluation.interval < 1 or self.evaluation.episodes < 1:
            raise InputError("evaluation has an interval or episodes below 1")
        if not 0 <= self.evaluation.first_seed < SEED_LIMIT:
            raise InputError(f"evaluation has the first seed {self.evaluation.first_seed}, which no episode can have")
        if self.checkpoints.interval < 0 or self.checkpoints.keep < 0:
            raise InputError("checkpoints have an interval or a number to keep below 0")

    def steps_of(self, seed: int) -> int:
        """Return how many environment steps a seed has made: those of the run, or those until it failed."""
        failed = re.match(r"step (\d{1,15}):", self.failures.get(seed, ""))
        return int(failed[1]) if failed else self.steps_done


# What every csac has written: where it is missing, its default would be a guess.
_ALWAYS_THERE = ("environment_arguments", "hyperparameters", "evaluation", "state", "steps_done", "failures")


class NewerError(InputError):
    """A manifest of a schema that is not known yet."""


def read(content: bytes) -> Manifest:
    """Return the manifest in a file's content. Raises InputError with what is wrong with it."""
    try:
        fields = json.loads(content)
    except (ValueError, RecursionError):
        raise InputError("it is not JSON") from None
    if not isinstance(fields, dict):
        raise InputError("it is not a JSON object")
    version = fields.pop("schema_version", None)
    if isinstance(version, int) and version > SCHEMA_VERSION:
        raise NewerError(f"its schema version is {version}, and this csac reads {SCHEMA_VERSION}")
    if version != SCHEMA_VERSION or isinstance(version, bool):
        raise InputError(f"its schema version is {version!r:.20}, and this csac reads {SCHEMA_VERSION}")
    for name in _ALWAYS_THERE:
        if name not in fields:
            raise InputError(f"{name!r} is missing")
    return _value(Manifest, fields, "")


def written(manifest: Manifest) -> bytes:
    """Return the content of the file that `read` takes. Raises InputError for what JSON cannot hold."""
    try:
        fields = {"schema_version": SCHEMA_VERSION, **dataclasses.asdict(manifest)}
        return (json.dumps(fields, indent=2, default=_plain) + "\n").encode()
    except TypeError as error:
        raise InputError(f"the manifest cannot hold this: {error}; use numbers, strings, lists and dicts") from None


def as_kept(manifest: Manifest) -> Manifest:
    """Return the manifest as it is read back: with lists for arrays and tuples, and texts for paths.

    So it can be compared with one from a file. Raises InputError for what JSON cannot hold.
    """
    return read(written(manifest))


def differences(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Return "name is X, not Y" for each value that differs, in nested dicts too."""
    lines = []
    for name in sorted(before.keys() | now.keys()):
        old, new = _listed(before.get(name)), _listed(now.get(name))
        if isinstance(old, dict) and isinstance(new, dict):
            lines += differences(old, new, f"{name}." if name in ("evaluation", "environment_arguments") else "")
        elif not _is_same(old, new):
            lines.append(f"{prefix}{name} is {old!r}, not {new!r}")
    return lines


def _value(kind: Any, given: Any, name: str) -> Any:
    """Return a JSON value as one of this type. Raises InputError, with its name, where it is none."""
    if dataclasses.is_dataclass(kind):
        return _dataclass(kind, given, name)
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return given
    if origin in (Union, types.UnionType):
        return None if given is None else _value(arguments[0], given, name)
    if origin is Literal and given in arguments and isinstance(given, str):
        return given
    if origin is tuple and isinstance(given, list):
        return tuple(_value(arguments[0], item, name) for item in given)
    if origin is dict and isinstance(given, dict):
        return {_key(arguments[0], key, name): _value(arguments[1], item, name) for key, item in given.items()}
    if kind in (int, str, bool) and type(given) is kind:
        return given
    raise InputError(f"{name!r} is {given!r:.60}, not {_called(kind)}")


def _dataclass(kind: Any, given: Any, name: str) -> Any:
    if not isinstance(given, dict):
        raise InputError(f"{name!r} is {given!r:.60}, not a JSON object")
    hints, values = get_type_hints(kind), {}
    for item in dataclasses.fields(kind):
        path = f"{name}.{item.name}".lstrip(".")
        if item.name in given:
            values[item.name] = _value(hints[item.name], given[item.name], path)
        elif item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING:
            raise InputError(f"{path!r} is missing")
    return kind(**values)


def _key(kind: type, key: str, name: str) -> Any:
    if kind is str:
        return key
    if not (key.isascii() and key.isdecimal() and len(key) <= 15):
        raise InputError(f"{name!r} has the key {key!r:.20}, not a number")
    return int(key)


def _called(kind: Any) -> str:
    names = {int: "a whole number", str: "a text", bool: "true or false", tuple: "a list", dict: "a JSON object"}
    origin = get_origin(kind) or kind
    return names.get(origin) or f"one of {', '.join(map(str, get_args(kind)))}"


def _is_same(old: Any, new: Any) -> bool:
    """Whether two values from JSON are equal; one that is not a number equals itself here."""
    if isinstance(old, list) and isinstance(new, list):
        return len(old) == len(new) and all(map(_is_same, old, new))
    if isinstance(old, dict) and isinstance(new, dict):
        return old.keys() == new.keys() and all(_is_same(old[key], new[key]) for key in old)
    return old == new or (old != old and new != new)


def _listed(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):  # NumPy's numbers and arrays
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"{value!r} is a {type(value).__name__}")
