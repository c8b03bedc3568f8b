"""Running statistics to normalise observations and rewards."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from csac.algorithms.returns import discounted_returns
from csac.algorithms.shapes import Observation, Scalar
from csac.types import Normaliser, Transition

# Added to variances and to the standard deviation of advantages, as in SB3 and CleanRL: either may be 0.
EPSILON = 1e-8
MOST = 1_000_000  # batches of values that statistics average over: float32 cannot count on for ever
LIMIT = 10.0  # bound on normalised observations and rewards, in standard deviations


class Statistics(NamedTuple):
    """Mean and standard deviation of the values of about the last `MOST` batches; 0 and 1 before the first."""

    total: Scalar
    mean: Float[Array, "..."]
    variance: Float[Array, "..."]
    std: Float[Array, "..."]  # sqrt(variance + epsilon), stored: every step needs it, few change it

    @classmethod
    def create(cls, shape: tuple[int, ...]) -> Statistics:
        """Return empty statistics."""
        return cls(jnp.zeros(()), jnp.zeros(shape), jnp.ones(shape), jnp.ones(shape))

    def absorb(self, values: Float[Array, "n ..."]) -> Statistics:
        """Return the statistics with these values added (Chan, Golub, LeVeque 1979)."""
        count = jnp.minimum(self.total + len(values), MOST * len(values))
        shares = (count - len(values)) / count, len(values) / count
        # Differences to the old mean are small, so that rounding loses little even where the mean is large.
        differences = jax.vmap(jnp.subtract, in_axes=(0, None))(values, self.mean)
        shift = jnp.mean(differences, axis=0)
        within = shares[0] * self.variance + shares[1] * jnp.var(differences, axis=0)
        variance = within + shares[0] * shares[1] * shift**2
        return Statistics(count, self.mean + shares[1] * shift, variance, jnp.sqrt(variance + EPSILON))


class ReturnScale(NamedTuple):
    """Statistics of the discounted return so far in each episode, R_t = r_t + γ R_{t-1}, which scale rewards."""

    statistics: Statistics  # []
    running: Float[Array, " environment"]  # R of the newest step of each environment

    @classmethod
    def create(cls, environments: int) -> ReturnScale:
        """Return the initial scale, 1."""
        return cls(Statistics.create(()), jnp.zeros(environments))

    def absorb(self, steps: Transition, discount: float) -> ReturnScale:
        """Return the scale with these steps [time * environment] added, in order."""
        in_time = jax.tree.map(lambda leaf: leaf.reshape(-1, *self.running.shape, *leaf.shape[1:]), steps)
        returns, running = discounted_returns(self.running, in_time, discount)
        return ReturnScale(self.statistics.absorb(returns.ravel()), running)


def normalise(statistics: Statistics | None, observation: Observation, limit: float = LIMIT) -> Observation:
    """Return (observation - mean) / std within ± limit, or the observation unchanged if there are no statistics."""
    if statistics is None:
        return observation
    return jnp.clip((observation - statistics.mean) / statistics.std, -limit, limit)


def normalise_batch(statistics: Statistics | None, batch: Transition) -> tuple[Statistics | None, Transition]:
    """Return the statistics with a batch's observations absorbed, and the batch normalised by these."""
    if statistics is None:
        return None, batch
    statistics = statistics.absorb(batch.observation)
    see = jax.vmap(partial(normalise, statistics))
    return statistics, batch._replace(observation=see(batch.observation), next_observation=see(batch.next_observation))


def normaliser_of(statistics: Statistics | None, limit: float = LIMIT) -> Normaliser | None:
    """Return the normaliser of the exported policy, which does what `normalise` does."""
    return None if statistics is None else Normaliser(statistics.mean, statistics.std, jnp.float32(limit))
