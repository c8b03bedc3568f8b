"""The compiled programs of one group: remember, learn, act, for all its seeds in one dispatch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from csac.algorithms.memory import pack, row_width
from csac.training.compilation import keep_programs
from csac.training.packing import Packing
from csac.types import InputError, PolicyNetwork, Ring, Snapshot, Transition

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from csac.tasks.seeds import Steps
    from csac.types import Algorithm, PolicyParameters, Spec

# Arrays with fewer elements travel packed. Hidden layers of 256 x 256 have more: XLA would copy them out of the row at
# every use.
SMALL = 2**15


class Learner:
    """The compiled programs of one group. Seeds are the leading axis of everything that enters and leaves.

    What is learnt is kept packed into few buffers, donated at every update: with one for each of CSAC's 74 arrays an
    update takes 2-6 % longer. A seed that is alone has no seed axis in there: for an axis of size one XLA transposes
    the weight gradients, which costs 4-8 % of an update.
    """

    def __init__(self, algorithm: Algorithm, spec: Spec, seeds: Sequence[int], steps: int) -> None:
        self.algorithm, self.spec, self._steps = algorithm, spec, steps
        self._cadence = algorithm.cadence
        self._is_alone = len(seeds) == 1
        self._metrics: list[str] = []
        self._updates_summed = 0
        self._waiting = np.zeros((len(seeds), self._cadence.update_interval, row_width(spec)), np.float32)
        keep_programs()
        keys = np.stack([np.asarray(jax.random.key_data(jax.random.key(seed))) for seed in seeds])
        # Asked for its metrics' names and then to learn: traced once.
        self._update = jax.jit(lambda *arguments: algorithm.update(*arguments), inline=True)
        # It runs once, and less optimised it is compiled in three quarters of the time.
        begin = jax.jit(lambda key: self._begin(key, steps), compiler_options={"xla_backend_optimization_level": 1})
        self._buffers = begin(keys[0]) if self._is_alone else jax.vmap(begin)(keys)
        self._explore = self._compiled(self._remember_and_explore)
        self._learn = self._compiled(self._remember_and_learn)
        self._act_alone = self._compiled_to_act(self._act)
        self._explore_alone = self._compiled_to_act(self._uniform)
        state = jax.eval_shape(lambda: self._packing.unpack(self._buffers[0]))
        self.network = algorithm.policy(state)  # for all but its parameters

    def next_actions(self, observations: np.ndarray, step: int) -> np.ndarray:
        """Return the actions [seed, action] for observations [seed, observation], after `step` steps."""
        program = self._explore_alone if step < self._cadence.warmup_steps else self._act_alone
        return np.array(program(self._buffers, observations, np.int32(step)))

    def step(self, observations: np.ndarray, actions: np.ndarray, outcome: Steps, step: int) -> np.ndarray:
        """Remember environment step number `step`, learn where it is time to, and return the next actions.

        One dispatch, whatever the algorithm does. Between updates transitions wait on the host, so that an algorithm
        that learns from rollouts is only asked to act.
        """
        interval = self._cadence.update_interval
        self._waiting[:, (step - 1) % interval] = pack(
            Transition(
                observations, actions, outcome.reward, outcome.next_observation, outcome.terminated, outcome.truncated
            )
        )
        if step % interval:
            return self.next_actions(outcome.observation, step)
        program = self._explore
        if step >= self._cadence.warmup_steps:
            program = self._learn
            self._updates_summed += self._cadence.updates_per_interval
        next_actions, self._buffers = program(self._buffers, self._waiting, outcome.observation, np.int32(step))
        return np.asarray(next_actions)

    def networks(self) -> list[PolicyNetwork]:
        """Return each seed's policy as NumPy layers."""

        def parameters_of(state: Any) -> PolicyParameters:
            return self.algorithm.policy(state).parameters

        states = self._carry[0]
        parameters = jax.tree.map(
            np.array, parameters_of(states) if self._is_alone else jax.vmap(parameters_of)(states)
        )
        return [self.network._replace(parameters=seed) for seed in self._by_seed(parameters)]

    def metrics(self) -> list[dict[str, float]]:
        """Return each seed's metrics, averaged over the updates since `forget_metrics`; none if there were none."""
        if not self._updates_summed:
            return []
        means = np.asarray(self._carry[2]) / self._updates_summed
        return [dict(zip(self._metrics, seed.tolist(), strict=True)) for seed in self._by_seed(means)]

    def forget_metrics(self) -> None:
        """Begin to average anew."""
        packed, memory, sums, key_data = self._buffers
        self._buffers = packed, memory, jnp.zeros_like(sums), key_data
        self._updates_summed = 0

    def save(self, index: int) -> Snapshot:
        """Return what the seed at this place needs to go on, but for its memory."""
        state, _, sums, key_data = self._carry
        own = {"state": state, "sums": sums, "key": key_data}
        arrays = {name: np.array(self._of_seed(leaf, index)) for name, leaf in _named(own).items()}
        return Snapshot({**arrays, "waiting": self._waiting[index].copy()}, {"updates_summed": self._updates_summed})

    def memory(self, index: int, step: int) -> Ring:
        """Return the memory of the seed at this place, to read only; `step` environment steps were made."""
        rows = np.asarray(self._carry[1].rows)
        return Ring(self._of_seed(rows, index), step - step % self._cadence.update_interval)

    def take_back(self, saved: Sequence[Snapshot], memories: Sequence[Callable[[np.ndarray], None]]) -> None:
        """Go on from what `save` returned for each seed; `memories` fill each seed's rows [capacity, width].

        Raises:
            InputError: it is of another algorithm, or of networks of another size.
        """
        for seed in saved:
            if problem := misfit(self.algorithm, self.spec, self._steps, seed):
                raise InputError(f"the checkpoint does not fit: {problem}")
        state, memory, sums, key_data = self._carry
        fresh = {"state": state, "sums": sums, "key": key_data}
        leaves = [self._stacked([seed.arrays[name] for seed in saved]) for name in _named(fresh)]
        fresh = jax.tree.unflatten(jax.tree.structure(fresh), leaves)
        rows = np.zeros(memory.rows.shape, memory.rows.dtype)
        for index, fill in enumerate(memories):
            fill(self._of_seed(rows, index))
        memory = type(memory)(jnp.array(rows))
        pack = self._packing.pack if self._is_alone else jax.vmap(self._packing.pack)
        self._buffers = jax.jit(pack)(fresh["state"]), memory, fresh["sums"], fresh["key"]
        self._waiting = np.stack([seed.arrays["waiting"] for seed in saved])
        self._updates_summed = int(saved[0].values["updates_summed"])

    def first_bad(self, index: int) -> str | None:
        """Return the name of the first of a seed's arrays that is not finite, or None."""
        for name, leaf in _named(self._carry[0]).items():
            array = np.asarray(self._of_seed(leaf, index))
            if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
                return name.removeprefix(".")
        return None

    def _of_seed(self, leaf: Any, index: int) -> Any:
        return leaf if self._is_alone else leaf[index]

    def _stacked(self, arrays: Sequence[np.ndarray]) -> jax.Array:
        return jnp.array(arrays[0] if self._is_alone else np.stack(arrays))

    @property
    def _carry(self) -> tuple:
        """What all seeds carry from update to update; their state as views of NumPy, to read only."""
        packed, memory, sums, key_data = self._buffers
        return self._packing.unpack([np.asarray(buffer) for buffer in packed]), memory, sums, key_data

    def _by_seed(self, tree: Any) -> list[Any]:
        """Return one tree of NumPy arrays per seed."""
        if self._is_alone:
            return [tree]
        seeds = len(jax.tree.leaves(tree)[0])
        return [jax.tree.map(lambda leaf: leaf[i], tree) for i in range(seeds)]  # noqa: B023

    def _compiled(self, program: Callable) -> Callable:
        """Return a program of one seed as one dispatch for all: (buffers, rows, observations, step)."""

        def one(buffers: tuple, rows: jax.Array, observation: jax.Array, step: jax.Array) -> tuple[jax.Array, tuple]:
            packed, *others = buffers
            action, (state, *others) = program((self._packing.unpack(packed), *others), rows, observation, step)
            return action, (self._packing.pack(state), *others)

        def alone(buffers: tuple, rows: jax.Array, observations: jax.Array, step: jax.Array):
            action, buffers = one(buffers, rows[0], observations[0], step)
            return action[None], buffers

        return jax.jit(alone if self._is_alone else jax.vmap(one, in_axes=(0, 0, 0, None)), donate_argnums=0)

    def _compiled_to_act(self, act: Callable) -> Callable:
        """Return what gives one seed's action as one dispatch for all: (buffers, observations, step)."""

        def one(buffers: tuple, observation: jax.Array, step: jax.Array) -> jax.Array:
            packed, *others = buffers
            return act((self._packing.unpack(packed), *others), observation, step)

        def alone(buffers: tuple, observations: jax.Array, step: jax.Array) -> jax.Array:
            return one(buffers, observations[0], step)[None]

        return jax.jit(alone if self._is_alone else jax.vmap(one, in_axes=(0, 0, None)))

    # What follows speaks of one seed; a carry is (state, memory, sums of metrics, key data).

    def _begin(self, key_data: jax.Array, steps: int) -> tuple[list[jax.Array], Any, jax.Array, jax.Array]:
        init_key, run_key = jax.random.split(jax.random.wrap_key_data(key_data))
        state, memory = self.algorithm.init(init_key, self.spec, steps), self.algorithm.memory(self.spec, steps)
        batch = jax.eval_shape(lambda: self._draw(memory, run_key, jnp.int32(1)))
        metrics = jax.eval_shape(self._update, state, batch, run_key, jnp.int32(0))[1]
        self._metrics = list(metrics)
        # What acts more often than it learns would take its policy out of the row again and again.
        self._packing = Packing(state, SMALL if self._cadence.update_interval == 1 else 0)
        return self._packing.pack(state), memory, jnp.zeros(len(metrics)), jax.random.key_data(run_key)

    def _remember_and_explore(self, carry: tuple, rows: jax.Array, observation: jax.Array, step: jax.Array):
        state, memory, sums, key_data = carry
        carry = (state, memory.add(rows, step - len(rows)), sums, key_data)
        return self._uniform(carry, observation, step), carry

    def _remember_and_learn(self, carry: tuple, rows: jax.Array, observation: jax.Array, step: jax.Array):
        state, memory, sums, key_data = carry
        memory = memory.add(rows, step - len(rows))
        draw_key, update_key, _ = self._keys(key_data, step)
        first = self._updates_before(step)

        def update(i: jax.Array, learnt: tuple) -> tuple:
            state, sums = learnt
            batch = self._draw(memory, jax.random.fold_in(draw_key, i), step)
            state, metrics = self._update(state, batch, jax.random.fold_in(update_key, i), first + i)
            return state, sums + jnp.stack([metrics[name] for name in self._metrics])

        if self._cadence.updates_per_interval == 1:
            state, sums = update(jnp.int32(0), (state, sums))
        else:
            state, sums = jax.lax.fori_loop(0, self._cadence.updates_per_interval, update, (state, sums))
        carry = (state, memory, sums, key_data)
        return self._act(carry, observation, step), carry

    def _draw(self, memory: Any, key: jax.Array, count: jax.Array) -> Transition:
        return memory.draw(key, count, self._cadence.transitions_per_update, self.spec)

    def _updates_before(self, step: jax.Array) -> jax.Array:
        """Return how many updates came before those that follow environment step `step`."""
        interval = self._cadence.update_interval
        first_step = -(-max(self._cadence.warmup_steps, 1) // interval) * interval
        return (step - first_step) // interval * self._cadence.updates_per_interval

    def _act(self, carry: tuple, observation: jax.Array, step: jax.Array) -> jax.Array:
        return self.algorithm.act(carry[0], observation, self._keys(carry[3], step)[2], True)

    def _uniform(self, carry: tuple, observation: jax.Array, step: jax.Array) -> jax.Array:
        shape = (self.spec.action_size,)
        return jax.random.uniform(self._keys(carry[3], step)[2], shape, minval=-1.0, maxval=1.0)

    @staticmethod
    def _keys(key_data: jax.Array, step: jax.Array) -> jax.Array:
        """Return the keys of one environment step: to draw batches, to update, to act."""
        return jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(key_data), step), 3)


def misfit(algorithm: Algorithm, spec: Spec, steps: int, saved: Snapshot) -> str | None:
    """Say what keeps an algorithm from going on from what `Learner.save` returned, or return None."""
    state = jax.eval_shape(lambda key: algorithm.init(key, spec, steps), jax.ShapeDtypeStruct((2,), "uint32"))
    for name, leaf in _named({"state": state}).items():
        given = saved.arrays.get(name)
        if given is None or given.shape != leaf.shape or given.dtype != leaf.dtype:
            found = "no such array" if given is None else f"{given.dtype} {given.shape}"
            return f"{name} is to be {leaf.dtype} {leaf.shape} and the checkpoint has {found}"
    rows = saved.arrays["waiting"]
    if rows.shape != (algorithm.cadence.update_interval, row_width(spec)):
        return f"the checkpoint has rollouts of {len(rows)} steps of width {rows.shape[1]}"
    return None


def _named(tree: Any) -> dict[str, Any]:
    """Return the leaves of a tree by where they are in it."""
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}
