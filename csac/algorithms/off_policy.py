"""Base classes of the off-policy algorithms: hyperparameters, and the cadence, replay and optimisers they imply."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax

from csac.algorithms.distributions import policy_at
from csac.algorithms.exploration import Noise, noise_of
from csac.algorithms.hyperparameters import (
    COUNT,
    DISCOUNT,
    NOT_NEGATIVE,
    POSITIVE,
    RATE,
    WIDTHS,
    Limit,
    check_hyperparameters,
)
from csac.algorithms.memory import Replay
from csac.algorithms.networks import (
    MLP,
    Architecture,
    Schedule,
    apply_schedule,
    copy_tree,
    init_optimiser,
    learnable,
    make_mlp,
    make_optimiser,
    plain_layers,
    polyak,
)
from csac.algorithms.shapes import Action, Count, Key, Observation, Scalar
from csac.algorithms.statistics import Statistics, normalise, normaliser_of
from csac.algorithms.temperature import Temperature, adapt, finite_log
from csac.types import Cadence, InputError, Metrics, PolicyNetwork, PolicyParameters, Spec, Transition

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

UPDATES = Limit(lambda value: np.float32(0.01) <= value <= 1_000, "from 0.01 to 1,000")


@dataclass(frozen=True)
class OffPolicy(Architecture):
    """Hyperparameters that CSAC, SAC, TD3 and SD3 share."""

    discount: Annotated[float, DISCOUNT] = 0.99
    """Discount factor (gamma)."""
    target_rate: Annotated[float, RATE] = 0.005
    """Soft update rate of the target networks (rho of CSAC's paper, tau of the others')."""
    n_steps: Annotated[int, COUNT] = 1
    """Environment steps whose rewards a critic's target sums before it bootstraps."""
    normalise_rewards: bool = False
    """Whether to divide rewards, when they are drawn, by the running standard deviation of the discounted return."""
    actor_learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate of the actor."""
    critic_learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate of the critics."""
    learning_rate_schedule: Schedule = "constant"
    """Decay of the actor's and the critics' learning rate to zero over the run; a learnt temperature keeps its rate."""
    actor_hidden_sizes: Annotated[tuple[int, ...], WIDTHS] = (256, 256)
    """Widths of the actor's hidden layers."""
    critic_hidden_sizes: Annotated[tuple[int, ...], WIDTHS] = (256, 256)
    """Widths of each critic's hidden layers."""
    batch_size: Annotated[int, COUNT] = 256
    """Transitions in one update (the paper's M); SD3 uses as many for each of its two actor-critic pairs."""
    replay_size: Annotated[int, COUNT] = 1_000_000
    """Capacity of the replay buffer, in transitions."""
    warmup_steps: Annotated[int, NOT_NEGATIVE] = 10_000
    """Environment steps with uniform random actions before learning starts (the paper's T_initial)."""
    updates_per_step: Annotated[float, UPDATES] = 1.0
    """Updates per environment step, as a fraction: 0.25 is one every 4 steps, 0.33 a round of 33 every 100 steps."""
    update_interval: Annotated[int, COUNT] = 1
    """Environment steps between rounds of updates, rounded up to whole turns and whole updates; 1 is strict order."""
    exploration_noise: Noise = "white"
    """Correlation of exploration noise over steps: none (white), on all time scales (pink), over about 7 steps (ou)."""
    adam_momentum: Annotated[float, DISCOUNT] = 0.9
    """Decay of the average gradient in the networks' Adam (its beta1)."""
    max_gradient_norm: Annotated[float, NOT_NEGATIVE] = 0.0
    """Bound on the global norm of each gradient (that of both critics counts as one); 0 is no bound."""

    batches_per_update: ClassVar[int] = 1

    def __post_init__(self) -> None:
        check_hyperparameters(self)
        if self.replay_size < self.batch_size:
            raise InputError(f"replay_size must be at least batch_size, {self.batch_size:,}, not {self.replay_size:,}")

    @property
    def cadence(self) -> Cadence:
        """When updates run, and on how many transitions."""
        updates = Fraction(self.updates_per_step).limit_denominator(100)
        interval = -(-self.update_interval // updates.denominator) * updates.denominator
        return Cadence(
            warmup_steps=self.warmup_steps,
            update_interval=interval,
            updates_per_interval=int(updates * interval),
            transitions_per_update=self.batch_size * self.batches_per_update,
            has_schedule=self.learning_rate_schedule != "constant",
        )

    def updates(self, spec: Spec, steps: int) -> int:
        """Return how many updates a run of `steps` makes: the length of its learning-rate schedule."""
        return self.cadence.side_by_side(spec.environments).updates(steps)

    def noise(self, key: Key, size: int) -> Action:
        """Return exploration noise, standard normal [size]."""
        return noise_of(self.exploration_noise, key, size)

    def memory(self, spec: Spec, steps: int) -> Replay:
        """Return an empty replay buffer for `replay_size` transitions, or for the whole run if that is shorter."""
        rows_per_add = self.cadence.side_by_side(spec.environments).update_interval
        capacity, scaled = min(self.replay_size, steps), self.normalise_rewards
        reward_options: dict[str, Any] = {"n_steps": self.n_steps, "discount": self.discount, "scale_rewards": scaled}
        return Replay.create(capacity, spec, rows_per_add, **reward_options)

    def discount_after(self, transition: Transition) -> Scalar:
        """Return the discount of the next state's value: γ (1 - terminated), with γᵐ for a transition of m steps."""
        discount = self.discount if transition.steps is None else self.discount**transition.steps
        return discount * (1.0 - transition.terminated)

    def make_actor(self, key: Key, spec: Spec, outputs: int) -> Any:
        """Return a random actor, a map from [observation] to [outputs]; override this for another network."""
        return make_mlp(key, spec.observation_size, self.actor_hidden_sizes, outputs, self.actor_hidden)

    def make_critic(self, key: Key, spec: Spec) -> Any:
        """Return a random critic, a map from [observation + action] to [1]; override this for another network."""
        inputs = spec.observation_size + spec.action_size
        return make_mlp(key, inputs, self.critic_hidden_sizes, 1, self.critic_hidden)

    def optimiser(self, learning_rate: float, planned: int = 1) -> optax.GradientTransformation:
        """Return the networks' Adam. `planned`, the schedule's length, only matters when its state is created."""
        adam = make_optimiser(learning_rate, self.max_gradient_norm, momentum=self.adam_momentum)
        if self.learning_rate_schedule == "constant":
            return adam
        return optax.chain(adam, apply_schedule(self.learning_rate_schedule, planned))


@dataclass(frozen=True)
class TwinCritics(OffPolicy):
    """Hyperparameters that CSAC, SAC and TD3 share, with one actor and two critics (docs/algorithms/critics.md)."""

    critic_normalisation: Literal["none", "batch"] = "none"
    """`batch` normalises the inputs of the critics' layers over each batch, without target critics (CrossQ)."""
    normalise_observations: bool = False
    """Whether to normalise observations to mean 0 and standard deviation 1 by running statistics."""
    policy_delay: Annotated[int, COUNT] = 1
    """Critic updates per update of the actor and of a learnt entropy weight (TD3's d)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.critic_normalisation == "batch" and self.batch_size == 1:
            raise InputError("critic_normalisation batch needs a batch_size of at least 2")

    def first_networks(self, key: Key, spec: Spec, steps: int, actor_outputs: int) -> dict[str, Any]:
        """Return the initial state's fields that the three share: random networks, with copies as targets."""
        planned = self.updates(spec, steps)
        actor_adam = self.optimiser(self.actor_learning_rate, planned // self.policy_delay)
        actor_key, critics_key = jax.random.split(key)
        actor = learnable(self.make_actor(actor_key, spec, actor_outputs), spec.observation_size, actor_outputs)
        pair = spec.observation_size + spec.action_size
        critics = tuple(learnable(self.make_critic(one, spec), pair, 1) for one in jax.random.split(critics_key))
        if self.critic_normalisation == "batch" and not isinstance(critics[0], MLP):
            raise InputError(f"critic_normalisation batch is for MLPs, not for {type(critics[0]).__name__}")
        statistics = Statistics.create((spec.observation_size,)) if self.normalise_observations else None
        return {
            "actor": actor,
            "critics": critics,
            "target_critics": copy_tree(critics) if self.critic_normalisation == "none" else None,
            "actor_optimiser": init_optimiser(actor_adam, actor),
            "critic_optimiser": init_optimiser(self.optimiser(self.critic_learning_rate, planned), critics),
            "observation_statistics": statistics,
        }


@dataclass(frozen=True)
class MaximumEntropy(TwinCritics):
    """Hyperparameters that CSAC and SAC share: for a learnt (`auto`) entropy weight and an average of actors."""

    initial_entropy_weight: Annotated[float, POSITIVE] = 1.0
    """Initial value of an entropy weight that is `auto`."""
    target_entropy: float | None = None
    """Target entropy of `auto`, in nats; by default `target_entropy_per_dimension` times the action dimensions."""
    target_entropy_per_dimension: float = -1.0
    """Target entropy of `auto`, in nats per action dimension."""
    weight_learning_rate: Annotated[float, POSITIVE] = 3e-4
    """Learning rate of an entropy weight that is `auto`."""
    policy_average_rate: Annotated[float, RATE] = 1.0
    """Step size of the evaluated and exported average of past actors, larger at first; 1 is the actor itself."""

    def first_networks(self, key: Key, spec: Spec, steps: int, actor_outputs: int) -> dict[str, Any]:
        """Return the initial state's fields that the two share; the average is a copy of the actor."""
        networks = super().first_networks(key, spec, steps, actor_outputs)
        return networks | {"average": copy_tree(networks["actor"]) if self.policy_average_rate < 1 else None}

    def act(self, state: Any, observation: Observation, key: Key, explore: bool) -> Action:
        """Return ã(s, ξ) if exploring (CSAC's Eq. actor), else tanh(mean)."""
        actor = state.actor if explore else evaluated_actor(state)
        policy = policy_at(actor, normalise(state.observation_statistics, observation))
        return policy.sample(self.noise(key, policy.mean.size)) if explore else policy.mode()

    def policy(self, state: Any) -> PolicyNetwork:
        """Return the evaluated actor's layers and its observation normaliser."""
        return policy_network(evaluated_actor(state), state.observation_statistics, "tanh_gaussian")

    def first_temperature(self, given: float | Literal["auto"]) -> Temperature:
        """Return the initial temperature: the given weight, or `initial_entropy_weight` for `auto`."""
        log_weight = finite_log(self.initial_entropy_weight if given == "auto" else given)
        return Temperature(log_weight, init_optimiser(make_optimiser(self.weight_learning_rate), log_weight))

    def average_after(self, average: MLP | None, actor: MLP, step: Count) -> MLP | None:
        """Return the average after adding the actor of update number `step`; None if there is no average.

        It averages over the last tenth of the actors (polynomial decay with η = 9, Shamir and Zhang 2013) until
        `policy_average_rate` is the larger step size.
        """
        actors = step // self.policy_delay + 1
        return polyak(average, actor, jnp.maximum(self.policy_average_rate, 10 / (actors + 9)))

    def adapt_temperature(self, temperature: Temperature, entropy: Scalar, dimensions: int) -> Temperature:
        """Return the temperature after one gradient step towards the target entropy of `auto`."""
        return adapt(temperature, entropy, self.entropy_target(dimensions), make_optimiser(self.weight_learning_rate))

    def entropy_target(self, dimensions: int) -> float:
        """Return the target entropy of `auto`, in nats."""
        given = self.target_entropy
        return self.target_entropy_per_dimension * dimensions if given is None else given


def evaluated_actor(state: Any) -> MLP:
    """Return the actor that is evaluated and exported: the average of past ones, if there is one."""
    return state.actor if state.average is None else state.average


def first_metrics(names: Iterable[str], policy_delay: int) -> Metrics | None:
    """Return zeros as the metrics of a delayed actor before its first update; None without a delay."""
    return None if policy_delay == 1 else {name: jnp.zeros(()) for name in names}


def improve_delayed(
    policy_delay: int, step: Count, improve: Callable[..., tuple[Any, Metrics]], state: Any, *given: Any
) -> tuple[Any, Metrics]:
    """Return `improve(state, *given)` at the last of every `policy_delay` updates (TD3's Algorithm 1).

    Any other update computes nothing: it returns the state unchanged and `state.actor_metrics`, those of the last
    improvement. `step` counts the updates before this one.
    """
    if policy_delay == 1:
        return improve(state, *given)
    is_due = (step + 1) % policy_delay == 0
    state, metrics = jax.lax.cond(is_due, improve, lambda state, *_: (state, state.actor_metrics), state, *given)
    return state._replace(actor_metrics=metrics), metrics


def policy_network(actor: MLP, statistics: Statistics | None, head: Literal["tanh_gaussian", "tanh"]) -> PolicyNetwork:
    """Return the actor's layers and its observation normaliser."""
    return PolicyNetwork(
        PolicyParameters((plain_layers(actor),), normaliser=normaliser_of(statistics)), actor.activation, head
    )
