"""Weights of two regularisers, given or learnt: one that is learnt is the dual variable of a constraint, as in SAC."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from csac.algorithms.networks import descend, init_optimiser
from csac.algorithms.shapes import Scalar
from csac.types import Metrics

if TYPE_CHECKING:
    import optax

Weight: TypeAlias = float | Literal["auto"]

# What a weight stays within. One that nothing holds would take as long to come back as it took to go.
LEAST_WEIGHT, MOST_WEIGHT = 1e-4, 1e2


class Weights(NamedTuple):
    """The weights of one update."""

    entropy: Scalar | float  # σ
    relative_entropy: Scalar | float  # τ


class LearntWeight(NamedTuple):
    """A weight as its logarithm, so that it stays positive, and its optimiser's state."""

    log_weight: Scalar
    optimiser: Any


class LearntWeights(NamedTuple):
    """Those of the weights that are learnt; None is one that is given."""

    entropy: LearntWeight | None
    relative_entropy: LearntWeight | None


def weight_loss(log_weight: Scalar, slack: Scalar) -> tuple[Scalar, Metrics]:
    """Return log w · slack: w falls while the constraint holds with slack to spare, and rises while it does not.

    With the slack entropy - target this is SAC's temperature loss.
    """
    return log_weight * slack, {}


def make_weights(
    given: tuple[Weight, Weight], first: Weights, optimiser: optax.GradientTransformation
) -> LearntWeights | None:
    """Return what the weights that are `auto` begin with; None where both are given."""

    def begin(weight: Weight, value: Scalar | float) -> LearntWeight | None:
        log_weight = jnp.log(jnp.float32(value))
        return LearntWeight(log_weight, init_optimiser(optimiser, log_weight)) if weight == "auto" else None

    return LearntWeights(*map(begin, given, first)) if "auto" in given else None


def current_weights(given: tuple[Weight, Weight], learnt: LearntWeights | None) -> Weights:
    """Return the weights as they are given or, where they are `auto`, as they are learnt."""

    def now(weight: Any, one: LearntWeight | None) -> Any:
        return weight if one is None else jnp.exp(one.log_weight)

    return Weights(*map(now, given, learnt or LearntWeights(None, None)))


def adapt_weights(
    learnt: LearntWeights | None, slack: Weights, optimiser: optax.GradientTransformation
) -> LearntWeights | None:
    """Return the weights after one step, given by how much each one's constraint holds, negative where it does not.

    A slack of exactly 0, which is that of a constraint not yet measured, moves neither the weight nor Adam's moments:
    a thousand zeros in these would make the first steps after them several times too long.
    """

    def adapt(one: LearntWeight | None, slack: Any) -> LearntWeight | None:
        if one is None:
            return None
        log_weight, state, _ = descend(optimiser, weight_loss, one.log_weight, one.optimiser, slack[None])
        moved = LearntWeight(jnp.clip(log_weight, math.log(LEAST_WEIGHT), math.log(MOST_WEIGHT)), state)
        return jax.tree.map(partial(jnp.where, slack == 0), one, moved)

    return None if learnt is None else LearntWeights(*map(adapt, learnt, slack))


def weight_metrics(weights: Weights, learnt: LearntWeights | None) -> Metrics:
    """Return those weights that are learnt, as metrics."""
    if learnt is None:
        return {}
    pairs = zip(weights._fields, weights, learnt, strict=True)
    return {f"{name}_weight": weight for name, weight, one in pairs if one is not None}
