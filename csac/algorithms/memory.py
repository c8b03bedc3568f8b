"""Where transitions wait to be learnt from. Everything here but `pack` is for one seed."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from csac.algorithms.shapes import Count, Key
from csac.types import Transition

if TYPE_CHECKING:
    from csac.types import Spec


class Replay(NamedTuple):
    """A ring of transitions, each packed into one row, so that a step is one write and a batch is one gather.

    The number of transitions added so far is not kept here: it follows from the environment steps, which the
    caller counts.
    """

    rows: Float[Array, "capacity 2*observation+action+3"]

    @classmethod
    def create(cls, capacity: int, spec: Spec, together: int = 1) -> Replay:
        """Return an empty ring for rows that are added `together` at a time; it holds a multiple of these."""
        capacity = -(-capacity // together) * together
        return cls(jnp.zeros((capacity, row_width(spec)), jnp.float32))

    def add(self, rows: Float[Array, "n width"], count: Count) -> Replay:
        """Return the ring with packed rows [n, width] written over the oldest; `count` rows were added before them.

        `n` divides both `count` and the capacity, so that rows added together lie together.
        """
        start = (count % self.rows.shape[0], 0)
        return Replay(jax.lax.dynamic_update_slice(self.rows, rows, start))

    def draw(self, key: Key, count: Count, batch_size: int, spec: Spec) -> Transition:
        """Return a batch drawn uniformly with replacement from the `count` rows added, or the newest `capacity`."""
        indices = jax.random.randint(key, (batch_size,), 0, jnp.minimum(count, self.rows.shape[0]))
        return jax.vmap(unpack, in_axes=(0, None))(self.rows[indices], spec)


class Rollout(NamedTuple):
    """The newest transitions, in order, for an algorithm that learns from what its own policy has just done."""

    rows: Float[Array, "steps 2*observation+action+3"]

    @classmethod
    def create(cls, steps: int, spec: Spec) -> Rollout:
        """Return a rollout yet to be made."""
        return cls(jnp.zeros((steps, row_width(spec)), jnp.float32))

    def add(self, rows: Float[Array, "n width"], count: Count) -> Rollout:
        """Return the rollout that consists of these packed rows [steps, width]."""
        return Rollout(jnp.reshape(rows, self.rows.shape))

    def draw(self, key: Key, count: Count, batch_size: int, spec: Spec) -> Transition:
        """Return all of it: transitions with a leading axis of time."""
        return jax.vmap(unpack, in_axes=(0, None))(self.rows, spec)


def row_width(spec: Spec) -> int:
    """Return the number of floats in a packed transition."""
    return 2 * spec.observation_size + spec.action_size + 3


def pack(transition: Transition) -> np.ndarray:
    """Return transitions, NumPy arrays [seed, (environment,) ...], as rows [..., width], fields in their order."""
    fields = [field.reshape(*transition.reward.shape, -1) for field in transition]
    return np.concatenate(fields, axis=-1, dtype=np.float32, casting="unsafe")


def unpack(row: Float[Array, " width"], spec: Spec) -> Transition:
    """Return the transition in one packed row [width]."""
    observation_size, action_size = spec[:2]
    first, second, third = observation_size, observation_size + action_size, 2 * observation_size + action_size + 1
    return Transition(
        observation=row[:first],
        action=row[first:second],
        reward=row[second],
        next_observation=row[second + 1 : third],
        terminated=row[third],
        truncated=row[third + 1],
    )
