"""Replay buffer and rollout, whose transitions are packed into rows. Everything here but `pack` is for one seed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from csac.algorithms.shapes import Count, Key
from csac.algorithms.statistics import LIMIT, ReturnScale
from csac.types import Transition

if TYPE_CHECKING:
    from csac.types import Spec


@partial(jax.tree_util.register_dataclass, data_fields=["rows", "returns"], meta_fields=["n_steps", "discount"])
@dataclass(frozen=True)
class Replay:
    """A ring buffer of transitions, each packed into one row: a step is one write and a batch is one gather.

    The number of transitions added so far is not stored: it follows from the environment steps, which the caller
    counts. Up to `n_steps` consecutive transitions are drawn as one, with their discounted rewards summed.
    """

    rows: Float[Array, "capacity 2*observation+action+3"]
    n_steps: int = 1
    discount: float = 1.0
    returns: ReturnScale | None = None  # the scale that drawn rewards are divided by

    @classmethod
    def create(
        cls,
        capacity: int,
        spec: Spec,
        rows_per_add: int = 1,
        *,
        n_steps: int = 1,
        discount: float = 1.0,
        scale_rewards: bool = False,
    ) -> Replay:
        """Return an empty buffer for adding `rows_per_add` rows at a time; the capacity is rounded up to a multiple."""
        capacity = -(-capacity // rows_per_add) * rows_per_add
        returns = ReturnScale.create(spec.environments) if scale_rewards else None
        return cls(jnp.zeros((capacity, row_width(spec)), jnp.float32), n_steps, discount, returns)

    def add(self, rows: Float[Array, "n width"], count: Count) -> Replay:
        """Return the buffer with packed rows [n, width] written over the oldest; `count` rows were added before.

        `n` divides both `count` and the capacity, so that rows added together are contiguous.
        """
        start = (count % self.rows.shape[0], 0)
        return replace(self, rows=jax.lax.dynamic_update_slice(self.rows, rows, start))

    def extend(self, rows: Float[Array, "n width"], number: Count, count: Count) -> Replay:
        """Return the buffer with the first `number` of packed rows written over the oldest, for any `count`."""
        capacity, places = self.rows.shape[0], jnp.arange(len(rows))
        is_written = (places < number) & (places >= number - capacity)
        places = jnp.where(is_written, (count + places) % capacity, capacity)  # out of range: dropped
        return replace(self, rows=self.rows.at[places].set(rows, mode="drop"))

    def measure(self, rows: Float[Array, "n width"], spec: Spec) -> Replay:
        """Return the buffer with its reward scale updated by these packed rows, the newest steps in order."""
        if self.returns is None:
            return self
        steps = jax.vmap(unpack, in_axes=(0, None))(rows, spec)
        return replace(self, returns=self.returns.absorb(steps, self.discount))

    def sample(self, key: Key, count: Count, batch_size: int, spec: Spec) -> Transition:
        """Return a batch drawn uniformly with replacement from the `count` rows added, or the newest `capacity`."""
        indices = jax.random.randint(key, (batch_size,), 0, jnp.minimum(count, self.rows.shape[0]))
        batch = self.at(indices, count, spec)
        if self.returns is None:
            return batch
        return batch._replace(reward=jnp.clip(batch.reward / self.returns.statistics.std, -LIMIT, LIMIT))

    def at(self, indices: Int[Array, " batch"], count: Count, spec: Spec) -> Transition:
        """Return the transitions that start at these rows; none extends past the newest of the `count` rows added."""
        if self.n_steps == 1:
            return jax.vmap(unpack, in_axes=(0, None))(self.rows[indices], spec)
        capacity, offsets = self.rows.shape[0], spec.environments * jnp.arange(self.n_steps)
        newest = (count - 1) % capacity

        def window(index: Count) -> Transition:
            steps = jax.vmap(unpack, in_axes=(0, None))(self.rows[(index + offsets) % capacity], spec)
            return summed(steps, offsets <= (newest - index) % capacity, self.discount)

        return jax.vmap(window)(indices)


def summed(steps: Transition, is_available: Bool[Array, " n"], discount: float) -> Transition:
    """Return up to n consecutive environment steps as one: reward Σ γᵏ rₖ, next observation and flags of the last.

    The sum stops after a step that ended the episode, or whose next observation is not the following step's
    observation: nothing else shows an episode cut off by a resume or a fork, or lost rows.
    """
    ended = (steps.terminated[:-1] > 0) | (steps.truncated[:-1] > 0)
    follows = jnp.all(steps.observation[1:] == steps.next_observation[:-1], axis=-1) & ~ended & is_available[1:]
    is_included = jnp.concatenate([jnp.ones(1), jnp.cumprod(follows)])
    length = jnp.sum(is_included)
    reward = jnp.sum(is_included * discount ** jnp.arange(len(is_included)) * steps.reward)
    last = jax.tree.map(lambda leaf: leaf[length.astype(int) - 1], steps)
    return last._replace(observation=steps.observation[0], action=steps.action[0], reward=reward, steps=length)


class Rollout(NamedTuple):
    """The newest transitions, in order, for an on-policy algorithm."""

    rows: Float[Array, "steps 2*observation+action+3"]

    @classmethod
    def create(cls, steps: int, spec: Spec) -> Rollout:
        """Return an empty rollout."""
        return cls(jnp.zeros((steps, row_width(spec)), jnp.float32))

    def measure(self, rows: Float[Array, "n width"], spec: Spec) -> Rollout:
        """Return the rollout unchanged."""
        return self

    def add(self, rows: Float[Array, "n width"], count: Count) -> Rollout:
        """Return the rollout that consists of these packed rows [steps, width]."""
        return Rollout(jnp.reshape(rows, self.rows.shape))

    def sample(self, key: Key, count: Count, batch_size: int, spec: Spec) -> Transition:
        """Return the whole rollout: transitions with a leading time axis."""
        return jax.vmap(unpack, in_axes=(0, None))(self.rows, spec)


def row_width(spec: Spec) -> int:
    """Return the number of floats in a packed transition."""
    return 2 * spec.observation_size + spec.action_size + 3


def pack(transition: Transition) -> np.ndarray:
    """Return transitions, NumPy arrays [seed, (environment,) ...], packed into rows [..., width], fields in order."""
    fields = [field.reshape(*transition.reward.shape, -1) for field in transition if field is not None]
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
