"""Twin Delayed Deep Deterministic policy gradient (Fujimoto et al. 2018)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax

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
    """Everything that one seed of TD3 learns."""

    actor: MLP
    target_actor: MLP
    critics: tuple[MLP, MLP]
    target_critics: tuple[MLP, MLP]
    actor_optimiser: Any
    critic_optimiser: Any
    actor_loss: jax.Array  # [] when the actor last moved, to be reported until it moves again


@dataclass(frozen=True)
class TD3:
    """Twin Delayed DDPG (its Algorithm 1)."""

    exploration_noise: Annotated[float, NOT_NEGATIVE] = 0.1
    """Standard deviation of the noise on the actions that explore (the paper's sigma)."""
    target_noise: Annotated[float, NOT_NEGATIVE] = 0.2
    """Standard deviation of the noise on the target actor's actions (the paper's sigma tilde)."""
    target_noise_clip: Annotated[float, NOT_NEGATIVE] = 0.5
    """Bound on that noise (the paper's c)."""
    policy_delay: Annotated[int, COUNT] = 2
    """Updates of the critics for each update of the actor and of the targets (the paper's d)."""
    discount: Annotated[float, DISCOUNT] = 0.99
    """Discount factor (gamma)."""
    target_rate: Annotated[float, RATE] = 0.005
    """Soft update rate of the targets (the paper's tau)."""
    actor_learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate of the actor."""
    critic_learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate of the critics."""
    actor_hidden_sizes: Annotated[tuple[int, ...], WIDTHS] = (256, 256)
    """Widths of the actor's hidden layers."""
    critic_hidden_sizes: Annotated[tuple[int, ...], WIDTHS] = (256, 256)
    """Widths of each critic's hidden layers."""
    batch_size: Annotated[int, COUNT] = 256
    """Transitions in one update."""
    replay_size: Annotated[int, COUNT] = 1_000_000
    """Transitions that the replay keeps."""
    warmup_steps: Annotated[int, NOT_NEGATIVE] = 10_000
    """Environment steps with uniform random actions before learning starts."""
    updates_per_step: Annotated[int, COUNT] = 1
    """Updates for each environment step."""
    update_interval: Annotated[int, COUNT] = 1
    """Environment steps after which their updates are made, all at once; 1 is strict order, more is faster."""
    max_gradient_norm: Annotated[float, NOT_NEGATIVE] = 0.0
    """Bound on the global norm of each network's gradient; 0 leaves gradients alone."""

    name: ClassVar[str] = "td3"

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
        """Return random networks; the targets are copies."""
        actor_key, critics_key = jax.random.split(key)
        actor = make_mlp(actor_key, spec.observation_size, self.actor_hidden_sizes, spec.action_size)
        critics = make_critics(critics_key, *spec, self.critic_hidden_sizes)
        return State(
            actor=actor,
            target_actor=copy_tree(actor),
            critics=critics,
            target_critics=copy_tree(critics),
            actor_optimiser=begin_descent(self._optimiser(self.actor_learning_rate), actor),
            critic_optimiser=begin_descent(self._optimiser(self.critic_learning_rate), critics),
            actor_loss=jnp.zeros(()),
        )

    def act(self, state: State, observation: jax.Array, key: jax.Array, explore: bool) -> jax.Array:
        """Return tanh(actor), with noise and clipped to [-1, 1] to explore."""
        action = jnp.tanh(state.actor(observation))
        if not explore:
            return action
        return jnp.clip(action + self.exploration_noise * jax.random.normal(key, action.shape), -1.0, 1.0)

    def smoothed_action(self, target_actor: MLP, observation: jax.Array, noise: jax.Array) -> jax.Array:
        """Return clip(π'(s') + clip(σ̃ ξ, -c, c), -1, 1) for ξ ~ N(0, I) [action] (Algorithm 1)."""
        noise = jnp.clip(self.target_noise * noise, -self.target_noise_clip, self.target_noise_clip)
        return jnp.clip(jnp.tanh(target_actor(observation)) + noise, -1.0, 1.0)

    def critic_target(
        self, target_actor: MLP, target_critics: tuple[MLP, MLP], transition: Transition, noise: jax.Array
    ) -> jax.Array:
        """Return y = r + γ min Q'(s', ã) at the smoothed action (Algorithm 1), and no future after a terminal step."""
        action = self.smoothed_action(target_actor, transition.next_observation, noise)
        value = jnp.minimum(*q_values(target_critics, transition.next_observation, action))
        return transition.reward + self.discount * (1.0 - transition.terminated) * value

    def update(self, state: State, batch: Transition, key: jax.Array, step: jax.Array) -> tuple[State, Metrics]:
        """Take one gradient step on the critics; every `policy_delay`-th time move the actor, then the targets."""
        noise = jax.random.normal(key, batch.action.shape)
        targets = jax.vmap(self.critic_target, in_axes=(None, None, 0, 0))(
            state.target_actor, state.target_critics, batch, noise
        )

        def critics_loss(critics: tuple[MLP, MLP]) -> tuple[jax.Array, Metrics]:
            losses, metrics = jax.vmap(critic_loss, in_axes=(None, 0, 0))(critics, batch, targets)
            return jnp.mean(losses), jax.tree.map(jnp.mean, {"critic_loss": losses, **metrics})

        critics, critic_optimiser, metrics = descend(
            self._optimiser(self.critic_learning_rate), critics_loss, state.critics, state.critic_optimiser
        )
        state = state._replace(critics=critics, critic_optimiser=critic_optimiser)
        state = jax.lax.cond(
            (step + 1) % self.policy_delay == 0, self.delayed_update, lambda state, _: state, state, batch.observation
        )
        return state, {**metrics, "actor_loss": state.actor_loss}

    def delayed_update(self, state: State, observations: jax.Array) -> State:
        """Return the state after one gradient step on the actor, against the new critics, and one of the targets."""

        def mean_loss(actor: MLP) -> tuple[jax.Array, jax.Array]:
            loss = jnp.mean(jax.vmap(actor_loss, in_axes=(None, None, 0))(actor, state.critics, observations))
            return loss, loss

        actor, actor_optimiser, loss = descend(
            self._optimiser(self.actor_learning_rate), mean_loss, state.actor, state.actor_optimiser
        )
        return state._replace(
            actor=actor,
            target_actor=polyak(state.target_actor, actor, self.target_rate),
            target_critics=polyak(state.target_critics, state.critics, self.target_rate),
            actor_optimiser=actor_optimiser,
            actor_loss=loss,
        )

    def policy(self, state: State) -> PolicyNetwork:
        """Return the actor's layers."""
        return PolicyNetwork(PolicyParameters((state.actor.layers,)), head="tanh")

    def _optimiser(self, learning_rate: float) -> optax.GradientTransformation:
        return make_optimiser(learning_rate, self.max_gradient_norm)


def critic_loss(critics: tuple[MLP, MLP], transition: Transition, target: jax.Array) -> tuple[jax.Array, Metrics]:
    """Return [Q₁(s, a) - y]² + [Q₂(s, a) - y]² (Algorithm 1), and what to log."""
    first, second = q_values(critics, transition.observation, transition.action)
    return (first - target) ** 2 + (second - target) ** 2, {"q_mean": first}


def actor_loss(actor: MLP, critics: tuple[MLP, MLP], observation: jax.Array) -> jax.Array:
    """Return -Q₁(s, π(s)), whose gradient is the deterministic policy gradient against its sign (Algorithm 1)."""
    first, _ = q_values(critics, observation, jnp.tanh(actor(observation)))
    return -first
