"""Types that all packages share. Nothing here imports JAX."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypeAlias

if TYPE_CHECKING:
    import jax
    import numpy as np

Array: TypeAlias = Any  # a JAX array during training, a NumPy array in exported policies
Metrics: TypeAlias = dict[str, Any]  # name -> scalar JAX array
# gelu is the tanh form of its paper. A new activation goes into algorithms/networks.py, and for exported policies into
# deploy/policy.py, deploy/onnx.py and both of deploy/templates/policy.*.
Activation: TypeAlias = Literal["relu", "tanh", "elu", "silu", "gelu"]
Head: TypeAlias = Literal["tanh_gaussian", "tanh", "clipped_gaussian"]

LAYER_NORM_EPSILON = 1e-5  # added to variances, as by PyTorch
LOG_STD_RANGE = (-20.0, 2.0)  # the bounds of PARL, which the paper builds on; SB3 and the authors of SAC use the same


class InputError(ValueError):
    """A user's mistake; its message is one line that says what is wrong and what to do."""


class Failure(RuntimeError):
    """An error that is not the user's mistake: an environment or a disk failed. The message is one line."""


class Spec(NamedTuple):
    """Flat observation and action size of a task, and its number of environments."""

    observation_size: int
    action_size: int
    environments: int = 1
    """Environments that a seed steps in parallel; their transitions of one turn are adjacent in its memory."""


class Transition(NamedTuple):
    """One environment step, or a batch of them. Actions are those that the algorithm chose, before any clipping.

    `next_observation` is the observation that the step produced, also at the end of an episode. Only `terminated` means
    that there is no future return; after a `truncated` step the environment was merely stopped.
    """

    observation: Array  # [observation]
    action: Array  # [action]
    reward: Array  # []
    next_observation: Array  # [observation]
    terminated: Array  # [] 0 or 1
    truncated: Array  # [] 0 or 1
    steps: Array | None = None  # [] environment steps that it sums up, with the end flags of the last; None is one


class Layer(NamedTuple):
    """One affine layer, h = x @ weight + bias.

    A hidden layer may have layer norm before its activation (Ba et al. 2016): scale * (h - mean) / √(var + ε) + shift,
    with the mean and the variance of its own outputs.
    """

    weight: Array  # [in, out]
    bias: Array  # [out]
    scale: Array | None = None  # [out]
    shift: Array | None = None  # [out]


class Normaliser(NamedTuple):
    """Normalisation of observations: (observation - mean) / std, clipped to ± limit."""

    mean: Array  # [observation]
    std: Array  # [observation]
    limit: Array  # []


class PolicyParameters(NamedTuple):
    """The arrays of a policy.

    With several actors there is one critic for each, an MLP from (observation, action) to [1]: the policy returns the
    action whose own actor's critic values it most, the first in a tie.
    """

    actors: tuple[tuple[Layer, ...], ...]
    critics: tuple[tuple[Layer, ...], ...] = ()
    normaliser: Normaliser | None = None
    log_std: Array | None = None  # [action] if the standard deviation does not depend on the observation


class PolicyNetwork(NamedTuple):
    """A policy as plain layers, which `deploy` can run without the algorithm that trained it.

    The head says what an actor's outputs are and how the deterministic action follows from them:
    `tanh_gaussian`: mean and log standard deviation, concatenated [2 action]; the action is tanh(mean);
    `tanh`: [action]; the action is tanh(output), also if a stochastic one is asked for;
    `clipped_gaussian`: the mean [action], with `log_std` a parameter; the action is the mean clipped to [-1, 1].
    """

    parameters: PolicyParameters
    activation: Activation = "relu"
    head: Head = "tanh_gaussian"
    critic_activation: Activation = "relu"


class Snapshot(NamedTuple):
    """Arrays by name, and values that JSON can hold."""

    arrays: dict[str, np.ndarray]
    values: dict[str, Any]

    def part(self, name: str) -> Snapshot:
        """Return the snapshot that was joined under this name: the arrays `name.*`, and the value `name`."""
        prefix = f"{name}."
        arrays = {key.removeprefix(prefix): array for key, array in self.arrays.items() if key.startswith(prefix)}
        return Snapshot(arrays, self.values[name])

    @classmethod
    def joined(cls, parts: dict[str, Snapshot]) -> Snapshot:
        """Return snapshots joined into one, from which `part` returns each."""
        arrays = {f"{name}.{key}": array for name, part in parts.items() for key, array in part.arrays.items()}
        return cls(arrays, {name: part.values for name, part in parts.items()})


class Ring(NamedTuple):
    """A seed's replay buffer: transition number i, of `added` so far, lies in row i % capacity."""

    rows: np.ndarray  # [capacity, width]
    added: int


class Cadence(NamedTuple):
    """When updates run, and on how many transitions. Steps are one seed's, in all its environments."""

    warmup_steps: int
    """Steps with uniform random actions and no update, before learning starts."""
    update_interval: int
    """Steps between rounds of updates: 1 in strict order, or the length of a rollout."""
    updates_per_interval: int
    """Calls of `update` after each interval, once the warm-up is over."""
    transitions_per_update: int
    """Transitions in one call of `update`."""
    has_schedule: bool = False
    """Whether learning depends on the run's total number of steps, so that the run cannot be extended."""

    @property
    def first_update(self) -> int:
        """The step after which the first update runs: the end of the first interval that reaches the warm-up."""
        return -(-max(self.warmup_steps, 1) // self.update_interval) * self.update_interval

    def updates(self, steps: int) -> int:
        """Return how many updates a run of `steps` makes, at least 1."""
        rounds = (steps - self.first_update) // self.update_interval + 1
        return max(rounds * self.updates_per_interval, 1)

    def side_by_side(self, environments: int) -> Cadence:
        """Return the cadence for `environments`: intervals of whole turns of these, with the same updates per step."""
        whole = self.update_interval // math.gcd(self.update_interval, self.updates_per_interval)
        shortest = math.lcm(environments, whole)
        interval = -(-self.update_interval // shortest) * shortest
        updates = interval * self.updates_per_interval // self.update_interval
        return self._replace(update_interval=interval, updates_per_interval=updates)


class Algorithm(Protocol):
    """What the training loop requires of an algorithm: a frozen dataclass whose fields are its hyperparameters.

    Every method is pure and for one seed; `training` adds the seed axis.
    """

    @property
    def cadence(self) -> Cadence:
        """When updates run, and on how many transitions."""
        ...

    def memory(self, spec: Spec, steps: int) -> Any:
        """Return an empty memory for a run of `steps` environment steps: a Replay or a Rollout."""
        ...

    def init(self, key: jax.Array, spec: Spec, steps: int) -> Any:
        """Return the initial state of a run of `steps` environment steps.

        No two of its leaves share a buffer, so that it can be donated.
        """
        ...

    def act(self, state: Any, observation: jax.Array, key: jax.Array, explore: bool) -> jax.Array:
        """Return the action for one observation: sampled if `explore`, else deterministic.

        The environment clips actions to [-1, 1]; the memory keeps them as they were returned.
        """
        ...

    def update(self, state: Any, batch: Transition, key: jax.Array, step: jax.Array) -> tuple[Any, Metrics]:
        """Return the state after one update and its metrics. `step` counts the updates before this one, unbatched."""
        ...

    def policy(self, state: Any) -> PolicyNetwork:
        """Return the deterministic policy as plain layers."""
        ...
