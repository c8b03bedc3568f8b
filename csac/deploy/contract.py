"""The contract of a policy with its task: flattening, shapes and action bounds, kept as JSON beside the policy."""

from __future__ import annotations

import hashlib
import json
import math
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from csac.checks import without_controls
from csac.record.files import write_atomically
from csac.types import Activation, Head, InputError, Spec

if TYPE_CHECKING:
    from collections.abc import Mapping

CONTRACT = "contract.json"
SCHEMA_VERSION = 2
FLOAT32_MAX = float(np.finfo(np.float32).max)
BOUNDS_ROUNDING = 1e-6  # relative to the bound: a few times float32's rounding error


class ActionBounds:
    """The affine map from [-1, 1] to the environment's float32 bounds [action]."""

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        self._low, self._high = low, high
        # Halved first, so that a wide range does not overflow.
        self.half, self.centre = 0.5 * high - 0.5 * low, 0.5 * high + 0.5 * low

    def scale(self, action: np.ndarray) -> np.ndarray:
        """Map actions [..., action] to the bounds, in a new array; clipped, since rounding may exceed them."""
        scaled = action * self.half
        scaled += self.centre
        np.maximum(scaled, self._low, out=scaled)
        return np.minimum(scaled, self._high, out=scaled)

    def unscale(self, action: np.ndarray) -> np.ndarray:
        """Map actions [..., action] on the environment's scale to [-1, 1]; 0 where both bounds are the same."""
        return (action - self.centre) / np.where(self.half > 0, self.half, 1.0)


@dataclass(frozen=True, eq=False)
class Contract:
    """The contract of a policy with its task: how observations are flattened and what actions mean.

    `observation_parts` lists (key, shape) in the order of the flat observation: one part with the key None for a plain
    Box, else the parts of a Dict sorted by name. The network's actions lie in [-1, 1]; `action_low` and `action_high`,
    float32 [action], are the environment's bounds.
    """

    task: str | None
    algorithm: str
    activation: Activation
    head: Head
    observation_parts: tuple[tuple[str | None, tuple[int, ...]], ...]
    action_shape: tuple[int, ...]
    action_low: np.ndarray
    action_high: np.ndarray
    critic_activation: Activation = "relu"

    @property
    def spec(self) -> Spec:
        """The flat sizes of observation and action."""
        observation_size = sum(math.prod(shape) for _, shape in self.observation_parts)
        return Spec(observation_size, math.prod(self.action_shape))

    @cached_property
    def bounds(self) -> ActionBounds:
        """The map from [-1, 1] to the environment's actions."""
        return ActionBounds(self.action_low, self.action_high)

    def flatten(self, observation: Any) -> np.ndarray:
        """Return `observation` as float32 [observation], or a batch of them as [n, observation].

        Accepts the environment's observations (an array, or a dict of arrays), batches of them, and flat arrays.
        """
        if isinstance(observation, dict):
            return self._flatten_dict(observation)
        array = _as_float32(observation, "the observation")
        key, shape = self.observation_parts[0]
        for expected in [shape] * (key is None) + [(self.spec.observation_size,)]:
            if (flat := _flat(array, expected)) is not None:
                return flat
        accepted = shape if key is None else f"a dict of {[key for key, _ in self.observation_parts]}"
        raise InputError(f"the observation has shape {array.shape}; the policy takes {accepted}, or a batch of it")

    def to_environment(self, action: np.ndarray) -> np.ndarray:
        """Map actions from [-1, 1], [..., action], to the environment's scale: float32 [..., *action_shape]."""
        return self.bounds.scale(action).reshape(action.shape[:-1] + self.action_shape)

    def fields(self) -> dict[str, Any]:
        """Return the content of its JSON file."""
        return {
            "schema_version": SCHEMA_VERSION,
            "task": self.task,
            "algorithm": self.algorithm,
            "activation": self.activation,
            "head": self.head,
            **({} if self.critic_activation == "relu" else {"critic_activation": self.critic_activation}),
            "observation_parts": [{"key": key, "shape": list(shape)} for key, shape in self.observation_parts],
            "action_shape": list(self.action_shape),
            "action_low": self.action_low.tolist(),
            "action_high": self.action_high.tolist(),
        }

    @staticmethod
    def of_fields(fields: Any, path: str | Path) -> Contract:
        """Return the contract with these `fields`. Raises InputError, naming `path`, if they are invalid."""
        try:
            return _contract(fields)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            reason = f"no {error}" if isinstance(error, KeyError) else error
            raise InputError(f"{path} is not a policy contract ({reason}): restore it from a copy") from error

    def _flatten_dict(self, observation: Mapping[str | None, Any]) -> np.ndarray:
        keys = [key for key, _ in self.observation_parts]
        if (given_keys := sorted(observation, key=str)) != keys:
            accepted = "one array and no dict" if keys == [None] else keys
            raise InputError(f"the observation has the keys {given_keys}; the policy takes {accepted}")
        parts = []
        for key, shape in self.observation_parts:
            array = _as_float32(observation[key], f"observation[{key!r}]")
            if (flat := _flat(array, shape)) is None:
                raise InputError(f"observation[{key!r}] has shape {array.shape}; the policy takes {shape}, or a batch")
            parts.append(flat)
        if len({part.shape[:-1] for part in parts}) > 1:
            raise InputError("the observation's parts are not all batches of one size")
        return np.concatenate(parts, axis=-1)


