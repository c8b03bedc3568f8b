"""One loop for every algorithm: step the environments, remember, learn, act. It knows no algorithm by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac.algorithms.memory import pack, row_width
from csac.deploy.policy import Contract, Policy
from csac.training.environments import SeedEnvironments
from csac.training.evaluation import EvaluationFailure, Evaluator
from csac.types import PolicyNetwork, Transition

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from csac.training.environments import Steps, Task
    from csac.types import Algorithm, PolicyParameters, Spec

METRICS_INTERVAL = 1_000
PROGRESS_INTERVAL = 250


class Settings(NamedTuple):
    """What a group needs to know to train its seeds; picklable, so that a group can be another process."""

    algorithm: Algorithm
    task: Task
    environment_arguments: dict[str, Any]
    steps: int
    evaluation_interval: int
    evaluation_episodes: int


class Rows(NamedTuple):
    """Rows for one of the run's tables, "episodes" or "metrics"."""

    table: str
    rows: list[dict[str, Any]]


class Evaluated(NamedTuple):
    """Every living seed of the group was evaluated at this step; `policies` are those evaluated."""

    step: int
    rows: list[dict[str, Any]]
    policies: dict[int, Policy]


class Failed(NamedTuple):
    """A seed stopped for a reason of its own; the others go on. `policy` is what it had learnt, where that is sound."""

    seed: int
    step: int
    reason: str
    details: str
    policy: Policy | None


class Progress(NamedTuple):
    """Everything up to this step has been yielded."""

    step: int


class Ended(NamedTuple):
    """The group is over: all its steps, no seed left alive, or it was asked to stop. The newest policies."""

    step: int
    policies: dict[int, Policy]


Event = Rows | Evaluated | Failed | Progress | Ended


def train_group(settings: Settings, seeds: Sequence[int], should_stop: Callable[[], bool]) -> Iterator[Event]:
    """Train `seeds` side by side and yield what happens, in order; the caller writes it down.

    Strict order: each action comes from the policy after the update that followed the step before it.
    """
    environments = SeedEnvironments(settings.task, settings.environment_arguments, seeds)
    evaluator = Evaluator(settings.task, settings.environment_arguments, settings.evaluation_episodes)
    learner = Learner(settings.algorithm, environments.spec, seeds, settings.steps)
    network = learner.network
    contract = Contract(
        environments.task_name, settings.algorithm.name, network.activation, network.head, *environments.contract_parts
    )

    def policies() -> dict[int, Policy]:
        networks = learner.networks()
        return {
            seed: Policy(networks[i], contract)
            for i, seed in enumerate(seeds)
            if environments.alive[i] and _is_finite(networks[i])
        }

    step = 0
    observations = environments.reset()
    actions = learner.first_actions(observations)
    while step < settings.steps and environments.alive.any():
        if step % 50 == 0 and should_stop():
            break
        outcome = environments.step(actions)
        step += 1
        for failure in outcome.failures:
            network = learner.networks()[failure.index]
            policy = Policy(network, contract) if _is_finite(network) else None
            yield Failed(seeds[failure.index], step, failure.reason, failure.details, policy)
        if outcome.episodes:
            yield Rows("episodes", [_episode_row(seeds[e.index], step, e) for e in outcome.episodes])
        actions = learner.step(observations, actions, outcome, step)
        observations = outcome.observation

        for index in _newly_broken(actions, environments):
            reason = "the policy's action is not finite: its parameters have diverged (a lower learning rate may help)"
            yield Failed(seeds[index], step, reason, "", None)
        last = step == settings.steps
        if step % METRICS_INTERVAL == 0 or last:
            yield Rows("metrics", _metrics_rows(learner, environments, seeds, step))
        if step % settings.evaluation_interval == 0 or last:
            yield from _evaluate(evaluator, policies(), environments, seeds, step)
        if step % PROGRESS_INTERVAL == 0 or last:
            yield Progress(step)
    yield Ended(step, policies())
    environments.close()
    evaluator.close()


