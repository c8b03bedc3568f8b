"""Soft Actor-Critic (Haarnoja et al. 2018), with the automatic temperature of its second paper or a fixed one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from csac.algorithms.critics import Critics, Normalisation, least_q_value, make_critics, make_targets, update_critics
from csac.algorithms.delay import improve_delayed, make_first_metrics
from csac.algorithms.distributions import action_at, policy_at
from csac.algorithms.hyperparameters import COUNT, DISCOUNT, NOT_NEGATIVE, POSITIVE, RATE, WIDTHS, check_hyperparameters
from csac.algorithms.memory import Replay, replay_cadence
from csac.algorithms.networks import MLP, descend, init_optimiser, make_mlp, make_optimiser, polyak
from csac.algorithms.shapes import Action, Count, Key, Observation, Scalar
from csac.algorithms.statistics import Statistics, make_statistics, normalise, normalise_batch, normaliser_of
from csac.types import Cadence, InputError, Metrics, PolicyNetwork, PolicyParameters, Spec, Transition

# From which an automatic temperature can still rise: a run whose temperature was fixed at 0 may go on with one.
LEAST_LOG_TEMPERATURE = -18.420680743952367  # log 1e-8


class State(NamedTuple):
    """Everything that one seed of SAC learns."""

    actor: MLP
    critics: Critics
    target_critics: Critics | None
    log_temperature: Scalar
    actor_optimiser: Any
    critic_optimiser: Any
    temperature_optimiser: Any
    observations: Statistics | None = None
    actor_metrics: Metrics | None = None  # with a policy delay: the metrics of the actor's last step


@dataclass(frozen=True)
class SAC:
    """Soft Actor-Critic."""

    temperature: Literal["automatic", "fixed"] = "automatic"
    """`automatic` learns the weight of the entropy, to keep the entropy at its target; `fixed` keeps it as given."""
    entropy_weight: Annotated[float, NOT_NEGATIVE] = 1.0
    """Weight of the entropy, initial or fixed (SAC's alpha, the paper's sigma)."""
    target_entropy: float | None = None
    """Entropy that the automatic temperature aims at, in nats; by default minus the number of action dimensions."""
    discount: Annotated[float, DISCOUNT] = 0.99
    """Discount factor (gamma)."""
    target_rate: Annotated[float, RATE] = 0.005
    """Soft update rate of the target critics (the paper's rho)."""
    actor_learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate of the actor."""
    critic_learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate of the critics."""
    temperature_learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate of the automatic temperature."""
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
    policy_delay: Annotated[int, COUNT] = 1
    """Critic updates per update of the actor and of learnt weights (TD3's d)."""
    updates_per_step: Annotated[int, COUNT] = 1
    """Updates per environment step."""
    update_interval: Annotated[int, COUNT] = 1
    """Environment steps between rounds of updates; 1 is strict order, larger is faster."""
    adam_momentum: Annotated[float, DISCOUNT] = 0.9
    """Decay of the average gradient in the networks' Adam (its beta1)."""
    max_gradient_norm: Annotated[float, NOT_NEGATIVE] = 0.0
    """Bound on the global norm of each network's gradient (both critics count as one); 0 is no bound."""

    name: ClassVar[str] = "sac"

    def __post_init__(self) -> None:
        check_hyperparameters(self)
        if self.temperature == "automatic" and self.entropy_weight == 0:
            raise InputError("entropy_weight must be more than 0 to begin an automatic temperature")

    def critic_target(
        self, transition: Transition, noise: Action, *, actor: MLP, target_critics: Critics, temperature: Scalar
    ) -> Scalar:
        """Return r + γ [min Q(s', a') - α log π(a'|s')] with a' = tanh(mean + std noise) (second paper, Eq. 3)."""
        policy = policy_at(actor, transition.next_observation)
        q_value = least_q_value(target_critics, transition.next_observation, policy.sample(noise))
        value = q_value - temperature * policy.log_prob(noise)
        return transition.reward + self.discount * (1.0 - transition.terminated) * value

    def actor_loss(
        self, actor: MLP, observation: Observation, noise: Action, *, critics: Critics, temperature: Scalar
    ) -> tuple[Scalar, Metrics]:
        """Return α log π - min Q at the reparameterised action (second paper, Eq. 9), and what to log."""
        policy = policy_at(actor, observation)
        q_value = least_q_value(critics, observation, policy.sample(noise))
        log_prob = policy.log_prob(noise)
        loss = temperature * log_prob - q_value
        return loss, {"actor_loss": loss, "entropy": -log_prob}

    def temperature_loss(
        self, log_temperature: Scalar, entropy: Scalar, *, target_entropy: float
    ) -> tuple[Scalar, Metrics]:
        """Return log α (entropy - target): SAC's Eq. 18 with log α for α, as in the authors' code."""
        return log_temperature * (entropy - target_entropy), {}

    def update(self, state: State, batch: Transition, key: Key, step: Count) -> tuple[State, Metrics]:
        """Take one gradient step on the critics, move their targets, then improve the actor and the temperature."""
        observations, batch = normalise_batch(state.observations, batch)
        target_noise, actor_noise = jax.random.normal(key, (2, *batch.action.shape))
        temperature = jnp.exp(state.log_temperature)

        learnt = update_critics(
            self._optimiser(self.critic_learning_rate),
            *(state.critics, state.target_critics, state.critic_optimiser),
            *(batch, target_noise),
            critic_target=partial(self.critic_target, actor=state.actor, temperature=temperature),
            next_action=partial(action_at, state.actor),
        )

        state = state._replace(
            critics=learnt.critics,
            target_critics=polyak(state.target_critics, learnt.critics, self.target_rate),
            critic_optimiser=learnt.optimiser,
            observations=observations,
        )
        given = (learnt.folded, batch.observation, actor_noise)
        state, actor_metrics = improve_delayed(self.policy_delay, step, self.improve, state, *given)
        return state, {**learnt.metrics, **actor_metrics, "temperature": temperature}

    def improve(
        self,
        state: State,
        critics: Critics,
        observations: Float[Array, "batch observation"],
        noise: Float[Array, "batch action"],
    ) -> tuple[State, Metrics]:
        """Return the state after one gradient step on the actor and the temperature, and the actor's metrics."""
        actor_loss = partial(self.actor_loss, critics=critics, temperature=jnp.exp(state.log_temperature))
        optimiser = self._optimiser(self.actor_learning_rate)
        actor, actor_optimiser, metrics = descend(
            optimiser, actor_loss, state.actor, state.actor_optimiser, observations, noise
        )

        log_temperature, temperature_optimiser = state.log_temperature, state.temperature_optimiser
        if self.temperature == "automatic":
            log_temperature = jnp.maximum(log_temperature, LEAST_LOG_TEMPERATURE)
            target_entropy = self.target_entropy if self.target_entropy is not None else -float(noise.shape[-1])
            temperature_loss = partial(self.temperature_loss, target_entropy=target_entropy)
            mean_entropy = metrics["entropy"][None]  # the loss is linear in it: one example stands for all
            optimiser = make_optimiser(self.temperature_learning_rate)
            log_temperature, temperature_optimiser, _ = descend(
                optimiser, temperature_loss, log_temperature, temperature_optimiser, mean_entropy
            )
        new_state = state._replace(
            actor=actor,
            actor_optimiser=actor_optimiser,
            log_temperature=log_temperature,
            temperature_optimiser=temperature_optimiser,
        )
        return new_state, metrics

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
        actor = make_mlp(actor_key, spec.observation_size, self.actor_hidden_sizes, 2 * spec.action_size)
        critics = make_critics(critics_key, spec, self.critic_hidden_sizes)
        # log 0 is no number to keep; the lowest float is one, and its exponential is 0 too.
        log_temperature = jnp.maximum(jnp.log(jnp.float32(self.entropy_weight)), jnp.finfo(jnp.float32).min)
        return State(
            actor=actor,
            critics=critics,
            target_critics=make_targets(critics, self.critic_normalisation),
            log_temperature=log_temperature,
            actor_optimiser=init_optimiser(self._optimiser(self.actor_learning_rate), actor),
            critic_optimiser=init_optimiser(self._optimiser(self.critic_learning_rate), critics),
            temperature_optimiser=init_optimiser(make_optimiser(self.temperature_learning_rate), log_temperature),
            observations=make_statistics(spec.observation_size, self.normalise_observations),
            actor_metrics=make_first_metrics(("actor_loss", "entropy"), self.policy_delay),
        )

    def act(self, state: State, observation: Observation, key: Key, explore: bool) -> Action:
        """Return a sampled action to explore, else tanh(mean)."""
        policy = policy_at(state.actor, normalise(state.observations, observation))
        return policy.sample(jax.random.normal(key, policy.mean.shape)) if explore else policy.mode()

    def policy(self, state: State) -> PolicyNetwork:
        """Return the actor's layers, and what it sees observations by."""
        normaliser = normaliser_of(state.observations)
        return PolicyNetwork(PolicyParameters((state.actor.layers,), normaliser=normaliser))

    def _optimiser(self, learning_rate: float) -> optax.GradientTransformation:
        return make_optimiser(learning_rate, self.max_gradient_norm, momentum=self.adam_momentum)
