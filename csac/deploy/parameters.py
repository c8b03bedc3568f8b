"""The arrays of a policy: by name in a file, copied, and checked against what the contract says."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from csac.deploy.contract import Activation, Contract, Head
from csac.types import InputError, Layer, Normaliser, PolicyNetwork, PolicyParameters

if TYPE_CHECKING:
    from collections.abc import Mapping


def copied(parameters: PolicyParameters) -> PolicyParameters:
    """Return the same numbers as float32 arrays of their own."""

    def own(array: Any) -> np.ndarray:
        return np.array(array, dtype=np.float32, order="C")

    def mlps(networks: tuple[tuple[Layer, ...], ...]) -> tuple[tuple[Layer, ...], ...]:
        return tuple(tuple(Layer(own(layer[0]), own(layer[1])) for layer in layers) for layers in networks)

    normaliser = parameters.normaliser and Normaliser(*map(own, parameters.normaliser))
    log_std = None if parameters.log_std is None else own(parameters.log_std)
    return PolicyParameters(mlps(parameters.actors), mlps(parameters.critics), normaliser, log_std)


def to_tensors(parameters: PolicyParameters) -> dict[str, np.ndarray]:
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


def from_tensors(tensors: Mapping[str, np.ndarray]) -> PolicyParameters:
    """Return the parameters that `to_tensors` named so. Raises InputError where these are none."""
    if any(array.dtype != np.float32 or not np.isfinite(array).all() for array in tensors.values()):
        raise InputError("its numbers are not finite float32: restore it from a copy")
    normaliser = [tensors.get(f"normaliser.{name}") for name in Normaliser._fields]
    parameters = PolicyParameters(
        _mlps(tensors, "actor"),
        _mlps(tensors, "critic"),
        None if any(array is None for array in normaliser) else Normaliser(*normaliser),
        tensors.get("log_std"),
    )
    if set(tensors) != set(to_tensors(parameters)):
        raise InputError("its arrays are not those of a policy: restore it from a copy")
    return parameters


def _mlps(tensors: Mapping[str, np.ndarray], kind: str) -> tuple[tuple[Layer, ...], ...]:
    networks: list[tuple[Layer, ...]] = []
    while f"{kind}.{len(networks)}.0.weight" in tensors:
        prefix, layers = f"{kind}.{len(networks)}", []
        while f"{prefix}.{len(layers)}.weight" in tensors and f"{prefix}.{len(layers)}.bias" in tensors:
            layers.append(Layer(*(tensors[f"{prefix}.{len(layers)}.{name}"] for name in Layer._fields)))
        networks.append(tuple(layers))
    return tuple(networks)


def check_network(network: PolicyNetwork, contract: Contract) -> None:
    """Raise InputError where the layers do not fit each other or the contract."""
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
