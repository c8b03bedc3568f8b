"""Conservative Soft Actor-Critic: entropy and relative entropy in the value function and in policy improvement."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from csac.algorithms.adaptation import (
    LearntWeights,
    Weights,
    adapt_weights,
    current_weights,
    make_weights,
    weight_metrics,
)
from csac.algorithms.critics import Critics, Normalisation, least_q_value, make_critics, make_targets, update_critics
from csac.algorithms.delay import improve_delayed, make_first_metrics
from csac.algorithms.distributions import action_at, bounded, kl, log_ratio, policy_at
from csac.algorithms.hyperparameters import COUNT, DISCOUNT, NOT_NEGATIVE, POSITIVE, RATE, WIDTHS, check_hyperparameters
from csac.algorithms.memory import Replay, replay_cadence
from csac.algorithms.networks import MLP, copy_tree, descend, init_optimiser, make_mlp, make_optimiser, polyak
from csac.algorithms.references import ReferencePolicy, reference_after, references_before
from csac.algorithms.shapes import Action, Count, Key, Observation, Scalar
from csac.algorithms.statistics import Statistics, make_statistics, normalise, normalise_batch, normaliser_of
from csac.types import Cadence, InputError, Metrics, PolicyNetwork, PolicyParameters, Spec, Transition


class State(NamedTuple):
    """Everything that one seed of CSAC learns; what an option does without is None."""

    actor: MLP
    reference: MLP | None
    critics: Critics
    target_critics: Critics | None
    actor_optimiser: Any
    critic_optimiser: Any
    earlier_reference: MLP | None = None
    learnt_weights: LearntWeights | None = None
    relative_entropy_per_refresh: Scalar | None = None  # what a τ that is learnt goes by; 0 before there is any
    observations: Statistics | None = None
    actor_metrics: Metrics | None = None  # with a policy delay: the metrics of the actor's last step


INITIAL_WEIGHTS = Weights(1.0, 0.5)  # of those that adapt: SAC's first temperature, and the paper's τ

INCOMPATIBLE = (
    (
        {"relative_entropy_weight": ["auto"], "reference_policy": ["algorithm1"]},
        "the actor is its own reference; reference_policy periodic keeps another",
    ),
    (
        {"relative_entropy_weight": ["auto"], "reference_policy": ["periodic"], "reference_period": [1]},
        "the actor is its own reference",
    ),
    ({"relative_entropy_weight": ["auto"], "relative_entropy_form": ["implicit"]}, "there is no reference"),
    ({"critic_reference": ["earlier"], "relative_entropy_form": ["actor_only", "implicit"]}, "the target has none"),
    (
        {"critic_reference": ["earlier"], "reference_policy": ["previous", "average"]},
        "no copy replaces another; with reference_policy periodic one does",
    ),
)


@dataclass(frozen=True)
class CSAC:
    """Conservative Soft Actor-Critic; the paper's own Algorithm 1 is the preset `paper`."""

    entropy_weight: Annotated[float, NOT_NEGATIVE] | Literal["auto"] = 0.2
    """Weight of the entropy (the paper's sigma); `auto` learns it, to keep the entropy at its target as SAC does."""
    relative_entropy_weight: Annotated[float, NOT_NEGATIVE] | Literal["auto"] = 0.5
    """Weight of the relative entropy towards the reference (the paper's tau); 0 is SAC, `auto` learns it."""
    reference_policy: ReferencePolicy = "average"
    """The actor before this update's gradients, the actor one update ago, a periodic copy, or a running average."""
    reference_period: Annotated[int, COUNT] = 1000
    """Updates between copies of the actor, with `periodic`."""
    reference_rate: Annotated[float, RATE] = 0.05
    """Step size of the running average towards the actor, with `average`."""
    critic_reference: Literal["same", "earlier"] = "same"
    """Policies in the critic's target: the actor and its reference, or (CVI) the reference pi_k and its predecessor."""
    relative_entropy_estimator: Literal["closed_form", "sampled"] = "closed_form"
    """The exact KL of the two policies (0 with `algorithm1`), or the paper's log-ratio at the sampled action."""
    relative_entropy_form: Literal["explicit", "actor_only", "implicit"] = "explicit"
    """In target and actor's loss, in the actor's loss alone, or as tau log pi in the reward (Munchausen)."""
    target_log_prob_bound: Annotated[float, NOT_NEGATIVE] = 0.0
    """Bound on log-densities and log-ratios of an action in the critic's target, in nats; 0 is no bound."""
    target_entropy: float | None = None
    """Entropy that `auto` aims at, in nats; by default minus the number of action dimensions."""
    target_relative_entropy: Annotated[float, POSITIVE] = 0.01
    """Relative entropy per refresh that `auto` aims at, in nats per action dimension; with a short lag, use less."""
    weight_learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate of weights that are `auto`."""
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
    critic_normalisation: Normalisation = "none"
    """`batch` normalises the inputs of the critics' layers over each batch, without target critics (CrossQ)."""
    normalise_observations: bool = False
    """Whether to normalise observations to mean 0 and standard deviation 1 by running statistics."""
    batch_size: Annotated[int, COUNT] = 256
    """Transitions in one update (the paper's M)."""
    replay_size: Annotated[int, COUNT] = 1_000_000
    """Transitions that the replay keeps."""
    warmup_steps: Annotated[int, NOT_NEGATIVE] = 10_000
    """Environment steps with uniform random actions before learning starts (the paper's T_initial)."""
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

    name: ClassVar[str] = "csac"

    def __post_init__(self) -> None:
        check_hyperparameters(self, INCOMPATIBLE)
        self._refuse_idle_references()

    def critic_target(
        self,
        transition: Transition,
        noise: Action,
        *,
        actor: MLP,
        reference: MLP | None,
        target_critics: Critics,
        weights: Weights,
    ) -> Scalar:
        """Return y(s, a, s') with a' = tanh(mean + std noise) (Eq. Q_TD_2), and no future after a terminal step."""
        reward, bound = transition.reward, self.target_log_prob_bound
        if self.relative_entropy_form == "actor_only":
            reference, weights = None, weights._replace(relative_entropy=0.0)
        elif self.relative_entropy_form == "implicit":
            log_prob = policy_at(actor, transition.observation).log_prob_of(transition.action)
            reward = reward + weights.relative_entropy * bounded(log_prob, bound)
        next_observation = transition.next_observation
        value, _ = self.regularised_value(next_observation, noise, actor, reference, target_critics, weights, bound)
        return reward + self.discount * (1.0 - transition.terminated) * value

    def actor_loss(
        self,
        actor: MLP,
        observation: Observation,
        noise: Action,
        *,
        reference: MLP | None,
        critics: Critics,
        weights: Weights,
    ) -> tuple[Scalar, Metrics]:
        """Return J(φ) = (τ + σ) log π - τ log π̃ - min Q at ã(s, noise) (Eq. actor_update_2), and what to log."""
        value, metrics = self.regularised_value(observation, noise, actor, reference, critics, weights)
        return -value, {"actor_loss": -value, **metrics}

    def regularised_value(
        self,
        observation: Observation,
        noise: Action,
        actor: MLP,
        reference: MLP | None,
        critics: Critics,
        weights: Weights,
        bound: float = 0.0,
    ) -> tuple[Scalar, Metrics]:
        """Return min Q - σ log π - τ log(π/π̃) at ã(s, noise) (the bracket of Eq. Q_CSAC), and its parts.

        Without a reference it is P - (σ + τ) log π: the critics are those of P = Q + τ log π̃ (Eq. actor_update_3), or
        τ counts as 0, as in the target of `actor_only`.
        """
        policy = policy_at(actor, observation)
        q_value = least_q_value(critics, observation, policy.sample(noise))
        log_prob = bounded(policy.log_prob(noise), bound)
        if reference is None:
            return q_value - (weights.entropy + weights.relative_entropy) * log_prob, {"entropy": -log_prob}
        reference_policy = policy_at(reference, observation)
        if self.relative_entropy_estimator == "closed_form":
            relative_entropy = bounded(kl(policy, reference_policy), bound)
        else:
            relative_entropy = bounded(log_ratio(policy, reference_policy, noise), bound)
        value = q_value - weights.entropy * log_prob - weights.relative_entropy * relative_entropy
        return value, {"entropy": -log_prob, "relative_entropy": relative_entropy}

    def update(self, state: State, batch: Transition, key: Key, step: Count) -> tuple[State, Metrics]:
        """Take one gradient step on the critics, move their targets, then improve the actor against them."""
        observations, batch = normalise_batch(state.observations, batch)
        target_noise, actor_noise = jax.random.normal(key, (2, *batch.action.shape))
        weights = current_weights((self.entropy_weight, self.relative_entropy_weight), state.learnt_weights)
        renews, kept = step % self.reference_period == 0, (state.reference, state.earlier_reference)
        references = references_before(self.reference_policy, *kept, state.actor, renews)

        policies = {"actor": references.evaluated, "reference": references.critic}
        learnt = update_critics(
            self._optimiser(self.critic_learning_rate),
            *(state.critics, state.target_critics, state.critic_optimiser),
            *(batch, target_noise),
            critic_target=partial(self.critic_target, weights=weights, **policies),
            next_action=partial(action_at, references.evaluated),
        )

        state = state._replace(
            reference=references.actor,
            critics=learnt.critics,
            target_critics=polyak(state.target_critics, learnt.critics, self.target_rate),
            critic_optimiser=learnt.optimiser,
            earlier_reference=references.critic if self.critic_reference == "earlier" else None,
            observations=observations,
        )
        given = (learnt.folded, batch.observation, actor_noise, step)
        state, actor_metrics = improve_delayed(self.policy_delay, step, self.improve, state, *given)
        return state, {**learnt.metrics, **actor_metrics, **weight_metrics(weights, state.learnt_weights)}

    def improve(
        self,
        state: State,
        critics: Critics,
        observations: Float[Array, "batch observation"],
        noise: Float[Array, "batch action"],
        step: Count,
    ) -> tuple[State, Metrics]:
        """Return the state after one gradient step on the actor, with its reference and the weights that are learnt."""
        weights = current_weights((self.entropy_weight, self.relative_entropy_weight), state.learnt_weights)
        actor_loss = partial(self.actor_loss, reference=state.reference, critics=critics, weights=weights)
        optimiser = self._optimiser(self.actor_learning_rate)
        actor, actor_optimiser, metrics = descend(
            optimiser, actor_loss, state.actor, state.actor_optimiser, observations, noise
        )
        refreshed = self.per_refresh(state.relative_entropy_per_refresh, metrics, step)
        new_state = state._replace(
            actor=actor,
            reference=reference_after(self.reference_policy, state.reference, state.actor, self.reference_rate),
            actor_optimiser=actor_optimiser,
            learnt_weights=adapt_weights(
                state.learnt_weights,
                self.slack(metrics["entropy"], refreshed, noise.shape[-1]),
                make_optimiser(self.weight_learning_rate),
            ),
            relative_entropy_per_refresh=refreshed,
        )
        return new_state, metrics if refreshed is None else {**metrics, "relative_entropy_per_refresh": refreshed}

    def per_refresh(self, last: Scalar | None, metrics: Metrics, step: Count) -> Scalar | None:
        """Return what the relative entropy came to just before the last renewal of the reference, in nats.

        With `periodic` that is what the actor's last update of a period measures, held until the next one's; the others
        renew their reference, or move it on, at every update.
        """
        if last is None:
            return None
        is_last = self.reference_policy != "periodic" or (
            step % self.reference_period + self.policy_delay >= self.reference_period
        )
        return jnp.where(is_last, metrics["relative_entropy"], last)

    def slack(self, entropy: Scalar, relative_entropy: Scalar | None, dimensions: int) -> Weights:
        """Return by how much the entropy lies above its target, and the relative entropy below its own, in nats.

        The latter is 0 while there is none: the actor and its reference were never apart.
        """
        target_entropy = -float(dimensions) if self.target_entropy is None else self.target_entropy
        if relative_entropy is None:
            return Weights(entropy - target_entropy, 0.0)
        most = self.target_relative_entropy * dimensions
        return Weights(entropy - target_entropy, jnp.where(relative_entropy == 0, 0.0, most - relative_entropy))

    @property
    def cadence(self) -> Cadence:
        """When it learns, and from how much."""
        return replay_cadence(self.warmup_steps, self.update_interval, self.updates_per_step, self.batch_size)

    def memory(self, spec: Spec, steps: int) -> Replay:
        """Return an empty replay that holds `replay_size` transitions, or the whole run where that is shorter."""
        return Replay.create(min(self.replay_size, steps), spec, self.update_interval)

    def init(self, key: Key, spec: Spec, steps: int) -> State:
        """Return random networks; targets and references are copies."""
        actor_key, critics_key = jax.random.split(key)
        actor = make_mlp(actor_key, spec.observation_size, self.actor_hidden_sizes, 2 * spec.action_size)
        critics = make_critics(critics_key, spec, self.critic_hidden_sizes)
        return State(
            actor=actor,
            reference=None if self.relative_entropy_form == "implicit" else copy_tree(actor),
            critics=critics,
            target_critics=make_targets(critics, self.critic_normalisation),
            actor_optimiser=init_optimiser(self._optimiser(self.actor_learning_rate), actor),
            critic_optimiser=init_optimiser(self._optimiser(self.critic_learning_rate), critics),
            earlier_reference=copy_tree(actor) if self.critic_reference == "earlier" else None,
            learnt_weights=make_weights(
                (self.entropy_weight, self.relative_entropy_weight),
                INITIAL_WEIGHTS,
                make_optimiser(self.weight_learning_rate),
            ),
            relative_entropy_per_refresh=jnp.zeros(()) if self.relative_entropy_weight == "auto" else None,
            observations=make_statistics(spec.observation_size, self.normalise_observations),
            actor_metrics=make_first_metrics(self._actor_metrics(), self.policy_delay),
        )

    def act(self, state: State, observation: Observation, key: Key, explore: bool) -> Action:
        """Return ã(s, ξ) to explore (Eq. actor), else tanh(mean)."""
        policy = policy_at(state.actor, normalise(state.observations, observation))
        return policy.sample(jax.random.normal(key, policy.mean.shape)) if explore else policy.mode()

    def policy(self, state: State) -> PolicyNetwork:
        """Return the actor's layers, and what it sees observations by."""
        normaliser = normaliser_of(state.observations)
        return PolicyNetwork(PolicyParameters((state.actor.layers,), normaliser=normaliser))

    def _actor_metrics(self) -> tuple[str, ...]:
        names = ("actor_loss", "entropy")
        if self.relative_entropy_form != "implicit":
            names += ("relative_entropy",)
        return (*names, "relative_entropy_per_refresh") if self.relative_entropy_weight == "auto" else names

    def _optimiser(self, learning_rate: float) -> optax.GradientTransformation:
        return make_optimiser(learning_rate, self.max_gradient_norm, momentum=self.adam_momentum)

    def _refuse_idle_references(self) -> None:
        """Raise InputError where the reference is renewed so soon that an actor that waits has not moved meanwhile."""
        kept = {"periodic": self.reference_period, "algorithm1": 1}.get(self.reference_policy)
        least = {
            "relative_entropy_weight auto": 2 * self.policy_delay if self.relative_entropy_weight == "auto" else 1,
            "critic_reference earlier": self.policy_delay if self.critic_reference == "earlier" else 1,
        }
        for option, updates in least.items():
            if kept and self.policy_delay > 1 and kept < updates:
                raise InputError(
                    f"{option} with policy_delay {self.policy_delay} needs a reference that is kept for at least "
                    f"{updates} updates, not {kept}: an actor that waits may not have moved meanwhile"
                )
