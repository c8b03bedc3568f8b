"""A trained policy, run by NumPy alone: plain layers and the contract with the task."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import safetensors.numpy

from csac.checks import check_flag, check_path
from csac.deploy.contract import CONTRACT, Contract, check_checksum, read_json, write_with_checksum
from csac.deploy.parameters import copied, from_tensors, to_tensors
from csac.record.files import writing
from csac.types import LAYER_NORM_EPSILON, LOG_STD_RANGE, InputError, Layer, PolicyNetwork

if TYPE_CHECKING:
    from csac.types import Activation

POLICY = "policy.safetensors"  # file name in the folder of an artefact, or of a policy saved on its own
# Any of these files shows that a folder is a run, a run's policies or an artefact.
OCCUPIED = {"manifest.json", "last.safetensors", "best.safetensors", "policy.py", "policy.onnx", "policy.h"}
GELU_SCALE, GELU_CUBE = (2 / math.pi) ** 0.5, 0.044715  # Hendrycks and Gimpel 2016, section 2

_STREAM = 0x706F6C69  # far from the spawn keys of a task's own generators: 0, 1, 2, ...


def noise_generator(seed: int) -> np.random.Generator:
    """Return the generator of the stochastic actions of `seed`.

    Gymnasium gives `default_rng(seed)` to a task that is reset with `seed`. This is a different stream: otherwise the
    actions' noise would be correlated with the task's randomness.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STREAM,)))


class Policy:
    """A policy network in NumPy, with the signature of Stable-Baselines3's `predict`.

    Args:
        network: the layers; copied, so that the caller may donate or change them afterwards.
        contract: how observations are flattened and actions mapped from [-1, 1] to the environment's bounds.
        step: the environment step in training that the policy is from, if known.

    Raises:
        InputError: layers that do not fit each other or the contract.
    """

    def __init__(self, network: PolicyNetwork, contract: Contract, step: int | None = None) -> None:
        self.network = network._replace(parameters=copied(network.parameters))
        self.contract, self.step = contract, step
        self._generator = noise_generator(0)
        self._actors = [_split_actor(actor, contract) for actor in self.network.parameters.actors]
        self._check()

    def _check(self) -> None:
        """Raise InputError if the layers do not fit each other or the contract."""
        observation_size, action_size = self.contract.spec[:2]
        try:
            arguments = np.zeros((1, observation_size), np.float32), False, np.zeros((1, action_size), np.float32)
            fits = self.act(*arguments).shape == (1, action_size)
        except (ValueError, TypeError, IndexError):
            fits = False
        if not fits:
            raise InputError(f"the policy's layers do not take {observation_size} numbers and give {action_size}")

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return the action on the environment's scale, and `state` unchanged.

        Deterministic by default, as a controller is; Stable-Baselines3's `predict` samples by default.
        One observation gives float32 [*action_shape], a batch of n (or a dict of such batches) [n, *action_shape].
        A non-finite observation gives a non-finite action: `csac export` builds in guards that replace it.

        Raises:
            InputError: an observation does not have the task's shape, or `deterministic` is not a bool.
        """
        check_flag("deterministic", deterministic)
        flat = self.contract.flatten(observation)
        actions = self.act(np.atleast_2d(flat), deterministic)
        return self.contract.to_environment(actions if flat.ndim == 2 else actions[0]), state

    def act(self, observations: np.ndarray, deterministic: bool = True, noise: np.ndarray | None = None) -> np.ndarray:
        """Return actions in [-1, 1], [n, action], for flat float32 observations [n, observation].

        A stochastic action adds std * noise to the mean before the head's tanh or clip; `noise`, standard normal
        [n, action], is drawn if not given. The head `tanh` has no std: it gives the same action either way.
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
        """Return each actor's actions in [-1, 1], [actor, n, action], and its critic's values of them, [actor, n].

        The values are None for a single actor. For each row, `act` takes the action with the highest value, the first
        in a tie. For float64 observations, the computation is in float64.
        """
        inputs = observations
        if (normaliser := self.network.parameters.normaliser) is not None:
            inputs = (observations - normaliser.mean) / normaliser.std
            np.clip(inputs, -normaliser.limit, normaliser.limit, out=inputs)
        with np.errstate(over="ignore", invalid="ignore"):  # non-finite actions are refused where they are used
            if len(self._actors) == 1:
                return self._action(self._actors[0], inputs, noise)[None], None
            actions = [self._action(actor, inputs, noise) for actor in self._actors]
            values = [
                _outputs(critic, np.concatenate([inputs, action], axis=1), self.network.critic_activation)[:, 0]
                for critic, action in zip(self.network.parameters.critics, actions, strict=True)
            ]
            return np.stack(actions), np.stack(values)

    def _action(self, actor: _Actor, inputs: np.ndarray, noise: np.ndarray | None) -> np.ndarray:
        hidden = _hidden(actor.hidden, inputs, self.network.activation)
        action = hidden @ actor.mean.weight
        action += actor.mean.bias
        if noise is not None and self.network.head != "tanh":
            log_std: Any = self.network.parameters.log_std
            if self.network.head == "tanh_gaussian":
                log_std = np.clip(hidden @ actor.log_std.weight + actor.log_std.bias, *LOG_STD_RANGE)
            action += np.exp(log_std) * noise
        if self.network.head == "clipped_gaussian":
            return np.clip(action, -1.0, 1.0, out=action)
        return np.tanh(action, out=action)

    def save(self, directory: str | Path) -> None:
        """Write the policy and its contract into a folder, created if needed; `csac.load` reads it.

        Raises:
            InputError: the folder holds a run or an artefact, or cannot be written.
        """
        check_path("the folder of a policy", directory)
        folder = Path(directory)
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            names = {path.name for path in folder.iterdir()}
            if names & OCCUPIED or any(name.startswith("seed-") for name in names):
                raise InputError(f"{folder} holds a run or an artefact: choose another folder for the policy")
            self.write(folder / POLICY)

    def write(self, path: Path) -> None:
        """Write the policy's file and, beside it, its contract with the file's checksum. Raises OSError."""
        path.parent.mkdir(exist_ok=True)
        write_with_checksum(path, self.encode(), self.contract.fields())

    def encode(self) -> bytes:
        """Return the content of the policy's safetensors file: the layers, and the step as metadata."""
        metadata = None if self.step is None else {"step": str(self.step)}
        return safetensors.numpy.save(to_tensors(self.network.parameters), metadata)

    @staticmethod
    def load(path: str | Path) -> Policy:
        """Read a policy's file and the `contract.json` beside it.

        Raises:
            InputError: a file is missing or damaged, or the contract is that of another policy.
        """
        path = Path(path)
        contract_path = path.with_name(CONTRACT)
        contract = Contract.of_fields(fields := read_json(contract_path), contract_path)
        check_checksum(path, fields)
        try:
            with safetensors.safe_open(path, "numpy") as file:
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                step = (file.metadata() or {}).get("step")
            kinds = contract.activation, contract.head, contract.critic_activation
            network = PolicyNetwork(from_tensors(tensors), *kinds)
            return Policy(network, contract, step=None if step is None else int(step))
        except (safetensors.SafetensorError, ValueError) as error:  # InputError is a ValueError
            raise InputError(f"{path} is not a policy of {CONTRACT} ({error}): restore both from a copy") from error


