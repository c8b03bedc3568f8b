"""The nouns that every room shares. Nothing here imports JAX."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypeAlias

if TYPE_CHECKING:
    import jax
    import numpy as np

Array: TypeAlias = Any  # a JAX array while learning, a NumPy array in what leaves
Metrics: TypeAlias = dict[str, Any]  # name -> scalar JAX array
# gelu: with tanh, as in its paper. A new one goes into algorithms/networks.py, and where policies leave:
# deploy/policy.py, deploy/onnx.py and both of deploy/templates/policy.*.
Activation: TypeAlias = Literal["relu", "tanh", "elu", "silu", "gelu"]

LAYER_NORM_EPSILON = 1e-5  # added to variances, as by PyTorch


class InputError(ValueError):
    """A user's mistake, told in one line that says what is wrong and what to do."""


class Failure(RuntimeError):
    """What ends a command though nobody made a mistake: an environment or a disk failed. The message is one line."""


class Spec(NamedTuple):
    """The flat sizes of a task: what a network needs to know of it."""

    observation_size: int
    action_size: int
    environments: int = 1
    """Environments that a seed steps side by side: their transitions of one turn follow each other in its memory."""


class Transition(NamedTuple):
    """One environment step, or a batch of them. Actions are those that the algorithm chose, before any clipping.

    `next_observation` is the observation that the step produced, also where the episode ended; only `terminated` means
    that nothing follows. A `truncated` step is one after which the environment was merely stopped.
    """

    observation: Array  # [observation]
    action: Array  # [action]
    reward: Array  # []
    next_observation: Array  # [observation]
    terminated: Array  # [] 0 or 1
    truncated: Array  # [] 0 or 1
    steps: Array | None = None  # [] how many environment steps it sums up, the last of which ended so; None is one


class Layer(NamedTuple):
    """One affine layer, h = x @ weight + bias.

    A hidden one may have layer norm before its activation (Ba et al. 2016): scale * (h - mean) / √(var + ε) + shift,
    with the mean and the variance of its own outputs.
    """

    weight: Array  # [in, out]
    bias: Array  # [out]
    scale: Array | None = None  # [out]
    shift: Array | None = None  # [out]


class Normaliser(NamedTuple):
    """Observations on a common scale: (observation - mean) / std, clipped to ± limit."""

    mean: Array  # [observation]
    std: Array  # [observation]
    limit: Array  # []


class PolicyParameters(NamedTuple):
    """The arrays of a policy.

    With several actors there is one critic for each, an MLP from (observation, action) to [1]: the action taken is the
    one that its own actor's critic values most, the first of equals.
    """

    actors: tuple[tuple[Layer, ...], ...]
    critics: tuple[tuple[Layer, ...], ...] = ()
    normaliser: Normaliser | None = None
    log_std: Array | None = None  # [action] of a head whose spread does not depend on the observation


class PolicyNetwork(NamedTuple):
    """A policy as plain layers: what `deploy` needs to run it without the algorithm that trained it.

    The head says what an actor's outputs mean and how its deterministic action comes of them:
    `tanh_gaussian`, mean and log standard deviation side by side [2 action], tanh(mean);
    `tanh`, [action], tanh(output), the same when asked to be stochastic;
    `clipped_gaussian`, the mean [action] beside the parameter `log_std`, the mean clipped to [-1, 1].
    """

    parameters: PolicyParameters
    activation: Activation = "relu"
    head: Literal["tanh_gaussian", "tanh", "clipped_gaussian"] = "tanh_gaussian"
    critic_activation: Activation = "relu"


class Snapshot(NamedTuple):
    """Arrays by name, and values that JSON can hold."""

    arrays: dict[str, np.ndarray]
    values: dict[str, Any]

    def part(self, name: str) -> Snapshot:
        """Return what was saved under this name: arrays called `name.<their name>`, and one of the values."""
        prefix = f"{name}."
        arrays = {key.removeprefix(prefix): array for key, array in self.arrays.items() if key.startswith(prefix)}
        return Snapshot(arrays, self.values[name])

    @classmethod
    def joined(cls, parts: dict[str, Snapshot]) -> Snapshot:
        """Return snapshots as one, of which `part` gives each."""
        arrays = {f"{name}.{key}": array for name, part in parts.items() for key, array in part.arrays.items()}
        return cls(arrays, {name: part.values for name, part in parts.items()})


class Ring(NamedTuple):
    """A seed's memory: transition number i lies in row i % capacity, as far as `added` of them were."""

    rows: np.ndarray  # [capacity, width]
    added: int


class Cadence(NamedTuple):
    """When an algorithm learns, and from how much. Steps are environment steps of one seed, in all its environments."""

    warmup_steps: int
    """Steps with uniform random actions and no update, before learning starts."""
    update_interval: int
    """Steps after each of which it learns: 1 in strict order, or as many as a rollout has."""
    updates_per_interval: int
    """Calls of `update` each time that it learns, once the warm-up is over."""
    transitions_per_update: int
    """Transitions that one call of `update` is given."""
    has_schedule: bool = False
    """Whether what is learnt depends on how many steps the run has in all, so that it cannot be extended."""

    @property
    def first_update(self) -> int:
        """The step after which it learns for the first time: the first that ends an interval, once it is warm."""
        return -(-max(self.warmup_steps, 1) // self.update_interval) * self.update_interval

    def updates(self, steps: int) -> int:
        """Return how many updates a run of so many steps makes, at least 1."""
        rounds = (steps - self.first_update) // self.update_interval + 1
        return max(rounds * self.updates_per_interval, 1)

    def side_by_side(self, environments: int) -> Cadence:
        """Return the cadence of so many environments: intervals of whole turns, with as many updates for each step."""
        turns = -(-self.update_interval // environments) * environments
        whole = self.update_interval // math.gcd(self.update_interval, self.updates_per_interval)
        interval = math.lcm(turns, whole)
        updates = interval * self.updates_per_interval // self.update_interval
        return self._replace(update_interval=interval, updates_per_interval=updates)


class Algorithm(Protocol):
    """What the training loop asks of an algorithm: a frozen dataclass whose fields are its hyperparameters.

    Every method is pure and speaks of one seed; `training` adds the seed axis.
    """

    @property
    def cadence(self) -> Cadence:
        """When it learns, and from how much."""
        ...

    def memory(self, spec: Spec, steps: int) -> Any:
        """Return the memory that the algorithm wants for a run of `steps` environment steps: a Replay or a Rollout."""
        ...

    def init(self, key: jax.Array, spec: Spec, steps: int) -> Any:
        """Return the first state of a run of `steps` environment steps.

        No two leaves of it share a buffer, so that it can be donated.
        """
        ...

    def act(self, state: Any, observation: jax.Array, key: jax.Array, explore: bool) -> jax.Array:
        """Return the action for one observation: sampled to explore, else deterministic.

        Actions lie in [-1, 1]; the environment clips what lies outside, and the memory keeps what was returned.
        """
        ...

    def update(self, state: Any, batch: Transition, key: jax.Array, step: jax.Array) -> tuple[Any, Metrics]:
        """Return the state after one update and its metrics. `step` counts the updates before this one, unbatched."""
        ...

    def policy(self, state: Any) -> PolicyNetwork:
        """Return the deterministic policy as plain layers."""
        ...
