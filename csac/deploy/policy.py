"""A trained policy as an artefact: plain layers and the contract with the task, run by NumPy alone."""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
import safetensors
import safetensors.numpy

from csac.deploy.contract import Activation, Contract, Head, read_file, write_file
from csac.types import InputError, Layer, Normaliser, PolicyNetwork, PolicyParameters

if TYPE_CHECKING:
    pass

LOG_STD_RANGE = (-20.0, 2.0)
EVALUATION_POINTS = 3

Which = Literal["last", "best"]


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
        self.network = network._replace(parameters=_copied(network.parameters))
        self.contract = contract
        _check_network(self.network, contract)
        self._generator = np.random.default_rng(seed)
        self._actors = [_split_actor(actor, contract) for actor in self.network.parameters.actors]

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

        A stochastic action adds std * noise to the mean before the head's tanh or clip; `noise`, standard normal
        [n, action], is drawn where not given. The head `tanh` has no spread: it gives the same action either way.
        """
        normaliser = self.network.parameters.normaliser
        inputs = observations if normaliser is None else _normalised(observations, normaliser)
        if not deterministic and noise is None:
            noise = self._generator.standard_normal((len(inputs), self.contract.spec.action_size), dtype=np.float32)
        actions = [self._action(actor, inputs, None if deterministic else noise) for actor in self._actors]
        return actions[0] if len(actions) == 1 else self._most_valued(inputs, actions)

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

    def _most_valued(self, inputs: np.ndarray, actions: list[np.ndarray]) -> np.ndarray:
        """Return row by row the action that its own actor's critic values most, the first of equals."""
        values = [
            _outputs(critic, np.concatenate([inputs, action], axis=1))[:, 0]
            for critic, action in zip(self.network.parameters.critics, actions, strict=True)
        ]
        return np.stack(actions)[np.argmax(values, axis=0), np.arange(len(inputs))]

    def save(self, path: str | Path) -> None:
        """Write the layers as safetensors, whole or not at all."""
        write_file(Path(path), safetensors.numpy.save(_tensors(self.network.parameters)))

    @staticmethod
    def load(path: str | Path, contract: Contract, seed: int = 0) -> Policy:
        """Read a policy.

        Raises:
            InputError: no such file, a damaged one, or one that does not fit the contract.
        """
        try:
            tensors = safetensors.numpy.load(read_file(Path(path)))
        except (safetensors.SafetensorError, KeyError, ValueError) as error:
            raise InputError(f"{path} is damaged ({error}): restore it from a copy") from error
        try:
            network = PolicyNetwork(_parameters(tensors), contract.activation, contract.head)
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


def _copied(parameters: PolicyParameters) -> PolicyParameters:
    """Return the same numbers as float32 arrays of their own."""

    def own(array: Any) -> np.ndarray:
        return np.array(array, dtype=np.float32, order="C")

    def mlps(networks: tuple[tuple[Layer, ...], ...]) -> tuple[tuple[Layer, ...], ...]:
        return tuple(tuple(Layer(own(layer[0]), own(layer[1])) for layer in layers) for layers in networks)

    normaliser = parameters.normaliser and Normaliser(*map(own, parameters.normaliser))
    log_std = None if parameters.log_std is None else own(parameters.log_std)
    return PolicyParameters(mlps(parameters.actors), mlps(parameters.critics), normaliser, log_std)


