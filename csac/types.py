"""The nouns that every room shares. Nothing here imports JAX."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Protocol, TypeAlias

if TYPE_CHECKING:
    import jax

Array: TypeAlias = Any  # a JAX array while learning, a NumPy array in what leaves
Metrics: TypeAlias = dict[str, Any]  # name -> scalar JAX array


class InputError(ValueError):
    """A user's mistake, told in one line that says what is wrong and what to do."""


class Spec(NamedTuple):
    """The flat sizes of a task: what a network needs to know of it."""

    observation_size: int
    action_size: int


class Transition(NamedTuple):
    """One environment step, or a batch of them. Actions lie in [-1, 1].

    `next_observation` is the observation that the step produced, also where the episode ended; only `terminated` means
    that nothing follows. A `truncated` step is one after which the environment was merely stopped.
    """

    observation: Array  # [observation]
    action: Array  # [action]
    reward: Array  # []
    next_observation: Array  # [observation]
    terminated: Array  # [] 0 or 1
    truncated: Array  # [] 0 or 1


class Layer(NamedTuple):
    """One affine layer: `x @ weight + bias`."""

    weight: Array  # [in, out]
    bias: Array  # [out]


class PolicyNetwork(NamedTuple):
    """A policy as plain layers: what `deploy` needs to run it without the algorithm that trained it.

    With the head `tanh_gaussian` the last layer gives the mean and the log standard deviation side by side; the
    deterministic action is the tanh of the mean.
    """

    actor: tuple[Layer, ...]
    activation: Literal["relu", "tanh"] = "relu"
    head: Literal["tanh_gaussian"] = "tanh_gaussian"


class Algorithm(Protocol):
    """What the training loop asks of an algorithm: a frozen dataclass whose fields are its hyperparameters.

    Every method is pure and speaks of one seed; `training` adds the seed axis.
    """

    name: ClassVar[str]
    """The name in `ALGORITHMS`, on the command line and in the manifest."""

    @property
    def warmup_steps(self) -> int:
        """Environment steps with uniform random actions and no update, before learning starts."""
        ...

    @property
    def updates_per_step(self) -> int:
        """Calls of `update` after each environment step once the warm-up is over."""
        ...

    @property
    def batch_size(self) -> int:
        """Transitions that one update draws from the memory."""
        ...

    def memory(self, spec: Spec, steps: int) -> Any:
        """Return the memory that the algorithm wants for a run of `steps` environment steps."""
        ...

    def init(self, key: jax.Array, spec: Spec) -> Any:
        """Return the first state. No two leaves of it share a buffer, so that it can be donated."""
        ...

    def act(self, state: Any, observation: jax.Array, key: jax.Array, explore: bool) -> jax.Array:
        """Return the action in [-1, 1] for one observation: sampled to explore, else deterministic."""
        ...

    def update(self, state: Any, batch: Transition, key: jax.Array, step: jax.Array) -> tuple[Any, Metrics]:
        """Return the state after one update and its metrics. `step` counts the updates before this one, unbatched."""
        ...

    def policy(self, state: Any) -> PolicyNetwork:
        """Return the deterministic policy as plain layers."""
        ...
