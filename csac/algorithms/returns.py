"""Returns and advantages of a rollout: transitions in order, [time], or [time, environment] if there are several."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from csac.algorithms.shapes import Scalar, Scalars
from csac.types import Transition


def discounted_returns(
    start: Float[Array, "..."], batch: Transition, discount: float
) -> tuple[Float[Array, "time ..."], Float[Array, "..."]]:
    """Return R_t = r_t + γ R_{t-1}, from 0 in each episode, and the value that the next rollout continues from."""

    def advance(running: jax.Array, transition: Transition) -> tuple[jax.Array, jax.Array]:
        running = discount * running + transition.reward
        return running * _continues(transition), running

    last, returns = jax.lax.scan(advance, start, batch)
    return returns, last


def advantages_of(
    batch: Transition,
    values: Float[Array, "time ..."],
    next_values: Float[Array, "time ..."],
    discount: float,
    trace_decay: float,
) -> Float[Array, "time ..."]:
    """Return the generalised advantages of a rollout (GAE, Eq. 16; PPO, Eq. 11).

    A_t = δ_t + γ λ A_{t+1} with δ_t = r_t + γ (1 - terminated_t) V(s_{t+1}) - V(s_t), where step t led to
    s_{t+1}. Nothing is carried back over the end of an episode, terminated or truncated, nor from beyond the rollout.
    """
    errors = batch.reward + discount * (1.0 - batch.terminated) * next_values - values
    decays = discount * trace_decay * _continues(batch)

    def step_back(advantage: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        error, decay = step
        advantage = error + decay * advantage
        return advantage, advantage

    return jax.lax.scan(step_back, jnp.zeros(errors.shape[1:]), (errors, decays), reverse=True)[1]


def explained_variance(values: Scalars, targets: Scalars) -> Scalar:
    """Return 1 - Var[target - value] / Var[target]; 0 where the targets do not vary."""
    variance = jnp.var(targets)
    explained = 1.0 - jnp.var(targets - values) / jnp.where(variance > 0, variance, 1.0)
    return jnp.where(variance > 0, explained, 0.0)


def _continues(transition: Transition) -> Float[Array, "..."]:
    """Return 0 where the episode was terminated or truncated, else 1."""
    return (1.0 - transition.terminated) * (1.0 - transition.truncated)