def _check_network(network: PolicyNetwork, contract: Contract) -> None:
    observation_size, action_size = contract.spec
    actors, critics, normaliser, log_std = network.parameters
    if network.activation not in get_args(Activation) or network.head not in get_args(Head):
        raise InputError(f"the policy's activation {network.activation!r} or head {network.head!r} is not known")
    if (network.activation, network.head) != (contract.activation, contract.head):
        raise InputError(f"the policy is {network.activation}/{network.head}, not as the contract says")
    if not actors:
        raise InputError("the policy has no actor")
    if len(critics) != (len(actors) if len(actors) > 1 else 0):
        raise InputError(f"the policy has {len(actors)} actors and {len(critics)} critics to choose between them")
    outputs = 2 * action_size if network.head == "tanh_gaussian" else action_size
    for actor in actors:
        _check_layers("actor", actor, observation_size, outputs)
    for critic in critics:
        _check_layers("critic", critic, observation_size + action_size, 1)
    if (log_std is not None) != (network.head == "clipped_gaussian"):
        raise InputError(f"a {network.head} policy {'has' if log_std is not None else 'lacks'} a log_std of its own")
    if log_std is not None and log_std.shape != (action_size,):
        raise InputError(f"the policy's log_std has shape {log_std.shape} where the task has {action_size} actions")
    if normaliser is not None:
        _check_normaliser(normaliser, observation_size)


def _check_layers(name: str, layers: tuple[Layer, ...], inputs: int, outputs: int) -> None:
    if not layers:
        raise InputError(f"the policy has no layers in its {name}")
    width = inputs
    for index, (weight, bias) in enumerate(layers):
        if weight.ndim != 2 or bias.shape != weight.shape[1:] or weight.shape[0] != width:
            raise InputError(f"{name} layer {index} has shapes {weight.shape} and {bias.shape} after {width} inputs")
        width = weight.shape[1]
    if width != outputs:
        raise InputError(f"the {name} gives {width} outputs where the task takes {outputs}")


def _check_normaliser(normaliser: Normaliser, observation_size: int) -> None:
    mean, std, limit = normaliser
    if mean.shape != (observation_size,) or std.shape != mean.shape or limit.shape != ():
        raise InputError(
            f"the normaliser has shapes {mean.shape}, {std.shape} and {limit.shape} for {observation_size} inputs"
        )
    if not (std > 0).all() or not limit > 0:
        raise InputError("the normaliser's std and limit are to be more than 0")


def _tensors(parameters: PolicyParameters) -> dict[str, np.ndarray]:
    """Return every array by the name that it has in a file."""
    tensors = {
        f"{kind}.{number}.{index}.{name}": array
        for kind, networks in (("actor", parameters.actors), ("critic", parameters.critics))
        for number, layers in enumerate(networks)
        for index, layer in enumerate(layers)
        for name, array in layer._asdict().items()
    }
    if parameters.normaliser is not None:
        tensors |= {f"normaliser.{name}": array for name, array in parameters.normaliser._asdict().items()}
    if parameters.log_std is not None:
        tensors["log_std"] = parameters.log_std
    return tensors


def _parameters(tensors: dict[str, np.ndarray]) -> PolicyParameters:
    """Return the parameters that `_tensors` named so; InputError where these are none."""
    if any(array.dtype != np.float32 or not np.isfinite(array).all() for array in tensors.values()):
        raise InputError("its numbers are not finite float32: restore it from a copy")
    normaliser = [tensors.get(f"normaliser.{name}") for name in Normaliser._fields]
    parameters = PolicyParameters(
        _mlps(tensors, "actor"),
        _mlps(tensors, "critic"),
        None if any(array is None for array in normaliser) else Normaliser(*normaliser),
        tensors.get("log_std"),
    )
    if set(tensors) != set(_tensors(parameters)):
        raise InputError(f"not the parameters of a policy: {sorted(tensors)}")
    return parameters


def _mlps(tensors: dict[str, np.ndarray], kind: str) -> tuple[tuple[Layer, ...], ...]:
    networks: list[tuple[Layer, ...]] = []
    while f"{kind}.{len(networks)}.0.weight" in tensors:
        prefix, layers = f"{kind}.{len(networks)}", []
        while f"{prefix}.{len(layers)}.weight" in tensors and f"{prefix}.{len(layers)}.bias" in tensors:
            layers.append(Layer(*(tensors[f"{prefix}.{len(layers)}.{name}"] for name in Layer._fields)))
        networks.append(tuple(layers))
    return tuple(networks)