class _Actor(NamedTuple):
    """An actor's layers; the last is split into those of the mean and, in some heads, the log standard deviation."""

    hidden: tuple[Layer, ...]
    mean: Layer
    log_std: Layer


def _split_actor(layers: tuple[Layer, ...], contract: Contract) -> _Actor:
    weight, bias, size = *layers[-1][:2], contract.spec.action_size
    mean = Layer(np.ascontiguousarray(weight[:, :size]), bias[:size])
    return _Actor(layers[:-1], mean, Layer(np.ascontiguousarray(weight[:, size:]), bias[size:]))


def _hidden(layers: tuple[Layer, ...], inputs: np.ndarray, activation: Activation) -> np.ndarray:
    """Return the activations [n, width] after the last of these layers."""
    for layer in layers:
        inputs = inputs @ layer.weight
        inputs += layer.bias
        if layer.scale is not None:
            inputs -= inputs.mean(axis=1, keepdims=True)
            inputs /= np.sqrt((inputs**2).mean(axis=1, keepdims=True) + LAYER_NORM_EPSILON)
            inputs *= layer.scale
            inputs += layer.shift
        inputs = _activated(inputs, activation)
    return inputs


def _activated(values: np.ndarray, activation: Activation) -> np.ndarray:
    """Return the activation of `values`, which may be overwritten."""
    match activation:
        case "relu":
            return np.maximum(values, 0, out=values)
        case "tanh":
            return np.tanh(values, out=values)
        case "elu":
            return np.where(values > 0, values, np.expm1(values))
        case "silu":
            return values / (1 + np.exp(-values))
        case "gelu":
            return 0.5 * values * (1 + np.tanh(GELU_SCALE * (values + GELU_CUBE * values**3)))


def _outputs(layers: tuple[Layer, ...], inputs: np.ndarray, activation: Activation) -> np.ndarray:
    return _hidden(layers[:-1], inputs, activation) @ layers[-1].weight + layers[-1].bias
