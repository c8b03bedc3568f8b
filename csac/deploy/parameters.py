"""The arrays of a policy: by name in a file, copied, and checked against the contract."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from csac.types import InputError, Layer, Normaliser, PolicyNetwork, PolicyParameters

if TYPE_CHECKING:
    from collections.abc import Mapping

    from csac.deploy.contract import Contract

    Networks = tuple[tuple[Layer, ...], ...]


def copied(parameters: PolicyParameters) -> PolicyParameters:
    """Return the same numbers as float32 arrays of their own."""
    return from_tensors(
        {name: np.array(array, np.float32, order="C") for name, array in to_tensors(parameters).items()}
    )


def deterministic(parameters: PolicyParameters, action_size: int) -> PolicyParameters:
    """Return the parameters without those that only sampled actions need."""
    actors = tuple(
        (*layers[:-1], Layer(layers[-1].weight[:, :action_size], layers[-1].bias[:action_size]))
        for layers in parameters.actors
    )
    return parameters._replace(actors=actors, log_std=None)


def to_tensors(parameters: PolicyParameters) -> dict[str, Any]:
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
    """Return the parameters that `to_tensors` named so."""
    normaliser = [tensors.get(f"normaliser.{name}") for name in Normaliser._fields]
    return PolicyParameters(
        _networks(tensors, "actor"),
        _networks(tensors, "critic"),
        None if any(array is None for array in normaliser) else Normaliser(*normaliser),
        tensors.get("log_std"),
    )


def _networks(tensors: Mapping[str, np.ndarray], kind: str) -> Networks:
    networks: list[tuple[Layer, ...]] = []
    while (prefix := f"{kind}.{len(networks)}") + ".0.weight" in tensors:
        layers: list[Layer] = []
        while (name := f"{prefix}.{len(layers)}") + ".weight" in tensors and name + ".bias" in tensors:
            layers.append(Layer(tensors[name + ".weight"], tensors[name + ".bias"]))
        networks.append(tuple(layers))
    return tuple(networks)


def check_network(network: PolicyNetwork, contract: Contract) -> None:
    """Raise InputError if the layers do not fit each other or the contract."""
    observation_size, action_size = contract.spec
    actors, critics, normaliser, log_std = network.parameters
    if (network.activation, network.head) != (contract.activation, contract.head):
        raise InputError(f"the policy is {network.activation}/{network.head}, not as its contract says")
    if not actors or len(critics) != (len(actors) if len(actors) > 1 else 0):
        raise InputError(f"the policy has {len(actors)} actors and {len(critics)} critics to choose between them")
    outputs = 2 * action_size if network.head == "tanh_gaussian" else action_size
    for actor in actors:
        _check_layers("actor", actor, observation_size, outputs)
    for critic in critics:
        _check_layers("critic", critic, observation_size + action_size, 1)
    if (np.shape(log_std) if log_std is not None else None) != (
        (action_size,) if network.head == "clipped_gaussian" else None
    ):
        raise InputError(f"the log_std of a {network.head} policy with {action_size} actions does not fit")
    if normaliser is not None:
        shapes = [array.shape for array in normaliser]
        if shapes != [(observation_size,), (observation_size,), ()] or not (normaliser.std > 0).all():
            raise InputError(f"the normaliser does not fit {observation_size} inputs, or its std is not positive")


def _check_layers(name: str, layers: tuple[Layer, ...], inputs: int, outputs: int) -> None:
    width = inputs
    for index, (weight, bias) in enumerate(layers):
        if weight.ndim != 2 or bias.shape != weight.shape[1:] or weight.shape[0] != width:
            raise InputError(f"{name} layer {index} has shapes {weight.shape} and {bias.shape} after {width} inputs")
        width = weight.shape[1]
    if not layers or width != outputs:
        raise InputError(f"the {name} gives {width} outputs where the task takes {outputs}")
