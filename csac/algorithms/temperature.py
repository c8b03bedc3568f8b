"""The entropy weight, SAC's temperature, learnt as the dual variable of a lower bound on the entropy."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp

from csac.algorithms.networks import gradient_step
from csac.algorithms.shapes import Scalar
from csac.types import Metrics

if TYPE_CHECKING:
    import optax

FLOOR = math.log(1e-8)  # from here gradient steps can raise a weight that was fixed at 0 and is now learnt


class Temperature(NamedTuple):
    """The logarithm of a weight, so that the weight stays positive, and its optimiser's state."""

    log_weight: Scalar
    optimiser: Any


def finite_log(weight: float) -> Scalar:
    """Return log w; for log 0, the lowest finite float, whose exp is 0."""
    return jnp.maximum(jnp.log(jnp.float32(weight)), jnp.finfo(jnp.float32).min)


def temperature_loss(log_weight: Scalar, entropy: Scalar, *, target: float) -> tuple[Scalar, Metrics]:
    """Return log α · (entropy - target): SAC's second paper, Eq. 18, with log α for α as in the authors' code."""
    return log_weight * (entropy - target), {}


def adapt(
    temperature: Temperature, entropy: Scalar, target: float, optimiser: optax.GradientTransformation
) -> Temperature:
    """Return the temperature after one gradient step, lower if `entropy`, a mean in nats, is above `target`."""
    loss, log_weight = partial(temperature_loss, target=target), jnp.maximum(temperature.log_weight, FLOOR)
    log_weight, state, _ = gradient_step(optimiser, loss, log_weight, temperature.optimiser, entropy[None])
    return Temperature(log_weight, state)
