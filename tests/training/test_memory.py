"""Replay and rollout: what goes in comes out, whole and aligned, uniformly, and from one's own seed alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from scipy.stats import chisquare, kstest, uniform
from trainer import run

from csac.algorithms import CSAC, SAC
from csac.algorithms.memory import Replay, Rollout, pack, row_width, unpack
from csac.seeds import training_seed
from csac.types import Cadence, Layer, PolicyNetwork, PolicyParameters, Spec, Transition

SPEC = Spec(2, 1)


def numbered(numbers) -> Transition:
    """Transitions [n, ...] whose every number says which it is and where it belongs."""
    k = np.asarray(numbers, np.float32)
    return Transition(
        observation=np.stack([k + 0.125, k + 0.25], axis=1),
        action=np.stack([k + 0.375], axis=1),
        reward=k + 0.5,
        next_observation=np.stack([k + 0.625, k + 0.75], axis=1),
        terminated=k % 2 == 1,
        truncated=k % 3,
    )


def filled(capacity: int, count: int) -> Replay:
    rows = jnp.asarray(pack(numbered(range(count))))

    def add(replay, k):
        return replay.add(jax.lax.dynamic_slice_in_dim(rows, k, 1), k), None

    return jax.jit(lambda: jax.lax.scan(add, Replay.create(capacity, SPEC), jnp.arange(count))[0])()


def test_a_row_holds_the_fields_in_their_order():
    rows = pack(numbered([4, 7]))
    np.testing.assert_array_equal(rows[0], [4.125, 4.25, 4.375, 4.5, 4.625, 4.75, 0.0, 1.0])
    assert rows.dtype == np.float32
    assert row_width(SPEC) == rows.shape[1] == 8
    unpacked = jax.vmap(unpack, in_axes=(0, None))(jnp.asarray(rows), SPEC)
    jax.tree.map(np.testing.assert_array_equal, unpacked, numbered([4, 7]))


@pytest.mark.parametrize(
    ("count", "held"),
    [(1, [0]), (3, [0, 1, 2]), (5, [0, 1, 2, 3, 4]), (6, [1, 2, 3, 4, 5]), (13, [8, 9, 10, 11, 12])],
)
def test_a_ring_of_five_holds_the_newest_five(count, held):
    batch = filled(5, count).sample(jax.random.key(0), jnp.int32(count), 300, SPEC)
    numbers = np.floor(batch.reward)
    assert sorted(set(numbers.tolist())) == held
    jax.tree.map(np.testing.assert_array_equal, batch, numbered(numbers))


def test_a_rollout_gives_the_newest_steps_whole_and_in_order():
    rollout = Rollout.create(3, SPEC)
    for first in (0, 3):
        rollout = rollout.add(jnp.asarray(pack(numbered(range(first, first + 3)))), jnp.int32(first))
    batch = rollout.sample(jax.random.key(0), jnp.int32(6), 3, SPEC)
    jax.tree.map(np.testing.assert_array_equal, batch, numbered([3, 4, 5]))


def test_draws_are_uniform():
    batch = filled(10, 17).sample(jax.random.key(1), jnp.int32(17), 20_000, SPEC)
    drawn = np.bincount(np.floor(batch.reward).astype(int), minlength=17)[7:]
    assert drawn.sum() == 20_000
    assert chisquare(drawn).pvalue > 0.001


@pytest.mark.parametrize(("steps", "capacity"), [(500, 300), (100, 100)])
def test_a_short_run_gets_a_small_replay(steps, capacity):
    for algorithm in (CSAC(replay_size=300), SAC(replay_size=300)):
        assert algorithm.memory(SPEC, steps).rows.shape == (capacity, 8)


# What follows goes through the training loop, on a task whose observations are [reset seed, episode, step, action].

SEEDS = (3, 8)


class Seen(NamedTuple):
    drawn: jax.Array  # [update, batch, observation]
    times: jax.Array  # [update] how often `update` was called with this number
    weight: jax.Array


@dataclass(frozen=True)
class Watcher:
    """An algorithm that learns nothing and keeps every batch."""

    warmup_steps: int = 10
    updates_per_interval: int = 2
    batch_size: int = 16
    update_interval: int = 1
    name: ClassVar[str] = "watcher"

    @property
    def cadence(self):
        return Cadence(self.warmup_steps, self.update_interval, self.updates_per_interval, self.batch_size)

    def memory(self, spec, steps) -> Any:
        return Replay.create(steps, spec, self.update_interval)

    def init(self, key, spec, steps):
        drawn = jnp.zeros((100, self.batch_size, spec.observation_size))
        return Seen(drawn, jnp.zeros(100), jnp.zeros((spec.observation_size, 2 * spec.action_size)))

    def act(self, state, observation, key, explore):
        return jnp.sum(state.times)[None] / 100  # says how many updates its policy is made of

    def update(self, state, batch, key, step):
        drawn, times = state.drawn.at[step].set(batch.observation), state.times.at[step].add(1)
        return state._replace(drawn=drawn, times=times), {"number": step}

    def policy(self, state):
        layer = Layer(state.weight, jnp.zeros(2))  # a bias that is in no state has no seed axis
        return PolicyNetwork(PolicyParameters(((layer,),)))


@pytest.fixture(scope="module")
def watched():
    return run(Watcher(), probes.IdEncoded, 30, SEEDS)


def check_story(rows: np.ndarray, seed: int, environment: int = 0) -> None:
    """Check that packed rows of one environment follow each other as its steps do."""
    step = jax.vmap(unpack, in_axes=(0, None))(jnp.asarray(rows), Spec(4, 1))
    reset_seed, episode, number, last_action = step.observation.T
    assert episode.max() > 5
    np.testing.assert_array_equal(reset_seed, [training_seed(seed, int(e), environment) % 65536 for e in episode])
    after = np.stack([reset_seed, episode, number + 1, step.action[:, 0]], axis=1)
    np.testing.assert_allclose(step.next_observation, after, atol=1e-6)  # never the observation of a reset
    np.testing.assert_array_equal(step.reward, number + 1)
    is_last = number + 1 == 2 + episode % 3
    np.testing.assert_array_equal(step.terminated, is_last & (episode % 3 != 1))
    np.testing.assert_array_equal(step.truncated, is_last & (episode % 3 != 0))
    # The next row starts where this one ended, or with a reset.
    np.testing.assert_allclose(step.observation[1:][~is_last[:-1]], step.next_observation[:-1][~is_last[:-1]])
    np.testing.assert_array_equal(number[1:][is_last[:-1]], 0)
    np.testing.assert_array_equal(episode[1:] - episode[:-1], is_last[:-1])
    np.testing.assert_array_equal(last_action[number == 0], 0)


def test_the_loop_remembers_what_happened(watched):
    for seed, rows in zip(SEEDS, watched.memories, strict=True):
        check_story(rows, seed)


def actions_of(rows) -> np.ndarray:
    """The actions in packed rows, in the order of the steps."""
    return rows[:, 4]


def test_the_policy_acts_that_has_learnt_from_the_newest_step(watched):
    # The action of row k was chosen after k steps, the 10th of which was the first that two updates followed.
    for rows in watched.memories:
        np.testing.assert_allclose(actions_of(rows)[10:], 2 * (np.arange(10, 30) - 9) / 100, atol=1e-6)


def test_the_updates_of_an_interval_act_from_its_end():
    # Learning after the steps 12, 16 and 20; those from the end of the warm-up to there act with the first policy.
    rows = run(Watcher(updates_per_interval=4, update_interval=4), probes.IdEncoded, 22, (3,)).memories[0]
    expected = [0.0] * 2 + [0.04] * 4 + [0.08] * 4
    np.testing.assert_allclose(actions_of(rows)[10:20], expected, atol=1e-6)


def test_actions_of_the_warm_up_are_uniform_and_each_seed_draws_its_own():
    first, second = map(actions_of, run(Watcher(warmup_steps=301), probes.IdEncoded, 300, SEEDS).memories)
    assert len({*first.tolist(), *second.tolist()}) == 600
    assert kstest(np.concatenate([first, second]), uniform(-1.0, 2.0).cdf).pvalue > 0.01


@pytest.mark.parametrize(
    ("often", "steps", "earlier"), [({"updates_per_step": 2}, 12, 11), ({"update_interval": 2}, 14, 12)]
)
def test_a_periodic_reference_counts_updates_whatever_the_steps(often, steps, earlier):
    # Six updates in all: the reference was renewed before the fifth, as a copy of the actor after four.
    algorithm = CSAC(
        reference_policy="periodic",
        reference_period=4,
        warmup_steps=10,
        batch_size=8,
        actor_learning_rate=0.01,
        actor_hidden_sizes=(4,),
        critic_hidden_sizes=(4,),
        **often,
    )
    (state,) = run(algorithm, probes.ObservationReward, steps).states
    (before,) = run(algorithm, probes.ObservationReward, earlier).states
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5), state.reference, before.actor)
    assert not np.allclose(state.actor.layers[0].weight, before.actor.layers[0].weight)
    assert not np.allclose(before.reference.layers[0].weight, before.actor.layers[0].weight)


def test_updates_are_counted_from_the_end_of_the_warm_up(watched):
    # Two updates after each of the steps 10, 11, ... 30, numbered from 0.
    for state in watched.states:
        np.testing.assert_array_equal(state.times, [1.0] * 42 + [0.0] * 58)


def test_each_seed_draws_for_itself_from_what_it_has(watched):
    for rows, state in zip(watched.memories, watched.states, strict=True):
        known = [tuple(row) for row in rows[:, :4]]
        indices = np.array([[known.index(tuple(row)) for row in batch] for batch in state.drawn[:42]])
        so_far = 10 + np.arange(42) // 2  # the environment steps before each update
        assert (indices < so_far[:, None]).all()
        assert (indices == so_far[:, None] - 1).any()  # the newest transition may be drawn at once
        assert len({tuple(batch) for batch in indices}) == 42
    first, second = (state.drawn[:42, :, 1:3] for state in watched.states)  # episode and step, alike in every seed
    assert (first != second).any(axis=(1, 2)).all()


class RolloutWatcher(Watcher):
    """Learns from five steps at a time, as they came."""

    def memory(self, spec, steps):
        return Rollout.create(self.update_interval, spec)

    def act(self, state, observation, key, explore):
        return jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)


def test_a_rollout_reaches_its_update_whole_and_in_order():
    watcher = RolloutWatcher(warmup_steps=0, updates_per_interval=1, batch_size=5, update_interval=5)
    outcome = run(watcher, probes.IdEncoded, 23, SEEDS)
    for seed, state, rows in zip(SEEDS, outcome.states, outcome.memories, strict=True):
        # Updates follow the steps 5, 10, 15 and 20; the last three steps wait for ever.
        np.testing.assert_array_equal(state.times, [1.0] * 4 + [0.0] * 96)
        np.testing.assert_array_equal(state.drawn[3], rows[:, :4])
        reset_seed, episode, number, last_action = state.drawn[:4].reshape(20, 4).T
        np.testing.assert_array_equal(reset_seed, [training_seed(seed, int(e)) % 65536 for e in episode])
        # Episodes of 2, 3 and 4 steps in turn.
        np.testing.assert_array_equal(number, [0, 1, 0, 1, 2, 0, 1, 2, 3] * 2 + [0, 1])
        assert len(set(last_action[number > 0])) == 13  # each step had an action of its own


def test_the_warm_up_of_a_rollout_ends_with_a_whole_one():
    watcher = RolloutWatcher(warmup_steps=7, updates_per_interval=2, batch_size=5, update_interval=5)
    state = run(watcher, probes.IdEncoded, 20, SEEDS).states[0]
    np.testing.assert_array_equal(state.times, [1.0] * 6 + [0.0] * 94)  # after the steps 10, 15 and 20


def test_the_updates_of_an_interval_draw_from_all_of_it():
    # Learning after the steps 12, 16, 20 and 24, four updates each: strict order would have made one after each step.
    watcher = Watcher(warmup_steps=10, updates_per_interval=4, update_interval=4)
    outcome = run(watcher, probes.IdEncoded, 26, SEEDS)
    for rows, state in zip(outcome.memories, outcome.states, strict=True):
        assert len(rows) == 28  # room for the whole intervals of 26 steps
        np.testing.assert_array_equal(rows[24:], 0)  # the last two steps wait
        np.testing.assert_array_equal(state.times, [1.0] * 16 + [0.0] * 84)
        known = [tuple(row) for row in rows[:24, :4]]
        indices = np.array([[known.index(tuple(row)) for row in batch] for batch in state.drawn[:16]])
        so_far = 12 + np.arange(16) // 4 * 4
        assert (indices < so_far[:, None]).all()
        assert len({tuple(batch) for batch in indices}) == 16


def test_a_ring_holds_whole_intervals():
    assert Replay.create(10, Spec(2, 1), 4).rows.shape == (12, 8)
    assert Replay.create(12, Spec(2, 1), 4).rows.shape == (12, 8)
