"""Weights of regularisers that are learnt: each is the dual variable of a constraint, as SAC's temperature is."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from csac.algorithms.networks import gradient_step, init_optimiser
from csac.algorithms.shapes import Scalar
from csac.types import Metrics

if TYPE_CHECKING:
    import optax
    from jaxtyping import Array, Bool

FLOOR = math.log(1e-8)  # from here a weight can rise again: one that was fixed at 0 may go on as a learnt one
# Where CSAC's weights stay. One that nothing holds would take as long to come back as it took to go.
LEAST_WEIGHT, MOST_WEIGHT = 1e-4, 1e2


class Weights(NamedTuple):
    """The weights of one update, or what belongs to each of them."""

    entropy: Any  # σ
    relative_entropy: Any  # τ


class LearntWeight(NamedTuple):
    """A weight as its logarithm, so that it stays positive, and its optimiser's state."""

    log_weight: Scalar
    optimiser: Any


class LearntWeights(NamedTuple):
    """Those of CSAC's weights that are learnt; None is one that is given."""

    entropy: LearntWeight | None = None
    relative_entropy: LearntWeight | None = None
    relative_entropy_per_refresh: Scalar | None = None  # what τ goes by, in nats; 0 before there is any


def make_weight(weight: float, optimiser: optax.GradientTransformation) -> LearntWeight:
    """Return a weight to begin with."""
    log_weight = first_log_weight(weight)
    return LearntWeight(log_weight, init_optimiser(optimiser, log_weight))


def first_log_weight(weight: float) -> Scalar:
    """Return log w. Instead of log 0, which is no number, it has the lowest float, whose exp is 0."""
    return jnp.maximum(jnp.log(jnp.float32(weight)), jnp.finfo(jnp.float32).min)


def weight_loss(log_weight: Scalar, value: Scalar, *, least: float = 0.0) -> tuple[Scalar, Metrics]:
    """Return log w · (value - least): w falls while the value is above what it is to be at least, and rises below.

    Of the entropy it is SAC's temperature loss (second paper, Eq. 18), with log α for α as in the authors' code.
    """
    return log_weight * (value - least), {}


def adapt_weight(
    weight: LearntWeight, value: Scalar, optimiser: optax.GradientTransformation, least: float = 0.0
) -> LearntWeight:
    """Return the weight after one gradient step. The loss is linear in the value, so a mean stands for all examples."""
    loss, log_weight = partial(weight_loss, least=least), jnp.maximum(weight.log_weight, FLOOR)
    log_weight, state, _ = gradient_step(optimiser, loss, log_weight, weight.optimiser, value[None])
    return LearntWeight(log_weight, state)


def make_weights(given: Weights, first: Weights, optimiser: optax.GradientTransformation) -> LearntWeights | None:
    """Return what those weights that are `auto` begin with; None where both are given."""
    entropy = make_weight(first.entropy, optimiser) if given.entropy == "auto" else None
    if given.relative_entropy != "auto":
        return entropy and LearntWeights(entropy)
    return LearntWeights(entropy, make_weight(first.relative_entropy, optimiser), jnp.zeros(()))


def current_weights(given: Weights, learnt: LearntWeights | None) -> Weights:
    """Return the weights as they are given or, where they are `auto`, as they are learnt."""
    entropy, relative_entropy, _ = learnt or LearntWeights()
    return Weights(_current(given.entropy, entropy), _current(given.relative_entropy, relative_entropy))


def adapt_weights(
    learnt: LearntWeights | None,
    metrics: Metrics,
    targets: Weights,
    is_last: Bool[Array, ""] | bool,
    optimiser: optax.GradientTransformation,
) -> LearntWeights | None:
    """Return the weights after one step: σ towards its target entropy, τ towards its target relative entropy.

    τ goes by the relative entropy of the last update before a refresh of the reference (`is_last`), until the next one.
    While that is exactly 0, since nothing was refreshed yet, neither τ nor Adam's moments move: a thousand zeros in
    these would make the first steps after them several times too long.
    """
    if learnt is None:
        return None
    entropy, relative_entropy, measured = learnt
    if entropy is not None:
        entropy = _bounded(adapt_weight(entropy, metrics["entropy"] - targets.entropy, optimiser))
    if relative_entropy is not None and measured is not None:
        measured = jnp.where(is_last, metrics["relative_entropy"], measured)
        moved = _bounded(adapt_weight(relative_entropy, targets.relative_entropy - measured, optimiser))
        relative_entropy = jax.tree.map(partial(jnp.where, measured == 0), relative_entropy, moved)
    return LearntWeights(entropy, relative_entropy, measured)


def weight_metrics(weights: Weights, learnt: LearntWeights | None) -> Metrics:
    """Return those weights that are learnt, and what τ goes by, as metrics."""
    entropy, relative_entropy, measured = learnt or LearntWeights()
    metrics = {} if entropy is None else {"entropy_weight": weights.entropy}
    if relative_entropy is None:
        return metrics
    return {**metrics, "relative_entropy_weight": weights.relative_entropy, "relative_entropy_per_refresh": measured}


def _current(given: float, learnt: LearntWeight | None) -> Scalar | float:
    return given if learnt is None else jnp.exp(learnt.log_weight)


def _bounded(weight: LearntWeight) -> LearntWeight:
    log_weight = jnp.clip(weight.log_weight, math.log(LEAST_WEIGHT), math.log(MOST_WEIGHT))
    return weight._replace(log_weight=log_weight)
