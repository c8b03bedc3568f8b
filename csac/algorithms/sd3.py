"""Softmax Deep Double Deterministic policy gradients (Pan, Cai and Huang 2020)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from csac.algorithms.critics import Critics, min_q, q_value
from csac.algorithms.hyperparameters import COUNT, NOT_NEGATIVE, POSITIVE
from csac.algorithms.networks import MLP, copy_tree, gradient_step, init_optimiser, learnable, plain_layers, polyak
from csac.algorithms.off_policy import OffPolicy
from csac.algorithms.shapes import Action, Count, Key, Observation, Scalar
from csac.types import Metrics, PolicyNetwork, PolicyParameters, Spec, Transition

# Examples whose targets are computed at once. The activations of a whole batch exceed a CPU's caches: in groups of this
# size an update takes 40 % less time there.
EXAMPLES_AT_ONCE = 32


class Pair(NamedTuple):
    """An actor, the critic that it maximises, and the targets of both."""

    actor: MLP
    critic: MLP
    target_actor: MLP
    target_critic: MLP
    actor_optimiser: Any
    critic_optimiser: Any


class State(NamedTuple):
    """The learnt state of one SD3 seed."""

    first: Pair
    second: Pair


@dataclass(frozen=True)
class SD3(OffPolicy):
    """Softmax Deep Double Deterministic policy gradients (its Algorithm 1)."""

    inverse_temperature: Annotated[float, NOT_NEGATIVE] = 0.05
    """How strongly the value of a state favours its best sampled actions (the paper's beta); 0 is their mean."""
    noise_samples: Annotated[int, COUNT] = 50
    """Actions sampled around the target actor's action to value a state (the paper's K)."""
    importance_sampling: bool = False
    """Whether to divide each sample's weight by its density (as the paper derives it); its authors' code does not."""
    exploration_std: Annotated[float, NOT_NEGATIVE] = 0.1
    """Standard deviation of the exploration noise."""
    target_noise: Annotated[float, NOT_NEGATIVE] = 0.2
    """Standard deviation of the noise on the target actors' actions (the paper's sigma)."""
    target_noise_clip: Annotated[float, NOT_NEGATIVE] = 0.5
    """Bound on that noise (the paper's c)."""
    actor_learning_rate: Annotated[float, POSITIVE] = 1e-3
    """Learning rate of the actors."""
    critic_learning_rate: Annotated[float, POSITIVE] = 1e-3
    """Learning rate of the critics."""

    name: ClassVar[str] = "sd3"
    batches_per_update: ClassVar[int] = 2

    def critic_target(
        self,
        transition: Transition,
        noise: Float[Array, "sample action"],
        *,
        target_actor: MLP,
        targets: Critics,
    ) -> Scalar:
        """Return y = r + γ softmax of min Q'(s', ãₖ) at ãₖ = clip(π'(s') + clip(σ ξₖ, -c, c), -1, 1) (Algorithm 1).

        `noise` holds the ξₖ ~ N(0, I). There is no bootstrap after a terminal step.
        """
        observation = transition.next_observation
        mean = jnp.tanh(target_actor(observation))

        def value(noise: Action) -> Scalar:
            noise = jnp.clip(self.target_noise * noise, -self.target_noise_clip, self.target_noise_clip)
            return min_q(targets, observation, jnp.clip(mean + noise, -1.0, 1.0))

        log_weights = -log_density(noise) if self.importance_sampling else jnp.zeros(len(noise))
        softmax_value = softmax_operator(jax.vmap(value)(noise), self.inverse_temperature, log_weights)
        return transition.reward + self.discount_after(transition) * softmax_value

    def update(self, state: State, batch: Transition, key: Key, step: Count) -> tuple[State, Metrics]:
        """Update the first pair on half of the batch, then the second, given the first's new target, on the rest."""
        first_key, second_key = jax.random.split(key)
        first_batch = jax.tree.map(lambda leaf: leaf[: self.batch_size], batch)
        second_batch = jax.tree.map(lambda leaf: leaf[self.batch_size :], batch)
        first, first_metrics = self.update_pair(state.first, state.second.target_critic, first_batch, first_key)
        second, second_metrics = self.update_pair(state.second, first.target_critic, second_batch, second_key)
        return State(first, second), jax.tree.map(lambda a, b: (a + b) / 2.0, first_metrics, second_metrics)

    def update_pair(self, pair: Pair, other_target_critic: MLP, batch: Transition, key: Key) -> tuple[Pair, Metrics]:
        """Take one gradient step on the critic, then one on the actor, then move the targets of both."""
        noise = jax.random.normal(key, (len(batch.action), self.noise_samples, batch.action.shape[-1]))
        critic_target = partial(
            self.critic_target,
            target_actor=pair.target_actor,
            targets=(pair.target_critic, other_target_critic),
        )
        targets = jax.lax.map(lambda example: critic_target(*example), (batch, noise), batch_size=EXAMPLES_AT_ONCE)
        optimiser = self.optimiser(self.critic_learning_rate)
        critic, critic_optimiser, critic_metrics = gradient_step(
            optimiser, critic_loss, pair.critic, pair.critic_optimiser, batch, targets
        )
        optimiser = self.optimiser(self.actor_learning_rate)
        actor, actor_optimiser, actor_metrics = gradient_step(
            optimiser, partial(actor_loss, critic=critic), pair.actor, pair.actor_optimiser, batch.observation
        )
        new_pair = Pair(
            actor=actor,
            critic=critic,
            target_actor=polyak(pair.target_actor, actor, self.target_rate),
            target_critic=polyak(pair.target_critic, critic, self.target_rate),
            actor_optimiser=actor_optimiser,
            critic_optimiser=critic_optimiser,
        )
        return new_pair, {**critic_metrics, **actor_metrics}

    def init(self, key: Key, spec: Spec, steps: int) -> State:
        """Return two pairs of random networks, with copies as targets."""
        first_key, second_key = jax.random.split(key)
        return State(self._make_pair(first_key, spec, steps), self._make_pair(second_key, spec, steps))

    def _make_pair(self, key: Key, spec: Spec, steps: int) -> Pair:
        planned = self.updates(spec, steps)
        actor_key, critic_key = jax.random.split(key)
        actor = learnable(self.make_actor(actor_key, spec, spec.action_size), spec.observation_size, spec.action_size)
        critic = learnable(self.make_critic(critic_key, spec), spec.observation_size + spec.action_size, 1)
        return Pair(
            actor=actor,
            critic=critic,
            target_actor=copy_tree(actor),
            target_critic=copy_tree(critic),
            actor_optimiser=init_optimiser(self.optimiser(self.actor_learning_rate, planned), actor),
            critic_optimiser=init_optimiser(self.optimiser(self.critic_learning_rate, planned), critic),
        )

    def act(self, state: State, observation: Observation, key: Key, explore: bool) -> Action:
        """Return the action of the actor whose own critic values it more; if exploring, with noise and clipped."""
        first, second = (jnp.tanh(pair.actor(observation)) for pair in state)
        first_value, second_value = (
            q_value(pair.critic, observation, action) for pair, action in zip(state, (first, second), strict=True)
        )
        action = jnp.where(first_value >= second_value, first, second)
        if not explore:
            return action
        return jnp.clip(action + self.exploration_std * self.noise(key, action.size), -1.0, 1.0)

    def policy(self, state: State) -> PolicyNetwork:
        """Return both actors' and both critics' layers: the critics decide which actor acts."""
        actors, critics = (state.first.actor, state.second.actor), (state.first.critic, state.second.critic)
        parameters = PolicyParameters(tuple(map(plain_layers, actors)), tuple(map(plain_layers, critics)))
        return PolicyNetwork(parameters, actors[0].activation, "tanh", critics[0].activation)


def softmax_operator(
    values: Float[Array, " sample"], inverse_temperature: float, log_weights: Float[Array, " sample"]
) -> Scalar:
    """Return Σ wₖ exp(β Qₖ) Qₖ / Σ wₖ exp(β Qₖ) over the samples, wₖ = exp(log_weights)."""
    return jnp.sum(jax.nn.softmax(inverse_temperature * values + log_weights) * values)


def log_density(noise: Float[Array, "sample action"]) -> Float[Array, " sample"]:
    """Return the log-density of unclipped standard noise, up to a constant."""
    return -0.5 * jnp.sum(noise**2, axis=-1)


def critic_loss(critic: MLP, transition: Transition, target: Scalar) -> tuple[Scalar, Metrics]:
    """Return [Qᵢ(s, a) - y]² (Algorithm 1), and the metrics."""
    value = q_value(critic, transition.observation, transition.action)
    loss = (value - target) ** 2
    return loss, {"critic_loss": loss, "q_mean": value}


def actor_loss(actor: MLP, observation: Observation, *, critic: MLP) -> tuple[Scalar, Metrics]:
    """Return -Qᵢ(s, πᵢ(s)), whose gradient is minus the deterministic policy gradient (Algorithm 1)."""
    loss = -q_value(critic, observation, jnp.tanh(actor(observation)))
    return loss, {"actor_loss": loss}
