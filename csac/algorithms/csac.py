"""Conservative Soft Actor-Critic: entropy and relative entropy in the value function and in policy improvement."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax

from csac.algorithms.critics import Critics, critic_loss, least_q_value, make_critics
from csac.algorithms.distributions import kl, log_ratio, policy_at
from csac.algorithms.hyperparameters import COUNT, DISCOUNT, NOT_NEGATIVE, POSITIVE, RATE, WIDTHS, take_hyperparameters
from csac.algorithms.memory import Replay, replay_cadence
from csac.algorithms.networks import MLP, begin_descent, copy_tree, descend, make_mlp, make_optimiser, polyak
from csac.algorithms.shapes import Action, Count, Key, Observation, Scalar
from csac.types import Cadence, Metrics, PolicyNetwork, PolicyParameters, Spec, Transition


class State(NamedTuple):
    """Everything that one seed of CSAC learns."""

    actor: MLP
    reference: MLP
    critics: Critics
    target_critics: Critics
    actor_optimiser: Any
    critic_optimiser: Any


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
        take_hyperparameters(self)

    def critic_target(
        self, transition: Transition, noise: Action, *, actor: MLP, reference: MLP, target_critics: Critics
    ) -> Scalar:
        """Return y(s, a, s') with a' = tanh(mean + std noise) (Eq. Q_TD_2), and no future after a terminal step."""
        value, _ = self.regularised_value(transition.next_observation, noise, actor, reference, target_critics)
        return transition.reward + self.discount * (1.0 - transition.terminated) * value

    def actor_loss(
        self, actor: MLP, observation: Observation, noise: Action, *, reference: MLP, critics: Critics
    ) -> tuple[Scalar, Metrics]:
        """Return J(φ) = (τ + σ) log π - τ log π̃ - min Q at ã(s, noise) (Eq. actor_update_2), and what to log."""
        value, metrics = self.regularised_value(observation, noise, actor, reference, critics)
        return -value, {"actor_loss": -value, **metrics}

    def regularised_value(
        self, observation: Observation, noise: Action, actor: MLP, reference: MLP, critics: Critics
    ) -> tuple[Scalar, Metrics]:
        """Return min Q - σ log π - τ log(π/π̃) at ã(s, noise) (the bracket of Eq. Q_CSAC), and its parts."""
        policy, reference_policy = policy_at(actor, observation), policy_at(reference, observation)
        q_value = least_q_value(critics, observation, policy.sample(noise))
        log_prob = policy.log_prob(noise)
        if self.relative_entropy_estimator == "closed_form":
            relative_entropy = kl(policy, reference_policy)
        else:
            relative_entropy = log_ratio(policy, reference_policy, noise)
        value = q_value - self.entropy_weight * log_prob - self.relative_entropy_weight * relative_entropy
        return value, {"q_mean": q_value, "entropy": -log_prob, "relative_entropy": relative_entropy}

    def update(self, state: State, batch: Transition, key: Key, step: Count) -> tuple[State, Metrics]:
        """Take one gradient step on the critics, then one on the actor, then move the target critics."""
        target_noise, actor_noise = jax.random.normal(key, (2, *batch.action.shape))
        reference = self.reference_before(state, step)

        critic_target = partial(
            self.critic_target, actor=state.actor, reference=reference, target_critics=state.target_critics
        )
        targets = jax.vmap(critic_target)(batch, target_noise)
        optimiser = self._optimiser(self.critic_learning_rate)
        critics, critic_optimiser, critic_metrics = descend(
            optimiser, critic_loss, state.critics, state.critic_optimiser, batch, targets
        )

        actor_loss = partial(self.actor_loss, reference=reference, critics=critics)
        optimiser = self._optimiser(self.actor_learning_rate)
        actor, actor_optimiser, actor_metrics = descend(
            optimiser, actor_loss, state.actor, state.actor_optimiser, batch.observation, actor_noise
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

    def reference_before(self, state: State, step: Count) -> MLP:
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

    @property
    def cadence(self) -> Cadence:
        """When it learns, and from how much."""
        return replay_cadence(self.warmup_steps, self.update_interval, self.updates_per_step, self.batch_size)

    def memory(self, spec: Spec, steps: int) -> Replay:
        """Return an empty replay that holds `replay_size` transitions, or the whole run where that is shorter."""
        return Replay.create(min(self.replay_size, steps), spec, self.update_interval)

    def init(self, key: Key, spec: Spec, steps: int) -> State:
        """Return random networks; targets and reference are copies."""
        actor_key, critics_key = jax.random.split(key)
        actor = make_mlp(actor_key, spec.observation_size, self.actor_hidden_sizes, 2 * spec.action_size)
        critics = make_critics(critics_key, spec, self.critic_hidden_sizes)
        return State(
            actor=actor,
            reference=copy_tree(actor),
            critics=critics,
            target_critics=copy_tree(critics),
            actor_optimiser=begin_descent(self._optimiser(self.actor_learning_rate), actor),
            critic_optimiser=begin_descent(self._optimiser(self.critic_learning_rate), critics),
        )

    def act(self, state: State, observation: Observation, key: Key, explore: bool) -> Action:
        """Return ã(s, ξ) to explore (Eq. actor), else tanh(mean)."""
        policy = policy_at(state.actor, observation)
        return policy.sample(jax.random.normal(key, policy.mean.shape)) if explore else policy.mode()

    def policy(self, state: State) -> PolicyNetwork:
        """Return the actor's layers."""
        return PolicyNetwork(PolicyParameters((state.actor.layers,)))

    def _optimiser(self, learning_rate: float) -> optax.GradientTransformation:
        return make_optimiser(learning_rate, self.max_gradient_norm)
