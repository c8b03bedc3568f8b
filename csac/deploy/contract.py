"""What a policy and its task agree on: flattening, shapes and action bounds, kept as JSON beside the policy."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from csac.record.files import write_atomically
from csac.types import InputError, Spec

if TYPE_CHECKING:
    from collections.abc import Mapping

SCHEMA_VERSION = 1
MOST_AXES = 31  # of a shape; a batch has one more, and NumPy 1 holds 32
FLOAT32_MAX = float(np.finfo(np.float32).max)
BOUNDS_ROUNDING = 1e-6  # of a bound: a few times what float32 rounds by

Activation = Literal["relu", "tanh"]
Head = Literal["tanh_gaussian", "tanh", "clipped_gaussian"]


class ActionBounds:
    """The affine map from [-1, 1] to the environment's float32 bounds [action]."""

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        self._low, self._high = low, high
        # Halved first, so that a wide range does not overflow.
        self._half, self._centre = 0.5 * high - 0.5 * low, 0.5 * high + 0.5 * low

    def scale(self, action: np.ndarray) -> np.ndarray:
        """Return a new array of actions [..., action], clipped so that rounding does not leave the bounds."""
        scaled = action * self._half
        scaled += self._centre
        np.maximum(scaled, self._low, out=scaled)
        return np.minimum(scaled, self._high, out=scaled)


@dataclass(frozen=True, eq=False)
class Contract:
    """What the policy and its task agree on: how observations are flattened and what actions mean.

    `observation_parts` lists (key, shape) in the order of the flat observation: one part with the key None for a plain
    Box, else the parts of a Dict sorted by name. Actions inside lie in [-1, 1]; `action_low` and `action_high`,
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

    @property
    def spec(self) -> Spec:
        """The flat sizes of observation and action."""
        observation_size = sum(math.prod(shape) for _, shape in self.observation_parts)
        return Spec(observation_size, math.prod(self.action_shape))

    def flatten(self, observation: Any) -> np.ndarray:
        """Return `observation` as float32 [observation], or a batch of them as [n, observation].

        Takes what the environment gives (an array, or a dict of arrays), a batch of it, or what is flat already.

        Raises:
            InputError: keys or shapes that the task does not have.
        """
        size = self.spec.observation_size
        if isinstance(observation, dict):
            return self._flatten_dict(observation)
        array = _as_float32(observation, "the observation")
        key, shape = self.observation_parts[0]
        if key is None:
            if array.shape == shape:
                return array.reshape(size)
            if array.shape[1:] == shape and array.ndim:
                return array.reshape(len(array), size)
        if array.ndim in (1, 2) and array.shape[-1] == size:
            return array
        expected = shape if key is None else f"a dict of {self._keys()}"
        raise InputError(f"the observation has shape {array.shape}; the policy takes {expected}, or a batch of it")

    def to_environment(self, action: np.ndarray) -> np.ndarray:
        """Return actions of [-1, 1], [..., action], on the environment's scale: float32 [..., *action_shape]."""
        return self._bounds.scale(action).reshape(action.shape[:-1] + self.action_shape)

    def fields(self) -> dict[str, Any]:
        """Return what its JSON holds."""
        return {
            "schema_version": SCHEMA_VERSION,
            "task": self.task,
            "algorithm": self.algorithm,
            "activation": self.activation,
            "head": self.head,
            "observation_parts": [{"key": key, "shape": list(shape)} for key, shape in self.observation_parts],
            "action_shape": list(self.action_shape),
            "action_low": self.action_low.tolist(),
            "action_high": self.action_high.tolist(),
        }

    def save(self, path: str | Path) -> None:
        """Write the contract as JSON, whole or not at all."""
        write_atomically(Path(path), (json.dumps(self.fields(), indent=2) + "\n").encode())

    @staticmethod
    def load(path: str | Path) -> Contract:
        """Read a contract.

        Raises:
            InputError: no such file, or one that is not a contract of this schema.
        """
        return Contract.of_fields(read_json(Path(path)), path)

    @staticmethod
    def of_fields(fields: Any, path: str | Path) -> Contract:
        """Return the contract that `fields` made these of, whatever else there is. Raises InputError for others."""
        try:
            return _contract(fields)
        except (KeyError, TypeError, ValueError) as error:
            reason = f"no {error}" if isinstance(error, KeyError) else error
            raise InputError(f"{path} is not a policy contract ({reason}): restore it from a copy") from error

    @cached_property
    def _bounds(self) -> ActionBounds:
        return ActionBounds(self.action_low, self.action_high)

    def _flatten_dict(self, observation: Mapping[str | None, Any]) -> np.ndarray:
        if set(observation) != {key for key, _ in self.observation_parts}:
            raise InputError(
                f"the observation has the keys {sorted(observation, key=str)}; the policy takes {self._keys()}"
            )
        flat = []
        for key, shape in self.observation_parts:
            array = _as_float32(observation[key], f"observation[{key!r}]")
            lead = array.shape[: array.ndim - len(shape)]
            if array.ndim - len(shape) not in (0, 1) or array.shape != lead + shape:
                raise InputError(f"observation[{key!r}] has shape {array.shape}; the policy takes {shape}, or a batch")
            flat.append(array.reshape((*lead, math.prod(shape))))
        if len({part.shape[:-1] for part in flat}) > 1:
            raise InputError("the parts of the observation differ in batch size: give every key as many rows")
        return np.concatenate(flat, axis=-1)

    def _keys(self) -> list[str] | str:
        keys = [key for key, _ in self.observation_parts if key is not None]
        return keys or "one array and no dict"


