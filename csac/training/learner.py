"""The compiled programs of a group of seeds: one dispatch stores transitions, updates and acts for all of them."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from csac.algorithms.memory import pack, row_width
from csac.training.compilation import keep_programs
from csac.training.one_seed import KEY_DATA, Carry, OneSeed
from csac.training.packing import Parcel, SeedAxis, by_name
from csac.types import InputError, PolicyNetwork, Ring, Snapshot, Transition

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from csac.tasks.vector import Steps
    from csac.types import Algorithm, Spec


class Learner:
    """The compiled programs of a group of seeds, which are the leading axis of all arrays passed in or returned.

    The algorithm's state is kept packed in few buffers, donated at every update: with a buffer for each of CSAC's 74
    arrays an update takes 2-6 % longer.

    `most_extra` is the maximum number of transitions per seed that `extend` may add.
    """

    def __init__(self, algorithm: Algorithm, spec: Spec, seeds: Sequence[int], steps: int, most_extra: int = 0) -> None:
        self.algorithm, self.spec, self._steps = algorithm, spec, steps
        self._cadence = algorithm.cadence.side_by_side(spec.environments)
        self._axis = SeedAxis(len(seeds))
        self._updates_summed = 0
        self._waiting = np.zeros((len(seeds), self._cadence.update_interval, row_width(spec)), np.float32)
        keep_programs()
        self._one = OneSeed(algorithm, spec, steps, most_extra)
        self.metric_names = self._one.metrics
        self.network = algorithm.policy(self._one.state)  # whose parameters are shapes: `networks` fills them in
        # It runs only once, and at this optimisation level compiles in three quarters of the time.
        begin = jax.jit(self._axis.map(self._one.begin), compiler_options={"xla_backend_optimization_level": 1})
        keys = [np.asarray(jax.random.key_data(jax.random.key(seed))) for seed in seeds]
        self._carry: Carry = begin(self._axis.stack(keys))
        axis = (spec.environments,) if spec.environments > 1 else ()
        observations = np.zeros((len(seeds), *axis, spec.observation_size), np.float32)
        self._parcel = Parcel(self._axis.strip(self._waiting).shape, self._axis.strip(observations).shape)
        # JAX matches donated buffers with outputs by order and shape. So the carry is the first output, and
        # `keep_unused` keeps the parts of it that are not read: an offset by one would copy whole networks each time.
        self._explore, self._learn = (
            jax.jit(self._of_parcel(self._axis.map(program, (0, 0, 0, None))), donate_argnums=0, keep_unused=True)
            for program in (self._one.store_and_explore, self._one.store_and_update)
        )
        self._explore_alone, self._act_alone = (
            jax.jit(self._axis.map(program, (0, 0, None))) for program in (self._one.explore, self._one.act)
        )
        self._extend = jax.jit(self._axis.map(self._one.extend, (0, 0, 0, None)), donate_argnums=0)

    def next_actions(self, observations: np.ndarray, step: int) -> np.ndarray:
        """Return actions [seed, (environment,) action] for observations with the same axes, after `step` steps."""
        program = self._explore_alone if step < self._cadence.warmup_steps else self._act_alone
        return self._axis.restore(np.array(program(self._carry, self._axis.strip(observations), np.int32(step))))

    def step(self, observations: np.ndarray, actions: np.ndarray, outcome: Steps, step: int) -> np.ndarray:
        """Store one transition of each environment, update if it is time to, and return the next actions.

        `step` counts environment steps, these included. A call is a single dispatch for every algorithm. Transitions
        wait on the host until the next update, so between updates an algorithm that uses rollouts only acts.
        """
        ends = outcome.terminated, outcome.truncated
        rows = pack(Transition(observations, actions, outcome.reward, outcome.next_observation, *ends))
        self._waiting[:, self._rows_of(step)] = rows.reshape(len(rows), self.spec.environments, -1)
        if step % self._cadence.update_interval:
            return self.next_actions(outcome.observation, step)
        program = self._explore
        if step >= self._cadence.warmup_steps:
            program = self._learn
            self._updates_summed += self._cadence.updates_per_interval
        parcel = self._parcel.pack(step, self._axis.strip(self._waiting), self._axis.strip(outcome.observation))
        self._carry, next_actions = program(self._carry, parcel)
        self._waiting[...] = 0.0
        return self._axis.restore(np.asarray(next_actions))

    def extend(self, rows: Sequence[np.ndarray], step: int) -> None:
        """Add to each seed's memory its own packed transitions [n, width], n >= 0, after `step` environment steps."""
        numbers = np.array([len(seed_rows) for seed_rows in rows], np.int32)
        padded = np.zeros((len(rows), 1 << (int(numbers.max()) - 1).bit_length(), row_width(self.spec)), np.float32)
        for target, seed_rows in zip(padded, rows, strict=True):
            target[: len(seed_rows)] = seed_rows
        arguments = self._axis.strip(padded), self._axis.strip(numbers), np.int32(self._stored(step))
        self._carry = self._extend(self._carry, *arguments)

    def _stored(self, step: int) -> int:
        """Return how many of the transitions of `step` steps are in the memory: the rest wait for the next update."""
        return step // self._cadence.update_interval * self._cadence.update_interval

    def _of_parcel(self, program: Callable) -> Callable:
        """Wrap a program of a carry, packed transitions, observations and a step to take a carry and a parcel."""

        @functools.wraps(program)
        def of_parcel(carry: Carry, row: jax.Array) -> Any:
            return program(carry, *self._parcel.unpack(row))

        return of_parcel

    def networks(self) -> list[PolicyNetwork]:
        """Return each seed's policy network, with NumPy parameters."""
        parameters_of = self._axis.map(lambda state: self.algorithm.policy(state).parameters)
        parameters = jax.tree.map(np.array, parameters_of(self._states()))
        return [self.network._replace(parameters=self._axis.of(parameters, i)) for i in range(self._axis.seeds)]

    def metrics(self) -> list[dict[str, float]]:
        """Return each seed's metrics, averaged over the updates since `reset_metrics`; empty without any."""
        if not self._updates_summed:
            return []
        means = np.asarray(self._carry.sums) / self._updates_summed
        of_seeds = [self._axis.of(means, i).tolist() for i in range(self._axis.seeds)]
        return [dict(zip(self._one.metrics, of_seed, strict=True)) for of_seed in of_seeds]

    def reset_metrics(self) -> None:
        """Restart the averages of the metrics."""
        self._carry = self._carry._replace(sums=jnp.zeros_like(self._carry.sums))
        self._updates_summed = 0

    def save(self, index: int) -> Snapshot:
        """Return all that the seed at this index needs to resume, except its memory."""
        all_parts = _saved_parts(self._carry)  # without the memory's rows, which would be copied from a GPU to the host
        parts = self._axis.of(jax.tree.map(np.asarray, all_parts), index)
        parts["state"] = self._one.packing.unpack(parts["state"])
        arrays = {name: np.array(leaf) for name, leaf in by_name(parts).items()}
        values = {"updates_summed": self._updates_summed, "metrics": list(self._one.metrics)}
        return Snapshot({**arrays, "waiting": self._waiting[index].copy()}, values)

    def memory(self, index: int, step: int) -> Ring:
        """Return a read-only view of the memory of the seed at this index, after `step` environment steps."""
        extra = 0 if self._carry.extra is None else int(self._axis.of(np.asarray(self._carry.extra), index))
        return Ring(self._axis.of(np.asarray(self._carry.memory.rows), index), self._stored(step) + extra)

    def restore(self, saved: Sequence[Snapshot], memories: Sequence[Callable[[np.ndarray], None]]) -> None:
        """Resume from what `save` returned for each seed; each of `memories` fills one seed's rows [capacity, width].

        Raises InputError if it is from another algorithm or from networks of another size.
        """
        for seed in saved:
            if problem := incompatibility(self.algorithm, self.spec, self._steps, seed):
                raise InputError(f"the checkpoint does not fit: {problem}: go on with the csac that wrote it")
        memory, parts = self._carry.memory, _saved_parts(self._carry._replace(state=self._one.state))
        rows, structure = np.zeros(memory.rows.shape, memory.rows.dtype), jax.tree.structure(memory)
        memory = None  # a replay buffer may take half of the RAM: never hold three copies
        self._carry = self._carry._replace(memory=memory)
        for index, fill in enumerate(memories):
            fill(self._axis.of(rows, index))
        leaves = [jnp.array(self._axis.stack([seed.arrays[name] for seed in saved])) for name in by_name(parts)]
        restored = jax.tree.unflatten(jax.tree.structure(parts), leaves)
        device_rows = jax.device_put(rows, may_alias=False)  # an aliased buffer cannot be donated
        memory = jax.tree.unflatten(structure, [device_rows, *jax.tree.leaves(restored.pop("returns"))])
        carry = Carry(memory=memory, **restored)
        self._updates_summed = int(saved[0].values["updates_summed"])
        # With other options an algorithm may report other metrics: then the averages restart.
        names, sums = list(self._one.metrics), jnp.zeros_like(self._carry.sums)
        if carry.sums.shape != sums.shape or any(seed.values.get("metrics", names) != names for seed in saved):
            carry, self._updates_summed = carry._replace(sums=sums), 0
        self._carry = carry._replace(state=jax.jit(self._axis.map(self._one.packing.pack))(carry.state))
        self._waiting = np.stack([seed.arrays["waiting"] for seed in saved])

    def truncate_last(self, indices: Sequence[int], step: int) -> None:
        """Mark these seeds' last transition, after `step` steps, as truncated: the next one starts a new episode.

        One already moved to the memory stays unmarked: the replay detects from observations where a sequence breaks.
        """
        if step % self._cadence.update_interval:
            self._waiting[indices, self._rows_of(step), -1] = 1.0  # `truncated` is the last column

    def _rows_of(self, step: int) -> slice:
        """Return where in `_waiting` each environment's transition goes, for the iteration that ends at `step`."""
        begin = (step - self.spec.environments) % self._cadence.update_interval
        return slice(begin, begin + self.spec.environments)

    def first_non_finite(self, index: int) -> str | None:
        """Return the name of the first array in a seed's state that is not finite, or None."""
        for name, array in by_name(self.state(index)).items():
            if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
                return name
        return None

    def state(self, index: int) -> Any:
        """Return the state of the seed at this index, as read-only NumPy views."""
        return self._axis.of(self._states(), index)

    def _states(self) -> Any:
        """Return the state of all seeds, unpacked, as read-only NumPy views."""
        return self._one.packing.unpack([np.asarray(buffer) for buffer in self._carry.state])


