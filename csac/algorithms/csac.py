"""Conservative Soft Actor-Critic (Shang et al.): entropy and relative entropy in critic target and actor loss.

Lines of Algorithm 1 are numbered as in docs/algorithms/csac.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp

from csac.algorithms.critics import Critics, min_q, update_critics
from csac.algorithms.distributions import action_at, bounded, kl, log_ratio, policy_at
from csac.algorithms.hyperparameters import COUNT, NOT_NEGATIVE, RATE
from csac.algorithms.networks import MLP, copy_tree, gradient_step, polyak
from csac.algorithms.off_policy import MaximumEntropy, first_metrics, improve_delayed
from csac.algorithms.shapes import Action, Actions, Count, Key, Observation, Observations, Scalar
from csac.algorithms.statistics import Statistics, normalise_batch
from csac.algorithms.temperature import Temperature
from csac.types import Metrics, Spec, Transition


class State(NamedTuple):
    """The learnt state of one CSAC seed; fields that its options do not use are None."""

    actor: MLP  # φ
    reference: MLP  # φ_p
    critics: Critics  # θ₁, θ₂
    target_critics: Critics | None  # θ̂₁, θ̂₂
    actor_optimiser: Any
    critic_optimiser: Any
    temperature: Temperature | None = None  # σ, if it is learnt
    observation_statistics: Statistics | None = None
    average: MLP | None = None  # average of past actors, if it is evaluated
    actor_metrics: Metrics | None = None  # with a policy delay: the metrics of the actor's last step


@dataclass(frozen=True)
class CSAC(MaximumEntropy):
    """Conservative Soft Actor-Critic; the paper's own Algorithm 1 is the preset `paper`."""

    entropy_weight: Annotated[float, NOT_NEGATIVE] | Literal["auto"] = 0.2
    """Weight of the entropy (the paper's sigma); `auto` learns it as SAC does, to keep the entropy at its target."""
    relative_entropy_weight: Annotated[float, NOT_NEGATIVE] = 0.5
    """Weight of the relative entropy to the reference policy (the paper's tau); 0 is SAC."""
    reference_policy: Literal["periodic", "average"] = "average"
    """`periodic` copies the actor every `reference_period` updates; `average` is a running average of past actors."""
    reference_period: Annotated[int, COUNT] = 1000
    """With `periodic`: updates between copies of the actor; 1 is the paper's Algorithm 1."""
    reference_rate: Annotated[float, RATE] = 0.05
    """With `average`: step size of the running average towards the actor; 1 is the actor one update ago."""
    relative_entropy_estimator: Literal["closed_form", "sampled"] = "closed_form"
    """`closed_form` is the exact KL of the two policies, `sampled` the paper's log-ratio at the sampled action."""
    relative_entropy_form: Literal["explicit", "actor_only"] = "explicit"
    """`explicit` has the relative entropy in the critic's target and the actor's loss, `actor_only` in the latter."""
    target_log_prob_bound: Annotated[float, NOT_NEGATIVE] = 0.0
    """Bound on log π and on the relative entropy of an action in the critic's target, in nats; 0 is no bound."""
    relative_entropy_bound: Annotated[float, NOT_NEGATIVE] = 0.0
    """Bound on the relative entropy of a state in the actor's loss, in nats; 0 is no bound."""

    name: ClassVar[str] = "csac"

    def init(self, key: Key, spec: Spec, steps: int) -> State:
        """Return random networks, with copies as targets and reference (Algorithm 1, line 1)."""
        networks = self.first_networks(key, spec, steps, 2 * spec.action_size)
        return State(
            **networks,
            reference=copy_tree(networks["actor"]),
            temperature=self.first_temperature("auto") if self.entropy_weight == "auto" else None,
            actor_metrics=first_metrics(("actor_loss", "entropy", "relative_entropy"), self.policy_delay),
        )

    def update(self, state: State, batch: Transition, key: Key, step: Count) -> tuple[State, Metrics]:
        """Run the update phase of Algorithm 1, lines 12 to 23, on the mini-batch of line 13."""
        statistics, batch = normalise_batch(state.observation_statistics, batch)
        target_noise, actor_noise = jax.random.normal(key, (2, *batch.action.shape))
        sigma = self.sigma(state)
        # Line 12: φ_p ← φ; a running average is updated later, in `improve`
        reference = self.reference_before(state.reference, state.actor, step)
        state = state._replace(reference=reference, observation_statistics=statistics)
        # Lines 16 to 19: a' ~ π(·|s'), then y(s, a, s'), then a gradient step on Σᵢ [Qᵢ(s, a) - y]²
        critic_target = partial(self.critic_target, actor=state.actor, reference=reference, sigma=sigma)
        adam, next_action = self.optimiser(self.critic_learning_rate), partial(action_at, state.actor)
        state, folded_critics, metrics = update_critics(adam, state, batch, target_noise, critic_target, next_action)
        # Line 21: a gradient step on J(φ)
        arguments = (folded_critics, batch.observation, actor_noise, step)
        state, actor_metrics = improve_delayed(self.policy_delay, step, self.improve, state, *arguments)
        # Line 23: θ̂ᵢ ← ρ θᵢ + (1 - ρ) θ̂ᵢ
        state = state._replace(target_critics=polyak(state.target_critics, state.critics, self.target_rate))
        return state, {**metrics, **actor_metrics, **({"entropy_weight": sigma} if state.temperature else {})}

    def improve(
        self, state: State, critics: Critics, observations: Observations, noise: Actions, step: Count
    ) -> tuple[State, Metrics]:
        """Return the state after one gradient step on the actor and updates of both averages and of a learnt σ."""
        loss = partial(self.actor_loss, reference=state.reference, critics=critics, sigma=self.sigma(state))
        adam = self.optimiser(self.actor_learning_rate)
        actor, optimiser, metrics = gradient_step(adam, loss, state.actor, state.actor_optimiser, observations, noise)
        reference, temperature = self.reference_after(state.reference, state.actor), state.temperature
        if temperature:
            temperature = self.adapt_temperature(temperature, metrics["entropy"], noise.shape[-1])
        learnt = {"actor": actor, "actor_optimiser": optimiser, "reference": reference, "temperature": temperature}
        return state._replace(**learnt, average=self.average_after(state.average, actor, step)), metrics

    def soft_value_terms(
        self, observation: Observation, noise: Action, *, actor: MLP, reference: MLP, critics: Critics
    ) -> tuple[Scalar, Scalar, Scalar]:
        """Return min Q, log π and D at ã(s, ξ), the bracket of Eq. Q_CSAC; D is log(π/π̃) or its mean, the KL."""
        policy = policy_at(actor, observation)
        q_value, log_prob = min_q(critics, observation, policy.sample(noise)), policy.log_prob(noise)
        previous = policy_at(reference, observation)
        is_exact = self.relative_entropy_estimator == "closed_form"
        return q_value, log_prob, kl(policy, previous) if is_exact else log_ratio(policy, previous, noise)

    def critic_target(
        self, transition: Transition, noise: Action, *, actor: MLP, reference: MLP, targets: Critics, sigma: Any
    ) -> Scalar:
        """Return y = r + γ [min Q - σ log π - τ D] at s' (Eq. Q_TD_2), D if `explicit`; no bootstrap after an end."""
        q_value, log_prob, relative_entropy = self.soft_value_terms(
            transition.next_observation, noise, actor=actor, reference=reference, critics=targets
        )
        value = q_value - sigma * bounded(log_prob, self.target_log_prob_bound)
        if self.relative_entropy_form == "explicit":
            value = value - self.relative_entropy_weight * bounded(relative_entropy, self.target_log_prob_bound)
        return transition.reward + self.discount_after(transition) * value

    def actor_loss(
        self, actor: MLP, observation: Observation, noise: Action, *, reference: MLP, critics: Critics, sigma: Any
    ) -> tuple[Scalar, Metrics]:
        """Return J(φ) = σ log π - min Q + τ D at ã(s, ξ), and the metrics; with `sampled` it is Eq. actor_update_2."""
        q_value, log_prob, relative_entropy = self.soft_value_terms(
            observation, noise, actor=actor, reference=reference, critics=critics
        )
        relative_entropy = bounded(relative_entropy, self.relative_entropy_bound)
        loss = sigma * log_prob - q_value + self.relative_entropy_weight * relative_entropy
        return loss, {"actor_loss": loss, "entropy": -log_prob, "relative_entropy": relative_entropy}

    def reference_before(self, reference: MLP, actor: MLP, step: Count) -> MLP:
        """Return φ_p for update number `step`: the current one, or the actor at every `reference_period`-th update."""
        if self.reference_policy == "average":
            return reference
        if self.reference_period == 1:
            return actor
        is_due = step % self.reference_period == 0
        return jax.tree.map(partial(jnp.where, is_due), actor, reference)

    def reference_after(self, reference: MLP, actor: MLP) -> MLP:
        """Return φ_p after an update that used `reference`; `actor` is the one before that update."""
        return polyak(reference, actor, self.reference_rate) if self.reference_policy == "average" else reference

    def sigma(self, state: State) -> Any:
        """Return σ: the given weight or, with `auto`, the learnt one."""
        return self.entropy_weight if state.temperature is None else jnp.exp(state.temperature.log_weight)
