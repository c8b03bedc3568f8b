"""Two critics Q(s, a) that learn side by side: how they are made, what they say and what they descend."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import jax
import jax.numpy as jnp

from csac.algorithms.networks import MLP, make_mlp
from csac.algorithms.shapes import Action, Key, Observation, Scalar
from csac.types import Metrics, Spec, Transition

if TYPE_CHECKING:
    from collections.abc import Sequence

Critics: TypeAlias = tuple[MLP, MLP]


def make_critic(key: Key, spec: Spec, hidden_sizes: Sequence[int]) -> MLP:
    """Return one random critic, a map from [observation + action] to [1]."""
    return make_mlp(key, spec.observation_size + spec.action_size, hidden_sizes, 1)


def make_critics(key: Key, spec: Spec, hidden_sizes: Sequence[int]) -> Critics:
    """Return two independent critics."""
    first_key, second_key = jax.random.split(key)
    return make_critic(first_key, spec, hidden_sizes), make_critic(second_key, spec, hidden_sizes)


def q_value(critic: MLP, observation: Observation, action: Action) -> Scalar:
    """Return one critic's value of one pair."""
    return critic(jnp.concatenate([observation, action]))[0]


def q_values(critics: Critics, observation: Observation, action: Action) -> tuple[Scalar, Scalar]:
    """Return both critics' values of one pair. Two products side by side beat one batched product on a CPU."""
    first, second = critics
    return q_value(first, observation, action), q_value(second, observation, action)


def least_q_value(critics: Critics, observation: Observation, action: Action) -> Scalar:
    """Return min(Q₁(s, a), Q₂(s, a)), which promises less than either of them where they err."""
    return jnp.minimum(*q_values(critics, observation, action))


def critic_loss(critics: Critics, transition: Transition, target: Scalar) -> tuple[Scalar, Metrics]:
    """Return L(θ₁) + L(θ₂) with L(θᵢ) = [Qᵢ(s, a) - y]² (the paper's Eq. Q_TD_1), and what to log."""
    first, second = q_values(critics, transition.observation, transition.action)
    loss = (first - target) ** 2 + (second - target) ** 2
    return loss, {"critic_loss": loss, "q_mean": (first + second) / 2.0}
