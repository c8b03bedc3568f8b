"""A trained policy as an artefact: plain layers and the contract with the task, run by NumPy alone."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csac.checks import check_flag, check_path
from csac.deploy import tensors
from csac.deploy.contract import Activation, Contract, read_file
from csac.deploy.parameters import check_network, copied, from_tensors, to_tensors
from csac.record.files import write_atomically
from csac.types import InputError, Layer, Normaliser, PolicyNetwork

CONTRACT, SAVED = "contract.json", "policy.safetensors"  # in the folder of a policy that was saved by itself
LOG_STD_RANGE = (-20.0, 2.0)

_STEP = "step"  # of a file's metadata: what a run before this had not got
_STREAM = 0x706F6C69  # far from what a task that spawns generators of its own would use: 0, 1, 2, ...


def noise_generator(seed: int) -> np.random.Generator:
    """Return what the stochastic actions of `seed` are drawn from.

    Gymnasium gives `default_rng(seed)` to a task that is reset with `seed`. This is another stream: actions drawn from
    the same numbers as the task's own chances would foresee them.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STREAM,)))


class Policy:
    """A policy network on NumPy, with `predict` in Stable-Baselines3's shape.

    Args:
        network: the layers; copied, so that the caller may donate or change them afterwards.
        contract: how observations become flat and actions leave [-1, 1].
        seed: of the generator that stochastic actions draw from.
        step: how many environment steps of its own its seed had made when it was taken, where that is known.

    Raises:
        InputError: layers that do not fit each other or the contract.
    """

    def __init__(self, network: PolicyNetwork, contract: Contract, seed: int = 0, step: int | None = None) -> None:
        self.network = network._replace(parameters=copied(network.parameters))
        self.contract, self.step = contract, step
        check_network(self.network, contract)
        self._generator = noise_generator(seed)
        self._actors = [_split_actor(actor, contract) for actor in self.network.parameters.actors]

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return the action on the environment's scale, and `state` as it came.

        Deterministic unless told otherwise, as a controller is; Stable-Baselines3's `predict` draws unless told.
        One observation gives float32 [*action_shape], a batch of n (or a dict of such batches) [n, *action_shape].
        One that is not finite gives an action that is not: `csac export` builds in guards that replace it.

        Raises:
            InputError: an observation that is not of the task's shape, or `deterministic` is no bool.
        """
        check_flag("deterministic", deterministic)
        flat = self.contract.flatten(observation)
        actions = self.act(np.atleast_2d(flat), deterministic)
        return self.contract.to_environment(actions if flat.ndim == 2 else actions[0]), state

    def act(self, observations: np.ndarray, deterministic: bool = True, noise: np.ndarray | None = None) -> np.ndarray:
        """Return actions in [-1, 1], [n, action], for flat float32 observations [n, observation].

        A stochastic action adds std * noise to the mean before the head's tanh or clip; `noise`, standard normal
        [n, action], is drawn where not given. The head `tanh` has no spread: it gives the same action either way.
        """
        if not deterministic and noise is None:
            noise = self._generator.standard_normal(
                (len(observations), self.contract.spec.action_size), dtype=np.float32
            )
        actions, values = self.candidates(observations, None if deterministic else noise)
        if values is None:
            return actions[0]
        return actions[np.argmax(values, axis=0), np.arange(len(observations))]

    def candidates(self, observations: np.ndarray, noise: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        """Return each actor's actions in [-1, 1], [actor, n, action], and what its own critic values them, [actor, n].

        A single actor's action is valued by nobody. `act` takes row by row the one that is valued most, the first of
        equals. Observations in float64 are computed on in float64.
        """
        normaliser = self.network.parameters.normaliser
        inputs = observations if normaliser is None else _normalised(observations, normaliser)
        with np.errstate(over="ignore", invalid="ignore"):  # an action that is not a number is refused by its name
            if len(self._actors) == 1:
                return self._action(self._actors[0], inputs, noise)[None], None
            actions = [self._action(actor, inputs, noise) for actor in self._actors]
            values = [
                _outputs(critic, np.concatenate([inputs, action], axis=1))[:, 0]
                for critic, action in zip(self.network.parameters.critics, actions, strict=True)
            ]
            return np.stack(actions), np.stack(values)

    def _action(self, actor: _Actor, inputs: np.ndarray, noise: np.ndarray | None) -> np.ndarray:
        hidden = _hidden(actor.hidden, inputs, self.network.activation)
        action = hidden @ actor.mean.weight
        action += actor.mean.bias
        if noise is not None and self.network.head == "tanh_gaussian":
            log_std = hidden @ actor.log_std.weight + actor.log_std.bias
            action += np.exp(np.clip(log_std, *LOG_STD_RANGE)) * noise
        if (log_std := self.network.parameters.log_std) is not None:
            action += 0.0 if noise is None else np.exp(log_std) * noise
            return np.clip(action, -1.0, 1.0, out=action)
        return np.tanh(action, out=action)

    def save(self, directory: str | Path) -> None:
        """Write the policy and its contract into a folder, made where it is not there; `csac.load` reads it.

        Raises:
            InputError: the folder holds a run or an artefact, or cannot be written.
        """
        check_path("the folder of a policy", directory)
        folder = Path(directory)
        strangers = {"manifest.json", "policy.py", "policy.onnx", "policy.h"}
        try:
            if folder.is_dir() and strangers & {path.name for path in folder.iterdir()}:
                raise InputError(f"{folder} holds a run or an artefact: choose another folder for the policy")
            folder.mkdir(parents=True, exist_ok=True)
            self.contract.save(folder / CONTRACT)
            self.save_layers(folder / SAVED)
        except OSError as error:
            raise InputError(f"{folder} cannot be written: {error.strerror}") from error

    def save_in(self, folder: Path, names: tuple[str, ...]) -> None:
        """Stand-in."""
        folder.mkdir(exist_ok=True)
        self.contract.save(folder / CONTRACT)
        for name in names:
            self.save_layers(folder / f"{name}.safetensors")

    def save_layers(self, path: str | Path) -> None:
        """Write the layers alone as safetensors, and the step, whole or not at all; a contract belongs to them."""
        metadata = {} if self.step is None else {_STEP: str(self.step)}
        write_atomically(Path(path), tensors.encode(to_tensors(self.network.parameters), metadata))

    @staticmethod
    def load(path: str | Path, contract: Contract, seed: int = 0) -> Policy:
        """Read a policy.

        Raises:
            InputError: no such file, a damaged one, or one that does not fit the contract.
        """
        content = read_file(Path(path))
        try:
            arrays, step = tensors.decode(content), _step_in(content)
        except ValueError as error:
            raise InputError(f"{path} is damaged ({error}): restore it from a copy") from error
        try:
            network = PolicyNetwork(from_tensors(arrays), contract.activation, contract.head)
            return Policy(network, contract, seed, step)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error


def _step_in(content: bytes) -> int | None:
    """Return the step in a policy's file, or None where it has none. Raises ValueError for one that is no number."""
    step = tensors.metadata_of(content).get(_STEP)
    if step is None:
        return None
    if not re.fullmatch(r"\d{1,15}", step, re.ASCII):
        raise ValueError(f"its step is {step!r:.40}")
    return int(step)


