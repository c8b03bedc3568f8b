"""Proximal Policy Optimisation (Schulman et al. 2017) with a clipped surrogate and generalised advantage estimation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from csac.algorithms.distributions import Gaussian
from csac.algorithms.hyperparameters import (
    COUNT,
    DISCOUNT,
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    WIDTHS,
    check_hyperparameters,
)
from csac.algorithms.memory import Rollout
from csac.algorithms.networks import (
    MLP,
    Architecture,
    Schedule,
    gradient_step,
    init_optimiser,
    make_optimiser,
    make_orthogonal_mlp,
    scheduled,
)
from csac.algorithms.returns import advantages_of, discounted_returns, explained_variance
from csac.algorithms.shapes import Action, Count, Key, Observation, Scalar, Scalars
from csac.algorithms.statistics import EPSILON, Statistics, normalise, normaliser_of
from csac.types import (
    Activation,
    Cadence,
    InputError,
    Metrics,
    PolicyNetwork,
    PolicyParameters,
    Spec,
    Transition,
)


class Parameters(NamedTuple):
    """The parameters trained by one optimiser."""

    actor: MLP  # [observation] -> mean [action]
    critic: MLP  # [observation] -> [1]
    log_std: Action


class State(NamedTuple):
    """The learnt state of one PPO seed."""

    parameters: Parameters
    optimiser: Any
    observation_statistics: Statistics  # [observation]
    returns: Statistics  # [] of the discounted return so far in each episode
    discounted_return: Float[Array, "..."]  # of the episode, or [environment] episodes, that the last rollout cut off
    total_updates: Scalar  # in this run


class Sample(NamedTuple):
    """A transition prepared for the loss, or several with leading axes."""

    observation: Float[Array, "... observation"]  # normalised
    action: Float[Array, "... action"]
    log_prob: Float[Array, "..."]  # of the action when it was chosen
    value: Float[Array, "..."]  # before the update
    advantage: Float[Array, "..."]
    target: Float[Array, "..."]  # of the value


@dataclass(frozen=True)
class PPO(Architecture):
    """Proximal Policy Optimisation."""

    learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate, initial or constant."""
    learning_rate_schedule: Schedule = "linear"
    """Decay of the learning rate to zero over the run: none, linear or cosine."""
    discount: Annotated[float, DISCOUNT] = 0.99
    """Discount factor (gamma)."""
    trace_decay: Annotated[float, SHARE] = 0.95
    """How far an advantage looks past the critic: 0 one step, 1 to the end of the episode (GAE's lambda)."""
    clip_range: Annotated[float, POSITIVE] = 0.2
    """Distance of the probability ratio from 1 beyond which its gradient stops (epsilon)."""
    clip_value_loss: bool = True
    """Whether to clip the change of a value in its loss to `clip_range`, which is little for unnormalised rewards."""
    value_loss_weight: Annotated[float, NOT_NEGATIVE] = 0.5
    """Weight of the value loss relative to the policy loss."""
    entropy_weight: Annotated[float, NOT_NEGATIVE] = 0.0
    """Weight of the policy's entropy."""
    max_gradient_norm: Annotated[float, NOT_NEGATIVE] = 0.5
    """Bound on the norm of the gradient of all parameters together; 0 is no bound."""
    adam_epsilon: Annotated[float, POSITIVE] = 1e-5
    """Added to the root of Adam's second moment (its epsilon)."""
    rollout_steps: Annotated[int, COUNT] = 2048
    """Environment steps in one rollout, after which one update learns from all of them."""
    minibatches: Annotated[int, COUNT] = 32
    """Number of equal parts into which each epoch divides the rollout."""
    epochs: Annotated[int, COUNT] = 10
    """Passes over the rollout in one update."""
    normalise_advantages: bool = True
    """Whether to normalise the advantages of each minibatch to mean 0 and standard deviation 1."""
    hidden_sizes: Annotated[tuple[int, ...], WIDTHS] = (64, 64)
    """Widths of the hidden layers of the actor and of the critic."""
    activation: Activation = "tanh"
    """Activation of the hidden layers."""
    normalise_observations: bool = True
    """Whether to normalise observations to mean 0 and standard deviation 1 by running statistics."""
    normalise_rewards: bool = True
    """Whether to divide rewards by the running standard deviation of the discounted return."""
    normalisation_limit: Annotated[float, POSITIVE] = 10.0
    """Bound on the magnitude of normalised observations and rewards."""

    name: ClassVar[str] = "ppo"

    def __post_init__(self) -> None:
        check_hyperparameters(self)
        if self.rollout_steps % self.minibatches:
            raise InputError(f"minibatches must divide rollout_steps, {self.rollout_steps}, not {self.minibatches}")
        if self.normalise_advantages and self.minibatches == self.rollout_steps:
            raise InputError("normalise_advantages needs fewer minibatches than rollout_steps")

    def policy_loss(self, log_ratio: Scalar, advantage: Scalar) -> Scalar:
        """Return -min(ρ A, clip(ρ, 1 - ε, 1 + ε) A) with ρ = π(a|s) / π_old(a|s) (PPO, Eq. 7)."""
        ratio = jnp.exp(log_ratio)
        clipped = jnp.clip(ratio, 1.0 - self.clip_range, 1.0 + self.clip_range)
        return -jnp.minimum(ratio * advantage, clipped * advantage)

    def value_loss(self, value: Scalar, old_value: Scalar, target: Scalar) -> Scalar:
        """Return ½ (V - target)²; if `clip_value_loss`, at least ½ (V_old + clip(V - V_old, -ε, ε) - target)²."""
        loss = (value - target) ** 2
        if self.clip_value_loss:
            clipped = old_value + jnp.clip(value - old_value, -self.clip_range, self.clip_range)
            loss = jnp.maximum(loss, (clipped - target) ** 2)
        return 0.5 * loss

    def loss(self, parameters: Parameters, sample: Sample) -> tuple[Scalar, Metrics]:
        """Return policy loss + weighted value loss - weighted entropy (PPO, Eq. 9), and the metrics."""
        policy = policy_at(parameters, sample.observation)
        log_ratio = policy.log_prob(sample.action) - sample.log_prob
        policy_loss = self.policy_loss(log_ratio, sample.advantage)
        value_loss = self.value_loss(value_at(parameters, sample.observation), sample.value, sample.target)
        entropy = policy.entropy()
        return policy_loss + self.value_loss_weight * value_loss - self.entropy_weight * entropy, {
            "actor_loss": policy_loss,
            "critic_loss": value_loss,
            "entropy": entropy,
            "approximate_kl": jnp.expm1(log_ratio) - log_ratio,  # never negative, with mean KL(π_old ‖ π)
            "clip_fraction": jnp.abs(jnp.expm1(log_ratio)) > self.clip_range,
        }

    def update(self, state: State, batch: Transition, key: Key, step: Count) -> tuple[State, Metrics]:
        """Absorb the rollout into the statistics, then take `epochs` times `minibatches` gradient steps on it."""
        in_time = by_environment(batch, state)
        returns, discounted_return = discounted_returns(state.discounted_return, in_time, self.discount)
        new_state = state._replace(
            observation_statistics=state.observation_statistics.absorb(batch.observation),
            returns=state.returns.absorb(returns.ravel()),
            discounted_return=discounted_return,
        )
        samples = self.samples(state, new_state, batch)
        learning_rate = self.learning_rate_at(step, state.total_updates)
        optimiser = self._optimiser(learning_rate)

        def learn(carry: tuple[Parameters, Any], minibatch: Sample) -> tuple[tuple[Parameters, Any], Metrics]:
            minibatch = minibatch._replace(advantage=self.normalised_advantages(minibatch.advantage))
            parameters, optimiser_state, metrics = gradient_step(optimiser, self.loss, *carry, minibatch)
            return (parameters, optimiser_state), metrics

        def pass_over(carry: tuple[Parameters, Any], key: Key) -> tuple[tuple[Parameters, Any], Metrics]:
            return jax.lax.scan(learn, carry, self.shuffled(samples, key))

        keys = jax.random.split(key, self.epochs)
        (parameters, optimiser_state), metrics = jax.lax.scan(pass_over, (state.parameters, state.optimiser), keys)
        return new_state._replace(parameters=parameters, optimiser=optimiser_state), {
            **jax.tree.map(jnp.mean, metrics),
            "explained_variance": explained_variance(samples.value, samples.target),
            "learning_rate": learning_rate,
        }

    def samples(self, state: State, new_state: State, batch: Transition) -> Sample:
        """Return the samples: log-probabilities with the statistics used in acting, all else with the updated ones."""

        def log_prob(observation: Observation, action: Action) -> Scalar:
            normalised = self.normalise(state.observation_statistics, observation)
            return policy_at(state.parameters, normalised).log_prob(action)

        normalise = jax.vmap(partial(self.normalise, new_state.observation_statistics))
        observations, next_observations = normalise(batch.observation), normalise(batch.next_observation)
        value = jax.vmap(partial(value_at, state.parameters))
        values, next_values = value(observations), value(next_observations)
        scaled = batch._replace(reward=self.scale(new_state.returns, batch.reward))
        arguments = by_environment((scaled, values, next_values), state)
        advantages = advantages_of(*arguments, discount=self.discount, trace_decay=self.trace_decay).ravel()
        log_probs = jax.vmap(log_prob)(batch.observation, batch.action)
        return Sample(observations, batch.action, log_probs, values, advantages, values + advantages)

    def normalise(self, statistics: Statistics, observation: Observation) -> Observation:
        """Return (observation - mean) / std, clipped, or the observation unchanged without the option."""
        seen_by = statistics if self.normalise_observations else None
        return normalise(seen_by, observation, self.normalisation_limit)

    def scale(self, statistics: Statistics, reward: Scalars) -> Scalars:
        """Return reward / std of the discounted return, clipped, or the reward unchanged without the option."""
        if not self.normalise_rewards:
            return reward
        return jnp.clip(reward / statistics.std, -self.normalisation_limit, self.normalisation_limit)

    def shuffled(self, samples: Sample, key: Key) -> Sample:
        """Return all samples in a random order, [minibatch, sample in it, ...]."""
        order = jax.random.permutation(key, self.rollout_steps)
        return jax.tree.map(lambda leaf: leaf[order].reshape(self.minibatches, -1, *leaf.shape[1:]), samples)

    def learning_rate_at(self, step: Count, total_updates: Scalar) -> Scalar:
        """Return the learning rate of update number `step`, from 0, of `total_updates` in the run."""
        return jnp.float32(self.learning_rate * scheduled(self.learning_rate_schedule, step / total_updates))

    def normalised_advantages(self, advantages: Scalars) -> Scalars:
        """Return a minibatch's advantages with mean 0 and standard deviation 1, or unchanged without the option."""
        if not self.normalise_advantages:
            return advantages
        return (advantages - advantages.mean()) / (advantages.std() + EPSILON)

    @property
    def cadence(self) -> Cadence:
        """One update per rollout and no warm-up, since learning is on-policy."""
        return Cadence(
            warmup_steps=0,
            update_interval=self.rollout_steps,
            updates_per_interval=1,
            transitions_per_update=self.rollout_steps,
            has_schedule=self.learning_rate_schedule != "constant",
        )

    def memory(self, spec: Spec, steps: int) -> Rollout:
        """Return an empty rollout. Raises InputError if its steps are no multiple of the environments."""
        if self.rollout_steps % spec.environments:
            raise InputError(f"environments must divide rollout_steps, {self.rollout_steps}, not {spec.environments}")
        return Rollout.create(self.rollout_steps, spec)

    def init(self, key: Key, spec: Spec, steps: int) -> State:
        """Return random networks, a policy near N(0, 1) everywhere, and empty statistics."""
        actor_key, critic_key = jax.random.split(key)
        sizes = spec.observation_size, self.hidden_sizes
        parameters = Parameters(
            actor=make_orthogonal_mlp(actor_key, *sizes, spec.action_size, self.actor_hidden, 0.01),
            critic=make_orthogonal_mlp(critic_key, *sizes, 1, self.critic_hidden, 1.0),
            log_std=jnp.zeros(spec.action_size),
        )
        return State(
            parameters=parameters,
            optimiser=init_optimiser(self._optimiser(self.learning_rate), parameters),
            observation_statistics=Statistics.create((spec.observation_size,)),
            returns=Statistics.create(()),
            discounted_return=jnp.zeros(spec.environments if spec.environments > 1 else ()),
            total_updates=jnp.float32(self.cadence.updates(steps)),
        )

    def act(self, state: State, observation: Observation, key: Key, explore: bool) -> Action:
        """Return an unclipped sample if exploring, else the mean clipped to [-1, 1]."""
        policy = policy_at(state.parameters, self.normalise(state.observation_statistics, observation))
        if explore:
            return policy.sample(jax.random.normal(key, policy.mean.shape))
        return jnp.clip(policy.mean, -1.0, 1.0)

    def policy(self, state: State) -> PolicyNetwork:
        """Return the actor's layers, its log standard deviation and its observation normaliser."""
        actor, _, log_std = state.parameters
        statistics = state.observation_statistics if self.normalise_observations else None
        normaliser = normaliser_of(statistics, self.normalisation_limit)
        parameters = PolicyParameters((actor.layers,), normaliser=normaliser, log_std=log_std)
        return PolicyNetwork(parameters, actor.activation, "clipped_gaussian")

    def _optimiser(self, learning_rate: float | Scalar) -> optax.GradientTransformation:
        # The state is one vector: passing many buffers when acting takes longer than computing the networks.
        return optax.flatten(make_optimiser(learning_rate, self.max_gradient_norm, epsilon=self.adam_epsilon))


def by_environment(rollout: Any, state: State) -> Any:
    """Return arrays [step, ...] of a rollout as [time, environment, ...], or unchanged for a single environment."""
    environments = state.discounted_return.shape
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *environments, *leaf.shape[1:]), rollout)


def policy_at(parameters: Parameters, observation: Observation) -> Gaussian:
    """Return the distribution of actions at one normalised observation."""
    return Gaussian(parameters.actor(observation), parameters.log_std)


def value_at(parameters: Parameters, observation: Observation) -> Scalar:
    """Return the critic's value of one normalised observation."""
    return parameters.critic(observation)[0]
