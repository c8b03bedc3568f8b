"""A policy's arrays: named for a file, copied, or reduced to those that a deterministic action needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from csac.types import Layer, Normaliser, PolicyParameters

if TYPE_CHECKING:
    from collections.abc import Mapping

    Networks = tuple[tuple[Layer, ...], ...]


def copied(parameters: PolicyParameters) -> PolicyParameters:
    """Return a copy of the parameters as float32 arrays."""
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
    """Return every array by its name in a file."""
    tensors = {
        f"{kind}.{number}.{index}.{name}": array
        for kind, networks in (("actor", parameters.actors), ("critic", parameters.critics))
        for number, layers in enumerate(networks)
        for index, layer in enumerate(layers)
        for name, array in layer._asdict().items()
        if array is not None
    }
    if parameters.normaliser is not None:
        tensors |= {f"normaliser.{name}": array for name, array in parameters.normaliser._asdict().items()}
    if parameters.log_std is not None:
        tensors["log_std"] = parameters.log_std
    return tensors


def from_tensors(tensors: Mapping[str, np.ndarray]) -> PolicyParameters:
    """Return the parameters for arrays named by `to_tensors`."""
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
            layers.append(Layer(*(tensors.get(f"{name}.{part}") for part in Layer._fields)))
        networks.append(tuple(layers))
    return tuple(networks)
