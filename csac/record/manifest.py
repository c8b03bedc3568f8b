"""The content of manifest.json: a run's configuration, origin, progress and history."""

from __future__ import annotations

import dataclasses
import json
import types
from dataclasses import dataclass, field
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from csac.checks import without_controls
from csac.record.config import RunConfig
from csac.types import InputError

SCHEMA_VERSION = 2

State = Literal["running", "finished", "failed", "interrupted"]


@dataclass(frozen=True)
class Machine:
    """The machine that runs a run: where it is, and what the last bits of its numbers depend on."""

    processor: str = ""
    cores: int = 0
    """CPU cores that XLA divides its work among."""
    host: str = ""
    gpu: str = ""
    """The GPU's model, if the run computes on one."""
    xla_flags: str = ""
    matmul_precision: str = ""


@dataclass(frozen=True)
class Origin:
    """The other run's checkpoint that a run was forked from, and which of its settings differ."""

    directory: str
    step: int
    changes: tuple[str, ...] = ()
    earlier: tuple[str, ...] = ()
    """What earlier forks changed, if that run was forked too."""
    task_since: int = 0
    """The step of the last fork, this one or an earlier one, that changed the task or its arguments."""

    def changed(self, *names: str) -> bool:
        """Return whether one of these settings was changed."""
        return any(text.startswith(names) for text in self.changes)


@dataclass(frozen=True)
class Continuation:
    """A resume of a run: when, at which step, and whether it is bit for bit as if the run had never stopped."""

    resumed: str
    step: int
    exact: bool
    notes: tuple[str, ...] = ()
    command: str | None = None
    previous: dict[str, Any] = field(default_factory=dict)
    """Steps, machine, versions and commit before the resume."""


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """A run's manifest."""

    config: RunConfig
    program: tuple[int, ...] = ()
    """The seeds that share the run's compiled program; the last bits of its numbers depend on how many there are."""
    machine: Machine = Machine()
    versions: dict[str, str] = field(default_factory=dict)
    commit: str | None = None
    command: str | None = None
    process: int | None = None
    created: str = ""
    state: State = "running"
    steps_done: int = 0
    last_checkpoint: int = 0
    """Step of the newest checkpoint; 0 before the first."""
    failure: str = ""
    """Why the run failed, if it did."""
    restarts_episode: bool = False
    """Whether a resume restarts the current episode, because the environment cannot be saved."""
    forked_from: Origin | None = None
    history: tuple[Continuation, ...] = ()


def read(content: bytes) -> Manifest:
    """Parse the content of a manifest file. Raises InputError that says what is wrong with it."""
    try:
        fields = json.loads(without_controls(content))
        version = fields.pop("schema_version", None)
    except (ValueError, RecursionError, AttributeError, TypeError):
        raise InputError("it is not a JSON object") from None
    if version != SCHEMA_VERSION:
        raise InputError(
            f"it has schema version {version!r:.20} and this csac reads {SCHEMA_VERSION}: use its own csac"
        )
    return parsed(Manifest, fields, "")


def written(manifest: Manifest) -> bytes:
    """Return the content of the manifest's file, which `read` parses."""
    fields = {"schema_version": SCHEMA_VERSION, **dataclasses.asdict(manifest)}
    return (json.dumps(fields, indent=2) + "\n").encode()


_TYPE_NAMES = {int: "a whole number", str: "a text", bool: "true or false", tuple: "a list"}


def parsed(kind: Any, given: Any, name: str) -> Any:
    """Return a JSON value as a value of type `kind`. Raises InputError, naming `name`, if it has another type."""
    origin, arguments = get_origin(kind), get_args(kind)
    if dataclasses.is_dataclass(kind) and isinstance(given, dict):
        return _dataclass(kind, given, name)
    if kind is Any:
        return given
    if origin in (Union, types.UnionType):
        return None if given is None else parsed(arguments[0], given, name)
    if origin is Literal and isinstance(given, str) and given in arguments:
        return given
    if origin is tuple and isinstance(given, list):
        return tuple(parsed(arguments[0], item, name) for item in given)
    if origin is dict and isinstance(given, dict):
        return {key: parsed(arguments[1], item, name) for key, item in given.items()}
    if kind in (int, str, bool) and type(given) is kind:
        return given
    expected = " or ".join(map(repr, arguments)) if origin is Literal else _TYPE_NAMES.get(origin or kind, "a table")
    raise InputError(f"{name!r} is {given!r:.60}, not {expected}")


def _dataclass(kind: Any, given: dict[str, Any], name: str) -> Any:
    hints, values = get_type_hints(kind), {}
    for item in dataclasses.fields(kind):
        path = f"{name}.{item.name}".lstrip(".")
        if item.name in given:
            values[item.name] = parsed(hints[item.name], given[item.name], path)
        elif item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING:
            raise InputError(f"{path!r} is missing")
    return kind(**values)