class Learner:
    """The compiled programs of one group. Seeds are the leading axis of everything that enters and leaves.

    What is learnt is kept as a flat list of buffers, donated at every update: flattening nested modules in Python at
    each environment step would cost more than the environment. A seed that is alone has no seed axis in there: for an
    axis of size one XLA transposes the weight gradients, which costs 4-8 % of an update.
    """

    def __init__(self, algorithm: Algorithm, spec: Spec, seeds: Sequence[int], steps: int) -> None:
        self.algorithm, self.spec = algorithm, spec
        self._is_alone = len(seeds) == 1
        self._metrics: list[str] = []
        self._updates_summed = 0
        self._waiting = np.zeros((len(seeds), algorithm.update_interval, row_width(spec)), np.float32)
        keys = np.stack([np.asarray(jax.random.key_data(jax.random.key(seed))) for seed in seeds])
        begin = jax.jit(lambda key: self._begin(key, steps))
        carry = begin(keys[0]) if self._is_alone else jax.vmap(begin)(keys)
        self._buffers, self._structure = jax.tree.flatten(carry)
        self._explore = self._compiled(self._remember_and_explore)
        self._learn = self._compiled(self._remember_and_learn)
        self._act_alone = self._compiled_to_act(self._act)
        self._explore_alone = self._compiled_to_act(self._uniform)
        self.network = algorithm.policy(jax.eval_shape(lambda: carry[0]))  # for all but its parameters

    def first_actions(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions [seed, action] for the first observations [seed, observation]."""
        return self._next_actions(observations, 0)

    def step(self, observations: np.ndarray, actions: np.ndarray, outcome: Steps, step: int) -> np.ndarray:
        """Remember environment step number `step`, learn where it is time to, and return the next actions.

        One dispatch, whatever the algorithm does. Between updates transitions wait on the host, so that an algorithm
        that learns from rollouts is only asked to act.
        """
        interval = self.algorithm.update_interval
        self._waiting[:, (step - 1) % interval] = pack(
            Transition(
                observations, actions, outcome.reward, outcome.next_observation, outcome.terminated, outcome.truncated
            )
        )
        if step % interval:
            return self._next_actions(outcome.observation, step)
        program = self._explore
        if step >= self.algorithm.warmup_steps:
            program = self._learn
            self._updates_summed += self.algorithm.updates_per_step
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

    def take_metrics(self) -> list[dict[str, float]]:
        """Return each seed's metrics, averaged over the updates since the last call; none if there were no updates."""
        if not self._updates_summed:
            return []
        state, memory, sums, key_data = self._carry
        means = np.asarray(sums) / self._updates_summed
        self._buffers = jax.tree.leaves((state, memory, jnp.zeros_like(sums), key_data))
        self._updates_summed = 0
        return [dict(zip(self._metrics, seed.tolist(), strict=True)) for seed in self._by_seed(means)]

    @property
    def _carry(self) -> tuple:
        return jax.tree.unflatten(self._structure, self._buffers)

    def _by_seed(self, tree: Any) -> list[Any]:
        """Return one tree of NumPy arrays per seed."""
        if self._is_alone:
            return [tree]
        seeds = len(jax.tree.leaves(tree)[0])
        return [jax.tree.map(lambda leaf: leaf[i], tree) for i in range(seeds)]  # noqa: B023

    def _next_actions(self, observations: np.ndarray, step: int) -> np.ndarray:
        program = self._explore_alone if step < self.algorithm.warmup_steps else self._act_alone
        return np.asarray(program(self._buffers, observations, np.int32(step)))

    def _compiled(self, program: Callable) -> Callable:
        """Return a program of one seed as one dispatch for all: (buffers, rows, observations, step)."""

        def flat(buffers: list[jax.Array], rows: jax.Array, observations: jax.Array, step: jax.Array):
            carry = jax.tree.unflatten(self._structure, buffers)
            if self._is_alone:
                action, carry = program(carry, rows[0], observations[0], step)
                return action[None], jax.tree.leaves(carry)
            actions, carry = jax.vmap(program, in_axes=(0, 0, 0, None))(carry, rows, observations, step)
            return actions, jax.tree.leaves(carry)

        return jax.jit(flat, donate_argnums=0)

    def _compiled_to_act(self, act: Callable) -> Callable:
        """Return what gives one seed's action as one dispatch for all: (buffers, observations, step)."""

        def flat(buffers: list[jax.Array], observations: jax.Array, step: jax.Array) -> jax.Array:
            carry = jax.tree.unflatten(self._structure, buffers)
            if self._is_alone:
                return act(carry, observations[0], step)[None]
            return jax.vmap(act, in_axes=(0, 0, None))(carry, observations, step)

        return jax.jit(flat)

    # What follows speaks of one seed; a carry is (state, memory, sums of metrics, key data).

    def _begin(self, key_data: jax.Array, steps: int) -> tuple[Any, Any, jax.Array, jax.Array]:
        init_key, run_key = jax.random.split(jax.random.wrap_key_data(key_data))
        state, memory = self.algorithm.init(init_key, self.spec, steps), self.algorithm.memory(self.spec, steps)
        batch = jax.eval_shape(lambda: self._draw(memory, run_key, jnp.int32(1)))
        metrics = jax.eval_shape(self.algorithm.update, state, batch, run_key, jnp.int32(0))[1]
        self._metrics = list(metrics)
        return state, memory, jnp.zeros(len(metrics)), jax.random.key_data(run_key)

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
            state, metrics = self.algorithm.update(state, batch, jax.random.fold_in(update_key, i), first + i)
            return state, sums + jnp.stack([metrics[name] for name in self._metrics])

        if self.algorithm.updates_per_step == 1:
            state, sums = update(jnp.int32(0), (state, sums))
        else:
            state, sums = jax.lax.fori_loop(0, self.algorithm.updates_per_step, update, (state, sums))
        carry = (state, memory, sums, key_data)
        return self._act(carry, observation, step), carry

    def _draw(self, memory: Any, key: jax.Array, count: jax.Array) -> Transition:
        return memory.draw(key, count, self.algorithm.transitions_per_update, self.spec)

    def _updates_before(self, step: jax.Array) -> jax.Array:
        """Return how many updates came before those that follow environment step `step`."""
        interval = self.algorithm.update_interval
        first_step = -(-max(self.algorithm.warmup_steps, 1) // interval) * interval
        return (step - first_step) // interval * self.algorithm.updates_per_step

    def _act(self, carry: tuple, observation: jax.Array, step: jax.Array) -> jax.Array:
        return self.algorithm.act(carry[0], observation, self._keys(carry[3], step)[2], True)

    def _uniform(self, carry: tuple, observation: jax.Array, step: jax.Array) -> jax.Array:
        shape = (self.spec.action_size,)
        return jax.random.uniform(self._keys(carry[3], step)[2], shape, minval=-1.0, maxval=1.0)

    @staticmethod
    def _keys(key_data: jax.Array, step: jax.Array) -> jax.Array:
        """Return the keys of one environment step: to draw batches, to update, to act."""
        return jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(key_data), step), 3)