def _flat(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return an array of this shape as [size], a batch of such arrays as [n, size], and None for any other shape."""
    if array.shape != shape and (array.ndim == 0 or array.shape[1:] != shape):
        return None
    return array.reshape((*array.shape[: array.ndim - len(shape)], math.prod(shape)))


def _contract(fields: Any) -> Contract:
    if fields["schema_version"] != SCHEMA_VERSION:
        raise ValueError(f"schema_version {fields['schema_version']!r} where this csac reads {SCHEMA_VERSION}")
    fields = {"critic_activation": "relu", **fields}
    names = {"activation": get_args(Activation), "critic_activation": get_args(Activation), "head": get_args(Head)}
    for name, known in names.items():
        if fields[name] not in known:
            raise ValueError(f"{name} {fields[name]!r} is not known")
    parts = tuple((part["key"], _shape(part["shape"])) for part in fields["observation_parts"])
    keys = [key for key, _ in parts]
    if keys != [None] and not (keys and all(isinstance(key, str) for key in keys) and keys == sorted(set(keys))):
        raise ValueError("observation_parts are not one plain part or sorted, distinct keys")
    action_shape = _shape(fields["action_shape"])
    with np.errstate(over="ignore"):  # overflow gives infinity, which is refused below
        low, high = (np.array(fields[name], np.float32) for name in ("action_low", "action_high"))
    if not low.shape == high.shape == (math.prod(action_shape),):
        raise ValueError("action bounds and action_shape disagree")
    if not (np.isfinite([low, high]).all() and (low <= high).all()):
        raise ValueError("action bounds are not finite or not in order")
    texts = {name: fields[name] for name in ("task", "algorithm", *names)}
    return Contract(**texts, observation_parts=parts, action_shape=action_shape, action_low=low, action_high=high)


def _shape(numbers: Any) -> tuple[int, ...]:
    if not isinstance(numbers, list) or not all(type(number) is int and number > 0 for number in numbers):
        raise ValueError(f"{numbers!r:.40} is not a shape")
    return tuple(numbers)


def _as_float32(value: Any, name: str) -> np.ndarray:
    try:
        return np.asarray(value, dtype=np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(value, tuple) and len(value) == 2 and isinstance(value[1], dict):
            raise InputError(f"{name} is all that reset() returns: write observation, info = env.reset()") from None
        raise InputError(f"{name} is not an array of numbers: {error}") from error


def write_with_checksum(path: Path, content: bytes, fields: Mapping[str, Any] | None = None) -> None:
    """Write a file, and its SHA-256 into the `contract.json` beside it. Raises OSError.

    During the write the contract lists the checksums of the old and the new file: a kill leaves a file that matches.
    `fields`, if given, become the contract; if they differ from its old fields, other files' checksums are dropped.
    """
    contract_path, kept_fields = path.with_name(CONTRACT), {}
    with suppress(InputError):  # missing or damaged
        kept_fields |= read_json(contract_path)
    checksums = kept_fields.pop("sha256", {})
    if fields is not None and kept_fields != {**fields}:
        kept_fields, checksums = {**fields}, {}
    old, new = checksums.get(path.name, ""), hashlib.sha256(content).hexdigest()

    def write_contract(checksum: str) -> None:
        write_json(contract_path, {**kept_fields, "sha256": dict(sorted({**checksums, path.name: checksum}.items()))})

    current = sha256_of(path) if path.exists() else ""
    write_contract(f"{new} {current}" if current in old else new)
    write_atomically(path, content)
    write_contract(new)


def check_checksum(path: Path, fields: Mapping[str, Any]) -> None:
    """Raise InputError if the contract's `fields` have no checksum of a file, or a different one."""
    checksums = fields.get("sha256")
    if not isinstance(checksums, dict) or sha256_of(path) not in str(checksums.get(path.name)):
        raise InputError(f"{path} does not match its checksum in {CONTRACT}: restore both from a copy")


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits. Raises InputError if it cannot be read."""
    return hashlib.sha256(read_file(path)).hexdigest()


def read_file(path: Path) -> bytes:
    """Return a file's content. Raises InputError if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        advice = ": restore it from a copy" if isinstance(error, FileNotFoundError) else ""
        raise InputError(f"{path} cannot be read: {error.strerror}{advice}") from error


def read_json(path: Path) -> Any:
    """Return the content of a JSON file. Raises InputError if it cannot be read or parsed."""
    content = read_file(path)
    try:
        return json.loads(without_controls(content).decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON ({error}): restore it from a copy") from error


def write_json(path: Path, fields: Mapping[str, Any]) -> None:
    """Write `fields` as JSON, atomically."""
    write_atomically(path, (json.dumps(fields, indent=2, allow_nan=False) + "\n").encode())
