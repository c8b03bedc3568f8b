"""Batch normalisation of a network's layers: before activations (Ioffe and Szegedy 2015), or after (CrossQ, 2024).

A normalised layer is still affine, so a normalised network is a plain MLP once the moments are folded into its weights.
No scale and shift are learnt, since weights and biases can express them (before activations: with relu).
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
    """Mean and variance over a batch of the values that a layer normalises."""

    mean: Float[Array, " n"]
    variance: Float[Array, " n"]


def moments_of(several: Sequence[Float[Array, " n"]], centred: bool = True) -> Moments:
    """Return the moments of values over the axis `BATCH`; each example has one or `several`.

    If not `centred`, they are moments about 0.
    """
    mean = jax.lax.pmean(sum(several) / len(several), BATCH) * centred
    return Moments(mean, jax.lax.pmean(sum((values - mean) ** 2 for values in several) / len(several), BATCH))


def fold_layer(layer: Layer, moments: Moments) -> Layer:
    """Return the layer x ↦ [(x - mean) / √(variance + ε)] W + b as one affine layer of x."""
    weight = layer.weight / jnp.sqrt(moments.variance + EPSILON)[:, None]
    return layer._replace(weight=weight, bias=layer.bias - moments.mean @ weight)


def fold_outputs(layer: Layer, moments: Moments) -> Layer:
    """Return the layer x ↦ (xW - mean) / √(variance + ε) + b as one affine layer of x."""
    scale = _scale(moments)
    return layer._replace(weight=layer.weight * scale[None], bias=layer.bias - moments.mean * scale)


def fold(network: MLP, moments: Sequence[Moments]) -> MLP:
    """Return the network with its normalisation by these moments folded in: those of a pass below."""
    if len(moments) < len(network.layers):  # of the hidden layers' outputs
        return MLP((*map(fold_outputs, network.layers, moments), network.layers[-1]), network.activation)
    return MLP(tuple(map(fold_layer, network.layers, moments)), network.activation)


class Pass(NamedTuple):
    """The result of one pass through a normalised network."""

    outputs: Sequence[Float[Array, " out"]]
    moments: tuple[Moments, ...]  # of each layer


def pass_after(network: MLP, inputs: Sequence[Float[Array, " in"]]) -> Pass:
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
    return Pass(inputs, tuple(moments))


def pass_before(network: MLP, inputs: Sequence[Float[Array, " in"]]) -> Pass:
    """Return the same with each hidden layer's outputs normalised before the bias and the activation."""
    moments = []
    for layer in network.layers[:-1]:
        products = [values @ layer.weight for values in inputs]
        moments.append(moments_of(products))
        scale, bias = _scale(moments[-1]), fold_outputs(layer, moments[-1]).bias
        inputs = [network.activate(layer, values * scale + bias) for values in products]
    last = network.layers[-1]
    return Pass([values @ last.weight + last.bias for values in inputs], tuple(moments))


def _scale(moments: Moments) -> Float[Array, " n"]:
    return 1.0 / jnp.sqrt(moments.variance + EPSILON)


PASSES = {"batch": pass_after, "batch_before": pass_before}