def _newly_broken(actions: np.ndarray, environments: SeedEnvironments) -> list[int]:
    """Stop the seeds whose next action is not finite, and return their places."""
    if np.isfinite(actions).all():
        return []
    finite = np.all(np.isfinite(actions), axis=1)
    broken = [i for i in range(len(actions)) if environments.alive[i] and not finite[i]]
    for index in broken:
        environments.stop(index)
    return broken


def _evaluate(
    evaluator: Evaluator, policies: dict[int, Policy], environments: SeedEnvironments, seeds: Sequence[int], step: int
) -> Iterator[Event]:
    rows = []
    for seed, policy in list(policies.items()):
        try:
            episodes = evaluator.run(policy)
        except EvaluationFailure as error:
            environments.stop(list(seeds).index(seed))
            yield Failed(seed, step, f"its evaluation failed: {error}", "", policies.pop(seed))
            continue
        rows += [
            {
                "seed": seed,
                "step": step,
                "episode": episode.episode,
                "return": episode.episode_return,
                "length": episode.length,
                "success": episode.success,
            }
            for episode in episodes
        ]
    yield Evaluated(step, rows, policies)


def _episode_row(seed: int, step: int, episode: Any) -> dict[str, Any]:
    return {"seed": seed, "step": step, "return": episode.episode_return, "length": episode.length}


def _metrics_rows(
    learner: Learner, environments: SeedEnvironments, seeds: Sequence[int], step: int
) -> list[dict[str, Any]]:
    rows = [{"seed": seed, "step": step, **metrics} for seed, metrics in zip(seeds, learner.take_metrics())]  # noqa: B905
    return [row for row, alive in zip(rows, environments.alive) if alive]  # noqa: B905


def _is_finite(network: PolicyNetwork) -> bool:
    return all(np.isfinite(array).all() for array in jax.tree.leaves(network.parameters))
