"""Twin Delayed Deep Deterministic policy gradient (Fujimoto et al. 2018)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from csac.algorithms.critics import (
    Critics,
    Normalisation,
    least_q_value,
    make_critics,
    make_targets,
    q_value,
    update_critics,
)
from csac.algorithms.hyperparameters import COUNT, DISCOUNT, NOT_NEGATIVE, POSITIVE, RATE, WIDTHS, check_hyperparameters
from csac.algorithms.memory import Replay, replay_cadence
from csac.algorithms.networks import MLP, copy_tree, descend, init_optimiser, make_mlp, make_optimiser, polyak
from csac.algorithms.shapes import Action, Count, Key, Observation, Scalar
from csac.algorithms.statistics import Statistics, make_statistics, normalise, normalise_batch, normaliser_of
from csac.types import Cadence, Metrics, PolicyNetwork, PolicyParameters, Spec, Transition


class State(NamedTuple):
    """Everything that one seed of TD3 learns."""

    actor: MLP
    target_actor: MLP
    critics: Critics
    target_critics: Critics | None
    actor_optimiser: Any
    critic_optimiser: Any
    actor_loss: Scalar  # when the actor last moved, to be reported until it moves again
    observations: Statistics | None = None


@dataclass(frozen=True)
class TD3:
    """Twin Delayed DDPG (its Algorithm 1)."""

    exploration_noise: Annotated[float, NOT_NEGATIVE] = 0.1
    """Standard deviation of the exploration noise (the paper's sigma)."""
    target_noise: Annotated[float, NOT_NEGATIVE] = 0.2
    """Standard deviation of the noise on the target actor's actions (the paper's sigma tilde)."""
    target_noise_clip: Annotated[float, NOT_NEGATIVE] = 0.5
    """Bound on that noise (the paper's c)."""
    policy_delay: Annotated[int, COUNT] = 2
    """Critic updates per update of the actor and of the targets (the paper's d)."""
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
    critic_normalisation: Normalisation = "none"
    """`batch` normalises the inputs of the critics' layers over each batch, without target critics (CrossQ)."""
    normalise_observations: bool = False
    """Whether to normalise observations to mean 0 and standard deviation 1 by running statistics."""
    batch_size: Annotated[int, COUNT] = 256
    """Transitions in one update."""
    replay_size: Annotated[int, COUNT] = 1_000_000
    """Transitions that the replay keeps."""
    warmup_steps: Annotated[int, NOT_NEGATIVE] = 10_000
    """Environment steps with uniform random actions before learning starts."""
    updates_per_step: Annotated[int, COUNT] = 1
    """Updates per environment step."""
    update_interval: Annotated[int, COUNT] = 1
    """Environment steps between rounds of updates; 1 is strict order, larger is faster."""
    adam_momentum: Annotated[float, DISCOUNT] = 0.9
    """Decay of the average gradient in Adam (its beta1)."""
    max_gradient_norm: Annotated[float, NOT_NEGATIVE] = 0.0
    """Bound on the global norm of each network's gradient (both critics count as one); 0 is no bound."""

    name: ClassVar[str] = "td3"

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    def critic_target(
        self, transition: Transition, noise: Action, *, target_actor: MLP, target_critics: Critics
    ) -> Scalar:
        """Return y = r + γ min Q'(s', ã) at the smoothed action (Algorithm 1), and no future after a terminal step."""
        action = self.smoothed_action(target_actor, transition.next_observation, noise)
        value = least_q_value(target_critics, transition.next_observation, action)
        return transition.reward + self.discount * (1.0 - transition.terminated) * value

    def smoothed_action(self, target_actor: MLP, observation: Observation, noise: Action) -> Action:
        """Return ã = clip(π'(s') + clip(σ̃ ξ, -c, c), -1, 1) for noise ξ ~ N(0, I) (Algorithm 1)."""
        noise = jnp.clip(self.target_noise * noise, -self.target_noise_clip, self.target_noise_clip)
        return jnp.clip(jnp.tanh(target_actor(observation)) + noise, -1.0, 1.0)

    def actor_loss(self, actor: MLP, observation: Observation, *, critics: Critics) -> tuple[Scalar, Scalar]:
        """Return -Q₁(s, π(s)), twice: its gradient is minus the deterministic policy gradient (Algorithm 1)."""
        loss = -q_value(critics[0], observation, jnp.tanh(actor(observation)))
        return loss, loss

    def update(self, state: State, batch: Transition, key: Key, step: Count) -> tuple[State, Metrics]:
        """Take one gradient step on the critics; every `policy_delay`-th time move the actor, then the targets."""
        observations, batch = normalise_batch(state.observations, batch)
        noise = jax.random.normal(key, batch.action.shape)
        learnt = update_critics(
            self._optimiser(self.critic_learning_rate),
            *(state.critics, state.target_critics, state.critic_optimiser),
            *(batch, noise),
            critic_target=partial(self.critic_target, target_actor=state.target_actor),
            next_action=partial(self.smoothed_action, state.target_actor),
        )
        state = state._replace(critics=learnt.critics, critic_optimiser=learnt.optimiser, observations=observations)
        is_due = (step + 1) % self.policy_delay == 0
        given = (state, learnt.folded, batch.observation)
        state = jax.lax.cond(is_due, self.delayed_update, lambda state, *_: state, *given)
        return state, {**learnt.metrics, "actor_loss": state.actor_loss}

    def delayed_update(self, state: State, critics: Critics, observations: Float[Array, "batch observation"]) -> State:
        """Return the state after one gradient step on the actor, against the new critics, and one of the targets."""
        actor_loss = partial(self.actor_loss, critics=critics)
        optimiser = self._optimiser(self.actor_learning_rate)
        actor, actor_optimiser, loss = descend(optimiser, actor_loss, state.actor, state.actor_optimiser, observations)
        return state._replace(
            actor=actor,
            target_actor=polyak(state.target_actor, actor, self.target_rate),
            target_critics=polyak(state.target_critics, state.critics, self.target_rate),
            actor_optimiser=actor_optimiser,
            actor_loss=loss,
        )

    @property
    def cadence(self) -> Cadence:
        """When it learns, and from how much."""
        return replay_cadence(self.warmup_steps, self.update_interval, self.updates_per_step, self.batch_size)

    def memory(self, spec: Spec, steps: int) -> Replay:
        """Return an empty replay that holds `replay_size` transitions, or the whole run where that is shorter."""
        return Replay.create(min(self.replay_size, steps), spec, self.update_interval)

    def init(self, key: Key, spec: Spec, steps: int) -> State:
        """Return random networks; the targets are copies."""
        actor_key, critics_key = jax.random.split(key)
        actor = make_mlp(actor_key, spec.observation_size, self.actor_hidden_sizes, spec.action_size)
        critics = make_critics(critics_key, spec, self.critic_hidden_sizes)
        return State(
            actor=actor,
            target_actor=copy_tree(actor),
            critics=critics,
            target_critics=make_targets(critics, self.critic_normalisation),
            actor_optimiser=init_optimiser(self._optimiser(self.actor_learning_rate), actor),
            critic_optimiser=init_optimiser(self._optimiser(self.critic_learning_rate), critics),
            actor_loss=jnp.zeros(()),
            observations=make_statistics(spec.observation_size, self.normalise_observations),
        )

    def act(self, state: State, observation: Observation, key: Key, explore: bool) -> Action:
        """Return tanh(actor), with noise and clipped to [-1, 1] to explore."""
        action = jnp.tanh(state.actor(normalise(state.observations, observation)))
        if not explore:
            return action
        return jnp.clip(action + self.exploration_noise * jax.random.normal(key, action.shape), -1.0, 1.0)

    def policy(self, state: State) -> PolicyNetwork:
        """Return the actor's layers, and what it sees observations by."""
        normaliser = normaliser_of(state.observations)
        return PolicyNetwork(PolicyParameters((state.actor.layers,), normaliser=normaliser), head="tanh")

    def _optimiser(self, learning_rate: float) -> optax.GradientTransformation:
        return make_optimiser(learning_rate, self.max_gradient_norm, momentum=self.adam_momentum)
