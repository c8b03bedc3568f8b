"""Pure functions that one dispatch runs for one seed: store transitions, update, act."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from csac.algorithms.exploration import keys_of, uniform_of
from csac.training.packing import Packing
from csac.types import InputError, Transition

if TYPE_CHECKING:
    from collections.abc import Callable

    from csac.algorithms.exploration import Noise
    from csac.types import Algorithm, Spec

# Arrays with fewer elements are packed into one row. Hidden layers of 256 x 256 have more: XLA would copy them out of
# the row at every use.
SMALL = 2**15

KEY_DATA = jax.ShapeDtypeStruct((2,), "uint32")


class Carry(NamedTuple):
    """What one dispatch passes on to the next."""

    state: Any  # the algorithm's state; as `Packing` buffers while packed
    memory: Any  # a Replay or a Rollout
    sums: jax.Array  # [metric] sums over the updates since `Learner.reset_metrics`
    key: jax.Array  # [2] key data of the run, from which each step's keys are folded
    extra: jax.Array | None = None  # [] number of transitions added by `extend`


class OneSeed:
    """Pure functions of one seed's packed `Carry`. `step` counts environment steps.

    `state` has the shapes of the algorithm's state, `metrics` the names of the metrics in the order of `Carry.sums`.
    """

    def __init__(self, algorithm: Algorithm, spec: Spec, steps: int, most_extra: int = 0) -> None:
        self.algorithm, self.spec = algorithm, spec
        self.cadence = algorithm.cadence.side_by_side(spec.environments)
        self._initial_extra = jnp.int32(0) if most_extra else None
        self.noise: Noise = getattr(algorithm, "exploration_noise", "white")
        # Jitted so that `eval_shape` and the programs below share one trace.
        self._init = jax.jit(
            lambda key: (algorithm.init(key, spec, steps), algorithm.memory(spec, steps + most_extra)), inline=True
        )
        self._update = jax.jit(lambda *arguments: algorithm.update(*arguments), inline=True)
        self.state, memory = jax.eval_shape(lambda data: self._init(jax.random.wrap_key_data(data)), KEY_DATA)
        self.metrics = tuple(jax.eval_shape(self._first_metrics, self.state, memory, KEY_DATA))
        if taken := {"seed", "step"} & {*self.metrics}:
            raise InputError(f"{type(algorithm).__name__} has a metric called {taken.pop()!r}: give it another name")
        # An algorithm that acts more often than it updates packs nothing: each action would unpack the policy again.
        self.packing = Packing(self.state, SMALL if self.cadence.update_interval == spec.environments else 0)

    def begin(self, key_data: jax.Array) -> Carry:
        """Return the initial carry of a seed."""
        init_key, run_key = jax.random.split(jax.random.wrap_key_data(key_data))
        state, memory = self._init(init_key)
        sums, key = jnp.zeros(len(self.metrics)), jax.random.key_data(run_key)
        return Carry(self.packing.pack(state), memory, sums, key, self._initial_extra)

    def explore(self, carry: Carry, observation: jax.Array, step: jax.Array) -> jax.Array:
        """Return a uniformly random action for each observation."""
        shape = (*observation.shape[:-1], self.spec.action_size)
        if self.noise == "white":
            return jax.random.uniform(_keys(carry.key, step)[2], shape, minval=-1.0, maxval=1.0)
        keys = self._act_keys(carry.key, observation, step)
        return self._each(lambda _, key: uniform_of(self.noise, key, shape[-1]), observation, keys)

    def act(self, carry: Carry, observation: jax.Array, step: jax.Array) -> jax.Array:
        """Return the policy's exploratory action for each observation."""
        return self._act(self.packing.unpack(carry.state), carry.key, observation, step)

    def store_and_explore(
        self, carry: Carry, rows: jax.Array, observation: jax.Array, step: jax.Array
    ) -> tuple[Carry, jax.Array]:
        """Store packed transitions [n, width]; return the new carry and a uniformly random action per observation."""
        carry = self._store(carry, rows, step)
        return carry, self.explore(carry, observation, step)

    def store_and_update(
        self, carry: Carry, rows: jax.Array, observation: jax.Array, step: jax.Array
    ) -> tuple[Carry, jax.Array]:
        """Store packed transitions [n, width] and make all due updates; return the carry and its policy's action."""
        memory = self._store(carry, rows, step).memory
        count = step if carry.extra is None else step + carry.extra
        draw_key, update_key, _ = _keys(carry.key, step)
        rounds = (step - self.cadence.first_update) // self.cadence.update_interval  # before this one
        first = rounds * self.cadence.updates_per_interval

        def update(i: jax.Array, state_and_sums: tuple[Any, jax.Array]) -> tuple[Any, jax.Array]:
            state, sums = state_and_sums
            batch = self._sample(memory, jax.random.fold_in(draw_key, i), count)
            state, metrics = self._update(state, batch, jax.random.fold_in(update_key, i), first + i)
            return state, sums + jnp.stack([metrics[name] for name in self.metrics])

        state_and_sums = self.packing.unpack(carry.state), carry.sums
        if self.cadence.updates_per_interval == 1:
            state, sums = update(jnp.int32(0), state_and_sums)
        else:
            state, sums = jax.lax.fori_loop(0, self.cadence.updates_per_interval, update, state_and_sums)
        action = self._act(state, carry.key, observation, step)
        return Carry(self.packing.pack(state), memory, sums, carry.key, carry.extra), action

    def extend(self, carry: Carry, rows: jax.Array, number: jax.Array, step: jax.Array) -> Carry:
        """Store the first `number` of packed transitions [n, width] that come from no environment step."""
        assert carry.extra is not None
        memory = carry.memory.extend(rows, number, step + carry.extra)
        return carry._replace(memory=memory, extra=carry.extra + number)

    def _store(self, carry: Carry, rows: jax.Array, step: jax.Array) -> Carry:
        """Store the packed transitions [n, width] of the steps up to this one."""
        memory, count = carry.memory.measure(rows, self.spec), step - len(rows)
        if carry.extra is None:
            return carry._replace(memory=memory.add(rows, count))
        return carry._replace(memory=memory.extend(rows, len(rows), count + carry.extra))

    def _first_metrics(self, state: Any, memory: Any, key_data: jax.Array) -> dict[str, jax.Array]:
        key = jax.random.wrap_key_data(key_data)
        return self._update(state, self._sample(memory, key, jnp.int32(1)), key, jnp.int32(0))[1]

    def _sample(self, memory: Any, key: jax.Array, count: jax.Array) -> Transition:
        return memory.sample(key, count, self.cadence.transitions_per_update, self.spec)

    def _act(self, state: Any, key_data: jax.Array, observation: jax.Array, step: jax.Array) -> jax.Array:
        keys = self._act_keys(key_data, observation, step)
        return self._each(lambda one, key: self.algorithm.act(state, one, key, True), observation, keys)

    def _act_keys(self, key_data: jax.Array, observation: jax.Array, step: jax.Array) -> jax.Array:
        """Return the key to act with, one for each of several environments; with correlated noise [..., n] keys."""
        environments = self.spec.environments
        if self.noise == "white":
            key = _keys(key_data, step)[2]
            return jax.random.split(key, environments) if observation.ndim > 1 else key
        keys = keys_of(self.noise, jax.random.wrap_key_data(key_data), step, environments)
        return keys if observation.ndim > 1 else keys[0]

    @staticmethod
    def _each(function: Callable, observation: jax.Array, keys: jax.Array) -> jax.Array:
        """Apply a function to an observation and its key, or to each [environment, ...] of several."""
        return function(observation, keys) if observation.ndim == 1 else jax.vmap(function)(observation, keys)


def _keys(key_data: jax.Array, step: jax.Array) -> jax.Array:
    """Return the three keys of one environment step: to draw batches, to update, to act."""
    return jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(key_data), step), 3)
