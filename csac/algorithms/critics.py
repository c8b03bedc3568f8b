"""Twin critics Q(s, a): their values, their losses and one gradient step on both."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp

from csac.algorithms.networks import MLP, gradient_step
from csac.algorithms.normalisation import fold, normalised_pass
from csac.algorithms.shapes import Action, Actions, Observation, Scalar
from csac.types import Metrics, Transition

if TYPE_CHECKING:
    from collections.abc import Callable

    import optax

Critics: TypeAlias = tuple[MLP, MLP]


def q_value(critic: MLP, observation: Observation, action: Action) -> Scalar:
    """Return one critic's value of one state-action pair."""
    return critic(jnp.concatenate([observation, action]))[0]


def q_values(critics: Critics, observation: Observation, action: Action) -> tuple[Scalar, Scalar]:
    """Return both critics' values. On a CPU two matrix products are faster than one batched product."""
    first, second = critics
    return q_value(first, observation, action), q_value(second, observation, action)


def min_q(critics: Critics, observation: Observation, action: Action) -> Scalar:
    """Return min(Q₁(s, a), Q₂(s, a)), which overestimates less than either critic."""
    return jnp.minimum(*q_values(critics, observation, action))


def critic_loss(critics: Critics, transition: Transition, target: Scalar) -> tuple[Scalar, Metrics]:
    """Return L(θ₁) + L(θ₂) with L(θᵢ) = [Qᵢ(s, a) - y]² (the paper's Eq. Q_TD_1), and the metrics."""
    return squared_errors(q_values(critics, transition.observation, transition.action), target)


def squared_errors(values: tuple[Scalar, Scalar], target: Scalar) -> tuple[Scalar, Metrics]:
    """Return [Q₁ - y]² + [Q₂ - y]², and the metrics."""
    first, second = values
    loss = (first - target) ** 2 + (second - target) ** 2
    return loss, {"critic_loss": loss, "q_mean": (first + second) / 2.0}


def update_critics(
    optimiser: optax.GradientTransformation,
    state: Any,
    batch: Transition,
    noise: Actions,
    critic_target: Callable[..., Scalar],
    next_action: Callable[[Observation, Action], Action],
) -> tuple[Any, Critics, Metrics]:
    """Return the state after one gradient step on its critics, these critics as plain MLPs, and the metrics.

    Without `target_critics` the critics are normalised over the batch, and are their own targets. For one example,
    `critic_target(transition, noise, targets=...)` returns the target, and `next_action(next_observation, noise)` the
    action at which it evaluates the critics; `noise` is the noise of the next actions.
    """
    critics, optimiser_state, targets = state.critics, state.critic_optimiser, state.target_critics
    if targets is not None:
        target_values = jax.vmap(partial(critic_target, targets=targets))(batch, noise)
        critics, optimiser_state, metrics = gradient_step(
            optimiser, critic_loss, critics, optimiser_state, batch, target_values
        )
        folded = critics
    else:
        loss = partial(normalised_critic_loss, critic_target=critic_target, next_action=next_action)
        critics, optimiser_state, metrics = gradient_step(optimiser, loss, critics, optimiser_state, batch, noise)
        first, second = map(fold, critics, metrics.pop("moments"))
        folded = first, second
    return state._replace(critics=critics, critic_optimiser=optimiser_state), folded, metrics


def normalised_critic_loss(
    critics: Critics,
    transition: Transition,
    noise: Action,
    *,
    critic_target: Callable[..., Scalar],
    next_action: Callable[[Observation, Action], Action],
) -> tuple[Scalar, Metrics]:
    """Return `critic_loss` of critics normalised over the batch, and the metrics with the `moments` of that batch.

    The moments are taken over the pairs (s, a) and (s', a') together, so that both are in distribution. The critics are
    their own targets (CrossQ, Fig. 3), through which no gradient passes.
    """
    pairs = (
        jnp.concatenate([transition.observation, transition.action]),
        jnp.concatenate([transition.next_observation, next_action(transition.next_observation, noise)]),
    )
    first, second = (normalised_pass(critic, pairs) for critic in critics)
    # The target needs values that this pass has computed: XLA finds the common products and computes them once.
    target = critic_target(transition, noise, targets=jax.lax.stop_gradient((first.folded, second.folded)))
    values = first.outputs[0][0], second.outputs[0][0]
    loss, metrics = squared_errors(values, jax.lax.stop_gradient(target))
    return loss, {**metrics, "moments": (first.moments, second.moments)}
