"""The nouns that every room shares. Nothing here imports JAX."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping

    import jax
    import numpy as np

    from csac.algorithms.memory import Replay

    Array = jax.Array | np.ndarray
    Metrics = Mapping[str, jax.Array]


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
