"""Actors that learn, and those whose layers are normalised over their batches meanwhile (as in the code of CrossQ)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax.numpy as jnp

from csac.algorithms.networks import MLP, descend, polyak
from csac.algorithms.normalisation import Moments, Normalisation, batch_moments, fold
from csac.algorithms.shapes import Observation, Scalar

if TYPE_CHECKING:
    from collections.abc import Callable

    import optax

RunningMoments: TypeAlias = tuple[Moments, ...]

# Of the running moments towards those of a batch (CrossQ's momentum of 0.99).
MOMENTS_RATE = 0.01


class LearntActor(NamedTuple):
    """An actor after a step of its own."""

    actor: MLP
    moments: RunningMoments | None
    optimiser: Any
    metrics: Any


def begin_moments(actor: MLP, normalisation: Normalisation) -> RunningMoments | None:
    """Return mean 0 and variance 1 for the inputs of each layer, or None where the actor is not normalised."""
    if normalisation == "none":
        return None
    sizes = [len(layer.weight) for layer in actor.layers]
    return tuple(Moments(jnp.zeros(size), jnp.ones(size)) for size in sizes)


def learn_actor(
    optimiser: optax.GradientTransformation,
    loss: Callable[..., tuple[Scalar, Any]],
    actor: MLP,
    moments: RunningMoments | None,
    optimiser_state: Any,
    *examples: Any,
) -> LearntActor:
    """Return the actor after one gradient step down its loss.

    While it learns, one that is normalised is so by the moments of the batch, through which gradients pass. Whoever
    else asks it (acting, targets, references, the policy that leaves) gets `fold(actor, moments)`, by the running ones.

    Args:
        optimiser: what makes a step of a gradient.
        loss: `loss(actor, observation, ...) -> (scalar, metrics)`, of one example and a plain MLP.
        actor: the layers that learn.
        moments: running moments of their inputs, or None where the actor is not normalised.
        optimiser_state: that of the optimiser for the actor.
        examples: observations [batch, observation], and whatever else the loss takes, with a leading axis of examples.
    """
    if moments is None:
        actor, optimiser_state, metrics = descend(optimiser, loss, actor, optimiser_state, *examples)
        return LearntActor(actor, None, optimiser_state, metrics)

    def normalised_loss(actor: MLP, observation: Observation, *others: Any) -> tuple[Scalar, Any]:
        seen = batch_moments(actor, [observation])
        value, metrics = loss(fold(actor, seen), observation, *others)
        return value, (metrics, seen)

    actor, optimiser_state, (metrics, seen) = descend(optimiser, normalised_loss, actor, optimiser_state, *examples)
    return LearntActor(actor, polyak(moments, seen, MOMENTS_RATE), optimiser_state, metrics)