class _Actor(NamedTuple):
    """An actor's layers, its last one split into what gives the mean and, in some heads, the log standard deviation."""

    hidden: tuple[Layer, ...]
    mean: Layer
    log_std: Layer


def _split_actor(layers: tuple[Layer, ...], contract: Contract) -> _Actor:
    (weight, bias), size = layers[-1], contract.spec.action_size
    mean = Layer(np.ascontiguousarray(weight[:, :size]), bias[:size])
    return _Actor(layers[:-1], mean, Layer(np.ascontiguousarray(weight[:, size:]), bias[size:]))


def _normalised(observations: np.ndarray, normaliser: Normaliser) -> np.ndarray:
    scaled = (observations - normaliser.mean) / normaliser.std
    return np.clip(scaled, -normaliser.limit, normaliser.limit, out=scaled)


def _hidden(layers: tuple[Layer, ...], inputs: np.ndarray, activation: Activation) -> np.ndarray:
    """Return the activations [n, width] after the last of these layers."""
    for weight, bias in layers:
        inputs = inputs @ weight
        inputs += bias
        if activation == "relu":
            np.maximum(inputs, 0, out=inputs)
        else:
            np.tanh(inputs, out=inputs)
    return inputs


def _outputs(layers: tuple[Layer, ...], inputs: np.ndarray) -> np.ndarray:
    return _hidden(layers[:-1], inputs, "relu") @ layers[-1].weight + layers[-1].bias
