"""A trained policy as an artefact: plain layers and the contract with the task, run by NumPy alone."""

from __future__ import annotations

import csv
import json
import math
import os
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import safetensors
import safetensors.numpy

from csac.types import InputError, Layer, PolicyNetwork, Spec

if TYPE_CHECKING:
    from collections.abc import Mapping

SCHEMA_VERSION = 1
LOG_STD_RANGE = (-20.0, 2.0)
EVALUATION_POINTS = 3

Activation = Literal["relu", "tanh"]
Head = Literal["tanh_gaussian"]
Which = Literal["last", "best"]


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

    def save(self, path: str | Path) -> None:
        """Write the contract as JSON, whole or not at all."""
        fields = {
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
        _write(Path(path), (json.dumps(fields, indent=2) + "\n").encode())

    @staticmethod
    def load(path: str | Path) -> Contract:
        """Read a contract.

        Raises:
            InputError: no such file, or one that is not a contract of this schema.
        """
        try:
            fields = json.loads(_read(Path(path)))
        except ValueError as error:
            raise InputError(f"{path} is not valid JSON ({error}): restore it from a copy") from error
        try:
            return _contract(fields)
        except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
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


class Policy:
    """A policy network on NumPy, with `predict` in Stable-Baselines3's shape.

    Args:
        network: the layers; copied, so that the caller may donate or change them afterwards.
        contract: how observations become flat and actions leave [-1, 1].
        seed: of the generator that stochastic actions draw from.

    Raises:
        InputError: layers that do not fit each other or the contract.
    """

    def __init__(self, network: PolicyNetwork, contract: Contract, seed: int = 0) -> None:
        layers = tuple(
            Layer(*(np.array(array, dtype=np.float32, order="C") for array in layer)) for layer in network.actor
        )
        self.network = network._replace(actor=layers)
        self.contract = contract
        _check_layers(self.network, contract)
        self._generator = np.random.default_rng(seed)
        self._action_size = size = contract.spec.action_size
        self._hidden = layers[:-1]
        weight, bias = layers[-1]
        self._mean = Layer(np.ascontiguousarray(weight[:, :size]), bias[:size])
        self._log_std = Layer(np.ascontiguousarray(weight[:, size:]), bias[size:])

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return the action on the environment's scale, and `state` as it came.

        One observation gives float32 [*action_shape], a batch of n (or a dict of such batches) [n, *action_shape].

        Raises:
            InputError: an observation that is not of the task's shape.
        """
        flat = self.contract.flatten(observation)
        actions = self.act(np.atleast_2d(flat), deterministic)
        return self.contract.to_environment(actions if flat.ndim == 2 else actions[0]), state

    def act(self, observations: np.ndarray, deterministic: bool = True, noise: np.ndarray | None = None) -> np.ndarray:
        """Return actions in [-1, 1], [n, action], for flat float32 observations [n, observation].

        A stochastic action is tanh(mean + std * noise); `noise`, standard normal [n, action], is drawn where not given.
        """
        hidden = observations
        for weight, bias in self._hidden:
            hidden = hidden @ weight
            hidden += bias
            _activate(hidden, self.network.activation)
        action = hidden @ self._mean.weight
        action += self._mean.bias
        if not deterministic:
            if noise is None:
                noise = self._generator.standard_normal(action.shape, dtype=np.float32)
            std = hidden @ self._log_std.weight + self._log_std.bias
            action += np.exp(np.clip(std, *LOG_STD_RANGE)) * noise
        return np.tanh(action, out=action)

    def save(self, path: str | Path) -> None:
        """Write the layers as safetensors, whole or not at all."""
        tensors = {
            f"actor.{index}.{name}": array
            for index, layer in enumerate(self.network.actor)
            for name, array in layer._asdict().items()
        }
        _write(Path(path), safetensors.numpy.save(tensors))

    @staticmethod
    def load(path: str | Path, contract: Contract, seed: int = 0) -> Policy:
        """Read a policy.

        Raises:
            InputError: no such file, a damaged one, or one that does not fit the contract.
        """
        try:
            tensors = safetensors.numpy.load(_read(Path(path)))
        except (safetensors.SafetensorError, KeyError, ValueError) as error:
            raise InputError(f"{path} is damaged ({error}): restore it from a copy") from error
        try:
            network = PolicyNetwork(_layers(tensors), contract.activation, contract.head)
            return Policy(network, contract, seed)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error


def load(directory: str | Path, seed: int | None = None, which: Which = "last") -> Policy:
    """Return a policy of a run.

    Args:
        directory: the run directory.
        seed: the seed's label; by default the seed with the best mean return over its last three evaluation points.
            That choice favours a lucky seed: report the policy on fresh evaluation seeds.
        which: the seed's `last` policy, or the one of its `best` evaluation.

    Raises:
        InputError: no run there, no such seed (the message names those there), or a damaged file.
    """
    directory = Path(directory)
    if which not in get_args(Which):
        raise InputError(f"which={which!r}: choose 'last' or 'best'")
    if not directory.is_dir():
        raise InputError(f"{directory} is not a directory: give the directory of a run")
    folder = directory / "policy"
    seeds = _seeds(folder)
    if not seeds:
        raise InputError(f"{directory} holds no policies: give the directory of a run that has been evaluated once")
    if seed is None:
        seed = _best_seed(directory / "evaluations.csv", seeds)
    elif seed not in seeds:
        raise InputError(f"{directory} has no policy of seed {seed}; it has those of {_listed(seeds)}")
    name = f"seed_{seed}.safetensors" if which == "last" else f"seed_{seed}.best.safetensors"
    return Policy.load(folder / name, Contract.load(folder / "contract.json"))


def _seeds(folder: Path) -> list[int]:
    names = (re.fullmatch(r"seed_(\d+)\.safetensors", path.name) for path in folder.glob("seed_*.safetensors"))
    return sorted(int(match[1]) for match in names if match)


def _best_seed(path: Path, seeds: list[int]) -> int:
    if len(seeds) == 1:
        return seeds[0]
    scores = _last_evaluations(path)
    ranked = [(scores[seed], -seed) for seed in seeds if seed in scores]
    if not ranked:
        raise InputError(f"{path} has no evaluations to choose by: give a seed, one of {_listed(seeds)}")
    return -max(ranked)[1]


def _last_evaluations(path: Path) -> dict[int, float]:
    """Each seed's mean return over its last evaluation points; a line that is still being written does not count."""
    text = path.read_text() if path.is_file() else ""
    points: dict[int, dict[int, list[float]]] = {}
    try:
        for row in csv.DictReader(text[: text.rfind("\n") + 1].splitlines()):
            points.setdefault(int(row["seed"]), {}).setdefault(int(row["step"]), []).append(float(row["return"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}): give a seed, or restore it from a copy") from error
    means = {seed: [np.mean(returns[step]) for step in sorted(returns)] for seed, returns in points.items()}
    scores = {seed: float(np.mean(mean[-EVALUATION_POINTS:])) for seed, mean in means.items()}
    return {seed: score for seed, score in scores.items() if not math.isnan(score)}


def _listed(seeds: list[int]) -> str:
    return ", ".join(str(seed) for seed in seeds)


def _activate(array: np.ndarray, activation: str) -> None:
    if activation == "relu":
        np.maximum(array, 0, out=array)
    else:
        np.tanh(array, out=array)


def _check_layers(network: PolicyNetwork, contract: Contract) -> None:
    observation_size, action_size = contract.spec
    if network.activation not in get_args(Activation) or network.head not in get_args(Head):
        raise InputError(f"the policy's activation {network.activation!r} or head {network.head!r} is not known")
    if (network.activation, network.head) != (contract.activation, contract.head):
        raise InputError(f"the policy is {network.activation}/{network.head}, not as the contract says")
    if not network.actor:
        raise InputError("the policy has no layers")
    width = observation_size
    for index, (weight, bias) in enumerate(network.actor):
        if weight.ndim != 2 or bias.shape != weight.shape[1:] or weight.shape[0] != width:
            raise InputError(f"actor layer {index} has shapes {weight.shape} and {bias.shape} after {width} inputs")
        width = weight.shape[1]
    if width != 2 * action_size:
        raise InputError(f"the policy gives {width} outputs where the task's {action_size} actions take twice as many")


def _layers(tensors: dict[str, np.ndarray]) -> tuple[Layer, ...]:
    names = [(f"actor.{index}.weight", f"actor.{index}.bias") for index in range(len(tensors) // 2)]
    if set(tensors) != {name for pair in names for name in pair}:
        raise InputError(f"not the layers of an actor: {sorted(tensors)}")
    if any(array.dtype != np.float32 or not np.isfinite(array).all() for array in tensors.values()):
        raise InputError("its numbers are not finite float32: restore it from a copy")
    return tuple(Layer(tensors[weight], tensors[bias]) for weight, bias in names)


def _contract(fields: Any) -> Contract:
    if fields["schema_version"] != SCHEMA_VERSION:
        raise ValueError(f"schema_version {fields['schema_version']!r} where this csac reads {SCHEMA_VERSION}")
    parts = tuple((part["key"], _shape(part["shape"])) for part in fields["observation_parts"])
    action_shape = _shape(fields["action_shape"])
    low, high = (np.array(fields[name], dtype=np.float32) for name in ("action_low", "action_high"))
    keys = [key for key, _ in parts]
    named = all(isinstance(key, str) for key in keys) and keys == sorted(set(keys))
    if keys != [None] and not (keys and named):
        raise ValueError("observation_parts are not one plain part or sorted, distinct keys")
    if low.shape != (math.prod(action_shape),) or high.shape != low.shape:
        raise ValueError("action bounds and action_shape disagree")
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
        raise ValueError("action bounds are not finite and in order")
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
    return tuple(numbers)


def _as_float32(value: Any, name: str) -> np.ndarray:
    try:
        return np.asarray(value, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is not an array of numbers: {error}") from error


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error


def _write(path: Path, content: bytes) -> None:
    """Write aside, then rename: a crash leaves the old file or the new one."""
    aside = path.with_name(path.name + ".tmp")
    with aside.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    aside.replace(path)