def incompatibility(algorithm: Algorithm, spec: Spec, steps: int, saved: Snapshot) -> str | None:
    """Return why an algorithm cannot resume from what `Learner.save` returned, or None if it can."""
    state = jax.eval_shape(lambda key: algorithm.init(key, spec, steps), KEY_DATA)
    memory = jax.eval_shape(lambda: algorithm.memory(spec, steps))
    for name, leaf in by_name({"state": state, "returns": getattr(memory, "returns", None)}).items():
        saved_array = saved.arrays.get(name)
        if saved_array is None or saved_array.shape != leaf.shape or saved_array.dtype != leaf.dtype:
            found = "no such array" if saved_array is None else f"{saved_array.dtype} {saved_array.shape}"
            return f"{name} must be {leaf.dtype} {leaf.shape} and the checkpoint has {found}"
    cadence = algorithm.cadence.side_by_side(spec.environments)
    if cadence.has_schedule:
        for name, planned in by_name({"state": algorithm.init(jnp.zeros(2, "uint32"), spec, steps)}).items():
            if name.endswith(("planned", "total_updates")) and planned != saved.arrays[name]:
                return f"its schedule is of {planned:,.0f} updates and the checkpoint's of {saved.arrays[name]:,.0f}"
    rows = saved.arrays["waiting"]
    if rows.shape != (cadence.update_interval, row_width(spec)):
        return f"the checkpoint has rollouts of {len(rows)} steps of width {rows.shape[1]}"
    return None


def _saved_parts(carry: Carry) -> dict[str, Any]:
    """Return the parts of a carry that `save` keeps; the rows of the memory are saved separately."""
    returns = getattr(carry.memory, "returns", None)
    return {"state": carry.state, "sums": carry.sums, "key": carry.key, "extra": carry.extra, "returns": returns}
