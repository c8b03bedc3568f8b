"""Where transitions wait to be learnt from. Everything here is for one seed."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp

from csac.types import Transition

if TYPE_CHECKING:
    from csac.types import Spec


class Replay(NamedTuple):
    """A ring of transitions, each packed into one row, so that a step is one write and a batch is one gather.

    The number of transitions added so far is not kept here: it equals the environment steps, which the caller counts.
    """

    rows: jax.Array  # [capacity, 2 observation + action + 3]

    @classmethod
    def create(cls, capacity: int, spec: Spec) -> Replay:
        """Return an empty ring."""
        return cls(jnp.zeros((capacity, row_width(spec)), jnp.float32))

    def add(self, row: jax.Array, count: jax.Array) -> Replay:
        """Return the ring with a packed row [width] written over the oldest. `count` rows were added before it."""
        start = (count % self.rows.shape[0], 0)
        return Replay(jax.lax.dynamic_update_slice(self.rows, row[None], start))

    def draw(self, key: jax.Array, count: jax.Array, batch_size: int, spec: Spec) -> Transition:
        """Return a batch drawn uniformly with replacement from the `count` rows added, or the newest `capacity`."""
        indices = jax.random.randint(key, (batch_size,), 0, jnp.minimum(count, self.rows.shape[0]))
        return jax.vmap(unpack, in_axes=(0, None))(self.rows[indices], spec)


def row_width(spec: Spec) -> int:
    """Return the number of floats in a packed transition."""
    return 2 * spec.observation_size + spec.action_size + 3


def pack(transition: Transition) -> jax.Array:
    """Return one transition as one row [width], its fields in their order."""
    return jnp.concatenate([jnp.atleast_1d(jnp.asarray(field, jnp.float32)) for field in transition])


def unpack(row: jax.Array, spec: Spec) -> Transition:
    """Return the transition in one packed row [width]."""
    observation_size, action_size = spec
    first, second, third = observation_size, observation_size + action_size, 2 * observation_size + action_size + 1
    return Transition(
        observation=row[:first],
        action=row[first:second],
        reward=row[second],
        next_observation=row[second + 1 : third],
        terminated=row[third],
        truncated=row[third + 1],
    )