def _contract(fields: Any) -> Contract:
    if fields["schema_version"] != SCHEMA_VERSION:
        raise ValueError(f"schema_version {fields['schema_version']!r} where this csac reads {SCHEMA_VERSION}")
    parts = tuple((part["key"], _shape(part["shape"])) for part in fields["observation_parts"])
    action_shape = _shape(fields["action_shape"])
    low, high = _bounds(fields["action_low"]), _bounds(fields["action_high"])
    keys = [key for key, _ in parts]
    named = all(isinstance(key, str) for key in keys) and keys == sorted(set(keys))
    if keys != [None] and not (keys and named):
        raise ValueError("observation_parts are not one plain part or sorted, distinct keys")
    if low.shape != (math.prod(action_shape),) or high.shape != low.shape:
        raise ValueError("action bounds and action_shape disagree")
    if not (low <= high).all():
        raise ValueError("action bounds are not in order")
    if fields["activation"] not in get_args(Activation) or fields["head"] not in get_args(Head):
        raise ValueError(f"activation {fields['activation']!r} or head {fields['head']!r} is not known")
    if not isinstance(fields["algorithm"], str) or not isinstance(fields["task"], str | None):
        raise TypeError("task or algorithm is not a name")
    return Contract(
        fields["task"], fields["algorithm"], fields["activation"], fields["head"], parts, action_shape, low, high
    )


def _shape(numbers: Any) -> tuple[int, ...]:
    if not isinstance(numbers, list) or not all(type(number) is int and number > 0 for number in numbers):
        raise ValueError(f"{numbers!r} is not a shape")
    if len(numbers) > MOST_AXES:
        raise ValueError(f"a shape of {len(numbers)} axes")
    return tuple(numbers)


def _bounds(numbers: Any) -> np.ndarray:
    """Return float32 [action]. Raises ValueError where a number is none, or more than float32 can hold."""
    if not isinstance(numbers, list) or not all(type(number) in (int, float) for number in numbers):
        raise ValueError("action bounds are not lists of numbers")
    if not all(abs(number) <= FLOAT32_MAX for number in numbers):
        raise ValueError("action bounds are not finite")
    return np.array(numbers, np.float32)


def _as_float32(value: Any, name: str) -> np.ndarray:
    try:
        return np.asarray(value, dtype=np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(value, tuple) and len(value) == 2 and isinstance(value[1], dict):
            raise InputError(f"{name} is all that reset() returns: write observation, info = env.reset()") from None
        raise InputError(f"{name} is not an array of numbers: {error}") from error


def read_file(path: Path) -> bytes:
    """Return a file's content. Raises InputError where it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        advice = ": restore it from a copy" if isinstance(error, FileNotFoundError) else ""
        raise InputError(f"{path} cannot be read: {error.strerror}{advice}") from error


def read_json(path: Path) -> Any:
    """Return what a JSON file holds. Raises InputError where it cannot be read, or is none."""
    content = read_file(path)
    try:
        return json.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON ({error}): restore it from a copy") from error
