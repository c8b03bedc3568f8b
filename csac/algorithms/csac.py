"""Conservative Soft Actor-Critic: entropy and relative entropy in the value function and in policy improvement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax

from csac.algorithms.distributions import kl, log_ratio, policy_at
from csac.algorithms.hyperparameters import (
    COUNT,
    DISCOUNT,
    NOT_NEGATIVE,
    POSITIVE,
    RATE,
    WIDTHS,
    accept_hyperparameters,
)
from csac.algorithms.memory import Replay, replay_cadence
from csac.algorithms.networks import (
    MLP,
    begin_descent,
    copy_tree,
    descend,
    make_critics,
    make_mlp,
    make_optimiser,
    polyak,
    q_values,
)
from csac.types import Cadence, Metrics, PolicyNetwork, PolicyParameters, Spec, Transition


class State(NamedTuple):
    """Everything that one seed of CSAC learns."""

    actor: MLP
    reference: MLP
    critics: tuple[MLP, MLP]
    target_critics: tuple[MLP, MLP]
    actor_optimiser: Any
    critic_optimiser: Any


def regularised_value(q_value, log_prob, relative_entropy, entropy_weight, relative_entropy_weight):
    """Return Q - σ log π - τ log(π/π̃): the bracket of Eq. Q_CSAC, which critic and actor share."""
    return q_value - entropy_weight * log_prob - relative_entropy_weight * relative_entropy


def critic_loss(critics: tuple[MLP, MLP], transition: Transition, target: jax.Array) -> jax.Array:
    """Return L(θ₁) + L(θ₂), L(θᵢ) = [Qᵢ(s, a) - y]² (Eq. Q_TD_1)."""
    first, second = q_values(critics, transition.observation, transition.action)
    return (first - target) ** 2 + (second - target) ** 2


@dataclass(frozen=True)
class CSAC:
    """Conservative Soft Actor-Critic (the paper's Algorithm 1)."""

    entropy_weight: Annotated[float, NOT_NEGATIVE] = 0.2
    """Weight of the entropy (the paper's sigma)."""
    relative_entropy_weight: Annotated[float, NOT_NEGATIVE] = 0.5
    """Weight of the relative entropy towards the reference policy (the paper's tau); 0 is SAC."""
    reference_policy: Literal["algorithm1", "previous", "periodic", "average"] = "periodic"
    """The reference: the actor before the gradients or before the last update, a periodic copy, or an average."""
    reference_period: Annotated[int, COUNT] = 1000
    """Updates between two copies of the actor, with `periodic`."""
    reference_rate: Annotated[float, RATE] = 0.005
    """Step of the running average towards the actor, with `average`."""
    relative_entropy_estimator: Literal["closed_form", "sampled"] = "closed_form"
    """The exact KL of the two policies, or the paper's log-ratio at the sampled action."""
    discount: Annotated[float, DISCOUNT] = 0.99
    """Discount factor (gamma)."""
    target_rate: Annotated[float, RATE] = 0.005
    """Soft update rate of the target critics (the paper's rho)."""
    actor_learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate of the actor."""
    critic_learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate of the critics."""
    actor_hidden_sizes: Annotated[tuple[int, ...], WIDTHS] = (256, 256)
    """Widths of the actor's hidden layers."""
    critic_hidden_sizes: Annotated[tuple[int, ...], WIDTHS] = (256, 256)
    """Widths of each critic's hidden layers."""
    batch_size: Annotated[int, COUNT] = 256
    """Transitions in one update (the paper's M)."""
    replay_size: Annotated[int, COUNT] = 1_000_000
    """Transitions that the replay keeps."""
    warmup_steps: Annotated[int, NOT_NEGATIVE] = 10_000
    """Environment steps with uniform random actions before learning starts (the paper's T_initial)."""
    updates_per_step: Annotated[int, COUNT] = 1
    """Updates for each environment step."""
    update_interval: Annotated[int, COUNT] = 1
    """Environment steps after which their updates are made, all at once; 1 is strict order, more is faster."""
    max_gradient_norm: Annotated[float, NOT_NEGATIVE] = 0.0
    """Bound on the global norm of each network's gradient; 0 leaves gradients alone."""

    name: ClassVar[str] = "csac"

    def __post_init__(self) -> None:
        accept_hyperparameters(self)

    @property
    def cadence(self) -> Cadence:
        """When it learns, and from how much."""
        return replay_cadence(self.warmup_steps, self.update_interval, self.updates_per_step, self.batch_size)

    def memory(self, spec: Spec, steps: int) -> Replay:
        """Return an empty replay that holds `replay_size` transitions, or the whole run where that is shorter."""
        return Replay.create(min(self.replay_size, steps), spec, self.update_interval)

    def init(self, key: jax.Array, spec: Spec, steps: int) -> State:
        """Return random networks; targets and reference are copies."""
        actor_key, critics_key = jax.random.split(key)
        actor = make_mlp(actor_key, spec.observation_size, self.actor_hidden_sizes, 2 * spec.action_size)
        critics = make_critics(critics_key, *spec, self.critic_hidden_sizes)
        return State(
            actor=actor,
            reference=copy_tree(actor),
            critics=critics,
            target_critics=copy_tree(critics),
            actor_optimiser=begin_descent(self._optimiser(self.actor_learning_rate), actor),
            critic_optimiser=begin_descent(self._optimiser(self.critic_learning_rate), critics),
        )

    def act(self, state: State, observation: jax.Array, key: jax.Array, explore: bool) -> jax.Array:
        """Return ã(s, ξ) to explore (Eq. actor), else tanh(mean)."""
        policy = policy_at(state.actor, observation)
        return jnp.tanh(policy.pre_tanh(jax.random.normal(key, policy.mean.shape))) if explore else policy.mode()

    def critic_target(
        self, actor: MLP, reference: MLP, target_critics: tuple[MLP, MLP], transition: Transition, noise: jax.Array
    ) -> jax.Array:
        """Return y(s, a, s') with a' = tanh(mean + std noise) (Eq. Q_TD_2), and no future after a terminal step."""
        value, _ = self._value(actor, reference, target_critics, transition.next_observation, noise)
        return transition.reward + self.discount * (1.0 - transition.terminated) * value

    def actor_loss(
        self, actor: MLP, reference: MLP, critics: tuple[MLP, MLP], observation: jax.Array, noise: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """Return J(φ) = (τ + σ) log π - τ log π̃ - min Q at ã(s, noise) (Eq. actor_update_2), and what to log."""
        value, metrics = self._value(actor, reference, critics, observation, noise)
        return -value, metrics

    def _value(
        self, actor: MLP, reference: MLP, critics: tuple[MLP, MLP], observation: jax.Array, noise: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """Return the regularised value of the action that the actor takes with this noise, and its parts."""
        policy, reference_policy = policy_at(actor, observation), policy_at(reference, observation)
        pre_tanh = policy.pre_tanh(noise)
        q_value = jnp.minimum(*q_values(critics, observation, jnp.tanh(pre_tanh)))
        log_prob = policy.log_prob(pre_tanh)
        if self.relative_entropy_estimator == "closed_form":
            relative_entropy = kl(policy, reference_policy)
        else:
            relative_entropy = log_ratio(policy, reference_policy, pre_tanh)
        value = regularised_value(
            q_value, log_prob, relative_entropy, self.entropy_weight, self.relative_entropy_weight
        )
        return value, {"q_mean": q_value, "entropy": -log_prob, "relative_entropy": relative_entropy}

    def update(self, state: State, batch: Transition, key: jax.Array, step: jax.Array) -> tuple[State, Metrics]:
        """Take one gradient step on the critics, then one on the actor, then move the target critics."""
        target_noise, actor_noise = jax.random.normal(key, (2, *batch.action.shape))
        reference = self.reference_before(state, step)

        targets = jax.vmap(self.critic_target, in_axes=(None, None, None, 0, 0))(
            state.actor, reference, state.target_critics, batch, target_noise
        )

        def critics_loss(critics: tuple[MLP, MLP]) -> tuple[jax.Array, Metrics]:
            loss = jnp.mean(jax.vmap(critic_loss, in_axes=(None, 0, 0))(critics, batch, targets))
            return loss, {"critic_loss": loss}

        critics, critic_optimiser, critic_metrics = descend(
            self._optimiser(self.critic_learning_rate), critics_loss, state.critics, state.critic_optimiser
        )

        def actor_loss(actor: MLP) -> tuple[jax.Array, Metrics]:
            losses, metrics = jax.vmap(self.actor_loss, in_axes=(None, None, None, 0, 0))(
                actor, reference, critics, batch.observation, actor_noise
            )
            return jnp.mean(losses), jax.tree.map(jnp.mean, {"actor_loss": losses, **metrics})

        actor, actor_optimiser, actor_metrics = descend(
            self._optimiser(self.actor_learning_rate), actor_loss, state.actor, state.actor_optimiser
        )

        new_state = State(
            actor=actor,
            reference=self.reference_after(state, reference),
            critics=critics,
            target_critics=polyak(state.target_critics, critics, self.target_rate),
            actor_optimiser=actor_optimiser,
            critic_optimiser=critic_optimiser,
        )
        return new_state, {**critic_metrics, **actor_metrics}

    def reference_before(self, state: State, step: jax.Array) -> MLP:
        """Return the reference policy that this update uses."""
        if self.reference_policy == "algorithm1":
            return state.actor
        if self.reference_policy == "periodic":
            renew = step % self.reference_period == 0
            return jax.tree.map(lambda old, new: jnp.where(renew, new, old), state.reference, state.actor)
        return state.reference

    def reference_after(self, state: State, reference: MLP) -> MLP:
        """Return the reference policy to keep, given the state before the gradients and the reference just used."""
        if self.reference_policy == "previous":
            return state.actor
        if self.reference_policy == "average":
            return polyak(state.reference, state.actor, self.reference_rate)
        return reference

    def policy(self, state: State) -> PolicyNetwork:
        """Return the actor's layers."""
        return PolicyNetwork(PolicyParameters((state.actor.layers,)))

    def _optimiser(self, learning_rate: float) -> optax.GradientTransformation:
        return make_optimiser(learning_rate, self.max_gradient_norm)
