"""Batch normalisation of a network's layers: Ioffe and Szegedy 2015, placed as CrossQ does (Bhatt et al. 2024).

A layer with normalised inputs is still affine, so a normalised network is a plain MLP once the moments are folded into
its weights. No scale and shift are learnt, since the layer's weights can express them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from csac.algorithms.networks import BATCH, MLP
from csac.types import Layer

if TYPE_CHECKING:
    from collections.abc import Sequence

# Added to variances, as by CrossQ's authors: a unit that is silent in the batch must not be scaled up when it fires.
EPSILON = 1e-3


class Moments(NamedTuple):
    """Mean and variance of a layer's inputs over a batch."""

    mean: Float[Array, " in"]
    variance: Float[Array, " in"]


def moments_of(inputs: Sequence[Float[Array, " in"]], centred: bool = True) -> Moments:
    """Return the moments of a layer's inputs over the axis `BATCH`; each example has one or several `inputs`.

    If not `centred`, they are moments about 0.
    """
    mean = jax.lax.pmean(sum(inputs) / len(inputs), BATCH) * centred
    return Moments(mean, jax.lax.pmean(sum((values - mean) ** 2 for values in inputs) / len(inputs), BATCH))


def fold_layer(layer: Layer, moments: Moments) -> Layer:
    """Return the layer x ↦ [(x - mean) / √(variance + ε)] W + b as one affine layer of x."""
    weight = layer.weight / jnp.sqrt(moments.variance + EPSILON)[:, None]
    return layer._replace(weight=weight, bias=layer.bias - moments.mean @ weight)


def fold(network: MLP, moments: Sequence[Moments]) -> MLP:
    """Return the network whose layers normalise their inputs by these moments, one for each layer."""
    return MLP(tuple(map(fold_layer, network.layers, moments)), network.activation)


class Pass(NamedTuple):
    """The result of one pass through a normalised network."""

    outputs: Sequence[Float[Array, " out"]]
    moments: tuple[Moments, ...]  # of each layer's inputs
    folded: MLP  # the network with its normalisation by these moments folded in


def normalised_pass(network: MLP, inputs: Sequence[Float[Array, " in"]]) -> Pass:
    """Return a network's outputs for `inputs`, with each layer's inputs normalised by their moments over the batch.

    It takes one example, which has one or several `inputs`, and is mapped over the axis `BATCH` by `jax.vmap`.
    Gradients pass through the moments, as in batch normalisation. The last layer's inputs are not centred: otherwise
    the mean output would be its bias alone, which Adam moves by no more than the learning rate per update.
    """
    moments, folded = [], []
    for layer in network.layers:
        if folded:
            inputs = [network.activate(folded[-1], values) for values in inputs]
        moments.append(moments_of(inputs, centred=layer is not network.layers[-1]))
        folded.append(fold_layer(layer, moments[-1]))
        inputs = [values @ folded[-1].weight + folded[-1].bias for values in inputs]
    return Pass(inputs, tuple(moments), MLP(tuple(folded), network.activation))
