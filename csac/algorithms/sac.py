"""Soft Actor-Critic (Haarnoja et al. 2018), with a fixed temperature or the learnt one of its second paper."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp

from csac.algorithms.critics import Critics, min_q, update_critics
from csac.algorithms.distributions import action_at, policy_at
from csac.algorithms.hyperparameters import NOT_NEGATIVE
from csac.algorithms.networks import MLP, gradient_step, polyak
from csac.algorithms.off_policy import MaximumEntropy, first_metrics, improve_delayed
from csac.algorithms.shapes import Action, Actions, Count, Key, Observation, Observations, Scalar
from csac.algorithms.statistics import Statistics, normalise_batch
from csac.algorithms.temperature import Temperature, finite_log
from csac.types import Metrics, Spec, Transition


class State(NamedTuple):
    """The learnt state of one SAC seed."""

    actor: MLP
    critics: Critics
    target_critics: Critics | None
    temperature: Temperature  # learnt or fixed
    actor_optimiser: Any
    critic_optimiser: Any
    observation_statistics: Statistics | None = None
    average: MLP | None = None  # average of past actors, if it is evaluated
    actor_metrics: Metrics | None = None  # with a policy delay: the metrics of the actor's last step


@dataclass(frozen=True)
class SAC(MaximumEntropy):
    """Soft Actor-Critic."""

    entropy_weight: Annotated[float, NOT_NEGATIVE] | Literal["auto"] = "auto"
    """Weight of the entropy (SAC's temperature alpha); `auto` learns it, to keep the entropy at its target."""

    name: ClassVar[str] = "sac"

    def critic_target(
        self, transition: Transition, noise: Action, *, actor: MLP, targets: Critics, temperature: Scalar
    ) -> Scalar:
        """Return r + γ [min Q(s', a') - α log π(a'|s')] with a' = tanh(mean + std noise) (second paper, Eq. 3)."""
        policy = policy_at(actor, transition.next_observation)
        q_value = min_q(targets, transition.next_observation, policy.sample(noise))
        value = q_value - temperature * policy.log_prob(noise)
        return transition.reward + self.discount_after(transition) * value

    def actor_loss(
        self, actor: MLP, observation: Observation, noise: Action, *, critics: Critics, temperature: Scalar
    ) -> tuple[Scalar, Metrics]:
        """Return α log π - min Q at the reparameterised action (second paper, Eq. 9), and the metrics."""
        policy = policy_at(actor, observation)
        q_value = min_q(critics, observation, policy.sample(noise))
        log_prob = policy.log_prob(noise)
        loss = temperature * log_prob - q_value
        return loss, {"actor_loss": loss, "entropy": -log_prob}

    def update(self, state: State, batch: Transition, key: Key, step: Count) -> tuple[State, Metrics]:
        """Take one gradient step on the critics, then on the actor and the temperature; move the target critics."""
        statistics, batch = normalise_batch(state.observation_statistics, batch)
        state = state._replace(observation_statistics=statistics)
        if self.entropy_weight != "auto":  # a fork may have changed it
            log_weight = finite_log(self.entropy_weight)
            state = state._replace(temperature=state.temperature._replace(log_weight=log_weight))
        target_noise, actor_noise = jax.random.normal(key, (2, *batch.action.shape))
        temperature = jnp.exp(state.temperature.log_weight)

        critic_target = partial(self.critic_target, actor=state.actor, temperature=temperature)
        adam, next_action = self.optimiser(self.critic_learning_rate), partial(action_at, state.actor)
        state, folded_critics, metrics = update_critics(adam, state, batch, target_noise, critic_target, next_action)

        arguments = (folded_critics, batch.observation, actor_noise, step)
        state, actor_metrics = improve_delayed(self.policy_delay, step, self.improve, state, *arguments)
        state = state._replace(target_critics=polyak(state.target_critics, state.critics, self.target_rate))
        return state, {**metrics, **actor_metrics, "temperature": temperature}

    def improve(
        self, state: State, critics: Critics, observations: Observations, noise: Actions, step: Count
    ) -> tuple[State, Metrics]:
        """Return the state after one step on the actor, its average and the temperature, and the actor's metrics."""
        temperature = state.temperature
        loss = partial(self.actor_loss, critics=critics, temperature=jnp.exp(temperature.log_weight))
        adam = self.optimiser(self.actor_learning_rate)
        actor, optimiser, metrics = gradient_step(adam, loss, state.actor, state.actor_optimiser, observations, noise)
        if self.entropy_weight == "auto":
            temperature = self.adapt_temperature(temperature, metrics["entropy"], noise.shape[-1])
        learnt = {"actor": actor, "actor_optimiser": optimiser, "temperature": temperature}
        return state._replace(**learnt, average=self.average_after(state.average, actor, step)), metrics

    def init(self, key: Key, spec: Spec, steps: int) -> State:
        """Return random networks, with copies as targets."""
        return State(
            **self.first_networks(key, spec, steps, 2 * spec.action_size),
            temperature=self.first_temperature(self.entropy_weight),
            actor_metrics=first_metrics(("actor_loss", "entropy"), self.policy_delay),
        )
