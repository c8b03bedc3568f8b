"""Batch normalisation of a network's layers: Ioffe and Szegedy 2015, placed as CrossQ does (Bhatt et al. 2024).

A layer that sees its inputs normalised is an affine layer still, so a normalised network is a plain MLP: the moments
are folded into its weights. No scale and shift are learnt beside, which the layer that follows can express.
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

# Added to variances, as by CrossQ's authors: a unit that is silent in the batch is not blown up where it fires.
EPSILON = 1e-3


class Moments(NamedTuple):
    """Mean and variance of a layer's inputs over a batch."""

    mean: Float[Array, " in"]
    variance: Float[Array, " in"]


def moments_of(inputs: Sequence[Float[Array, " in"]], centred: bool = True) -> Moments:
    """Return the moments of a layer's inputs over all examples of the axis `BATCH`, each of which has these.

    Those that are not `centred` are the moments about 0.
    """
    mean = jax.lax.pmean(sum(inputs) / len(inputs), BATCH) * centred
    return Moments(mean, jax.lax.pmean(sum((values - mean) ** 2 for values in inputs) / len(inputs), BATCH))


def fold_layer(layer: Layer, moments: Moments) -> Layer:
    """Return the layer x ↦ [(x - mean) / √(variance + ε)] W + b as one affine layer of x."""
    weight = layer.weight / jnp.sqrt(moments.variance + EPSILON)[:, None]
    return layer._replace(weight=weight, bias=layer.bias - moments.mean @ weight)


def fold(network: MLP, moments: Sequence[Moments]) -> MLP:
    """Return the network whose layers see their inputs normalised by these moments, one for each layer."""
    return MLP(tuple(map(fold_layer, network.layers, moments)), network.activation)


class Pass(NamedTuple):
    """What one pass through a normalised network gives."""

    outputs: Sequence[Float[Array, " out"]]
    moments: tuple[Moments, ...]  # of each layer's inputs
    folded: MLP  # the network as it was seen: its normalisation by these moments folded in


def normalised_pass(network: MLP, inputs: Sequence[Float[Array, " in"]]) -> Pass:
    """Return what a network says of `inputs` where each layer sees its own normalised by their moments.

    It is a function of one example, mapped over the axis `BATCH` by `jax.vmap`; an example has one or several `inputs`.
    Gradients pass through the moments, as batch normalisation has it. The last layer's inputs are not centred: the mean
    of what the network says would be its one bias, which Adam moves by no more than the learning rate in an update.
    """
    moments, folded = [], []
    for layer in network.layers:
        if folded:
            inputs = [network.activate(folded[-1], values) for values in inputs]
        moments.append(moments_of(inputs, centred=layer is not network.layers[-1]))
        folded.append(fold_layer(layer, moments[-1]))
        inputs = [values @ folded[-1].weight + folded[-1].bias for values in inputs]
    return Pass(inputs, tuple(moments), MLP(tuple(folded), network.activation))
