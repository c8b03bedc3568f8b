"""Twin Delayed Deep Deterministic policy gradient (Fujimoto et al. 2018)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from csac.algorithms.critics import Critics, min_q, q_value, update_critics
from csac.algorithms.hyperparameters import COUNT, NOT_NEGATIVE
from csac.algorithms.networks import MLP, copy_tree, gradient_step, polyak
from csac.algorithms.off_policy import TwinCritics, first_metrics, improve_delayed, policy_network
from csac.algorithms.shapes import Action, Count, Key, Observation, Observations, Scalar
from csac.algorithms.statistics import Statistics, normalise, normalise_batch
from csac.types import Metrics, PolicyNetwork, Spec, Transition


class State(NamedTuple):
    """The learnt state of one TD3 seed."""

    actor: MLP
    target_actor: MLP
    critics: Critics
    target_critics: Critics | None
    actor_optimiser: Any
    critic_optimiser: Any
    observation_statistics: Statistics | None = None
    actor_metrics: Metrics | None = None  # with a policy delay: the metrics of the actor's last step


@dataclass(frozen=True)
class TD3(TwinCritics):
    """Twin Delayed DDPG (its Algorithm 1)."""

    policy_delay: Annotated[int, COUNT] = 2
    """Critic updates per update of the actor and of the targets (the paper's d)."""
    exploration_std: Annotated[float, NOT_NEGATIVE] = 0.1
    """Standard deviation of the exploration noise (the paper's sigma)."""
    target_noise: Annotated[float, NOT_NEGATIVE] = 0.2
    """Standard deviation of the noise on the target actor's actions (the paper's sigma tilde)."""
    target_noise_clip: Annotated[float, NOT_NEGATIVE] = 0.5
    """Bound on that noise (the paper's c)."""

    name: ClassVar[str] = "td3"

    def critic_target(self, transition: Transition, noise: Action, *, target_actor: MLP, targets: Critics) -> Scalar:
        """Return y = r + γ min Q'(s', ã) at the smoothed action (Algorithm 1), no bootstrap after a terminal step."""
        action = self.smoothed_action(target_actor, transition.next_observation, noise)
        value = min_q(targets, transition.next_observation, action)
        return transition.reward + self.discount_after(transition) * value

    def smoothed_action(self, target_actor: MLP, observation: Observation, noise: Action) -> Action:
        """Return ã = clip(π'(s') + clip(σ̃ ξ, -c, c), -1, 1) for noise ξ ~ N(0, I) (Algorithm 1)."""
        noise = jnp.clip(self.target_noise * noise, -self.target_noise_clip, self.target_noise_clip)
        return jnp.clip(jnp.tanh(target_actor(observation)) + noise, -1.0, 1.0)

    def actor_loss(self, actor: MLP, observation: Observation, *, critics: Critics) -> tuple[Scalar, Metrics]:
        """Return -Q₁(s, π(s)), whose gradient is minus the deterministic policy gradient (Algorithm 1)."""
        loss = -q_value(critics[0], observation, jnp.tanh(actor(observation)))
        return loss, {"actor_loss": loss}

    def update(self, state: State, batch: Transition, key: Key, step: Count) -> tuple[State, Metrics]:
        """Take one gradient step on the critics; every `policy_delay`-th time, update the actor, then the targets."""
        statistics, batch = normalise_batch(state.observation_statistics, batch)
        state = state._replace(observation_statistics=statistics)
        noise = jax.random.normal(key, batch.action.shape)

        critic_target = partial(self.critic_target, target_actor=state.target_actor)
        adam, next_action = self.optimiser(self.critic_learning_rate), partial(self.smoothed_action, state.target_actor)
        state, folded_critics, metrics = update_critics(adam, state, batch, noise, critic_target, next_action)

        arguments = (folded_critics, batch.observation)
        state, actor_metrics = improve_delayed(self.policy_delay, step, self.improve, state, *arguments)
        return state, {**metrics, **actor_metrics}

    def improve(self, state: State, critics: Critics, observations: Observations) -> tuple[State, Metrics]:
        """Return the state after one gradient step on the actor, with the new critics, and on the targets."""
        loss, adam = partial(self.actor_loss, critics=critics), self.optimiser(self.actor_learning_rate)
        actor, optimiser, metrics = gradient_step(adam, loss, state.actor, state.actor_optimiser, observations)
        state = state._replace(
            actor=actor,
            actor_optimiser=optimiser,
            target_actor=polyak(state.target_actor, actor, self.target_rate),
            target_critics=polyak(state.target_critics, state.critics, self.target_rate),
        )
        return state, metrics

    def init(self, key: Key, spec: Spec, steps: int) -> State:
        """Return random networks, with copies as targets."""
        networks = self.first_networks(key, spec, steps, spec.action_size)
        metrics = first_metrics(("actor_loss",), self.policy_delay)
        return State(**networks, target_actor=copy_tree(networks["actor"]), actor_metrics=metrics)

    def act(self, state: State, observation: Observation, key: Key, explore: bool) -> Action:
        """Return tanh(actor); if exploring, with noise and clipped to [-1, 1]."""
        action = jnp.tanh(state.actor(normalise(state.observation_statistics, observation)))
        if not explore:
            return action
        return jnp.clip(action + self.exploration_std * self.noise(key, action.size), -1.0, 1.0)

    def policy(self, state: State) -> PolicyNetwork:
        """Return the actor's layers and its observation normaliser."""
        return policy_network(state.actor, state.observation_statistics, "tanh")
