"""Targets of several steps, by hand: where they end, what they sum up, and what they do not look across."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from equations import transition
from trainer import run

from csac.algorithms import CSAC, SAC, SD3, TD3
from csac.algorithms.memory import Replay, pack
from csac.types import Spec, Transition

END, STOP = {"terminated": 1.0}, {"truncated": 1.0}


add = jax.jit(lambda ring, rows, count: ring.add(rows, count))


@partial(jax.jit, static_argnums=2)
def all_of(ring: Replay, count: int, environments: int) -> Transition:
    return ring.at(jnp.arange(len(ring.rows)), jnp.int32(count), Spec(1, 1, environments))


def replay(steps: list[tuple[float, float, float, dict[str, float]]], n_steps: int, capacity: int = 0) -> Replay:
    """A ring to which steps (observation, reward, next observation, how it ended) were added, one after the other."""
    ring = Replay.create(capacity or len(steps), Spec(1, 1), n_steps=n_steps, discount=0.5)
    for count, (observation, reward, following, ended) in enumerate(steps):
        one = transition(observation, reward=reward, next_observation=following, **ended)
        ring = add(ring, pack(jax.tree.map(lambda leaf: leaf[None], one)), count)
    return ring


def drawn(ring: Replay, count: int, environments: int = 1) -> dict[str, list[float]]:
    """What begins in each row of the ring."""
    found = all_of(ring, count, environments)
    names = ("reward", "steps", "terminated", "truncated")
    return {name: np.asarray(getattr(found, name)).tolist() for name in names} | {
        "next": np.asarray(found.next_observation)[:, 0].tolist(),
        "first": np.asarray(found.observation)[:, 0].tolist(),
    }


def test_rewards_are_summed_to_the_end_of_the_episode_or_the_newest_step():
    # 0 → 1 → 2 → 3, terminated; 10 → 11, truncated; 20 → 21 → 22, the newest. Rewards 1, 2, 4, 8, 16, 32, halved at
    # each step: 1 + 2/2 + 4/4; 2 + 4/2; 4; 8; 16 + 32/2; 32.
    steps = [(0, 1, 1, {}), (1, 2, 2, {}), (2, 4, 3, END), (10, 8, 11, STOP), (20, 16, 21, {}), (21, 32, 22, {})]
    assert drawn(replay(steps, 3), 6) == {
        "reward": [3, 4, 4, 8, 32, 32],
        "steps": [3, 2, 1, 1, 2, 1],
        "terminated": [1, 1, 1, 0, 0, 0],
        "truncated": [0, 0, 0, 1, 0, 0],
        "next": [3, 3, 3, 11, 22, 22],
        "first": [0, 1, 2, 10, 20, 21],
    }


def test_the_oldest_step_does_not_follow_the_newest():
    # Of 0 → 1 → ... → 6 the ring holds four: 4 → 5 and 5 → 6 were written over the first two.
    steps: list[Any] = [(i, i, i + 1, {}) for i in range(6)]
    found = drawn(replay(steps, 3, capacity=4), 6)
    assert found["first"] == [4, 5, 2, 3]
    assert found["reward"] == [4 + 5 / 2, 5, 2 + 3 / 2 + 4 / 4, 3 + 4 / 2 + 5 / 4]
    assert found["next"] == [6, 6, 5, 6]


def test_each_environment_has_returns_of_its_own():
    # Two environments, one step of each after the other: 0 → 1 → 2 and 100 → 101, terminated, then 200 → 201.
    steps = [(0, 1, 1, {}), (100, 10, 101, END), (1, 2, 2, {}), (200, 20, 201, {})]
    found = drawn(replay(steps, 3), 4, environments=2)
    assert found["reward"] == [2, 10, 2, 20]
    assert found["next"] == [2, 101, 2, 201]


def test_an_episode_that_was_broken_off_without_a_trace_is_not_continued():
    # A resume whose environment cannot be saved begins a new episode, and nothing in the replay says so.
    found = drawn(replay([(0, 1, 1, {}), (50, 2, 51, {}), (51, 4, 52, {})], 3), 3)
    assert found["reward"] == [1, 4, 4]
    assert found["next"] == [1, 52, 52]


@pytest.mark.parametrize("algorithm", [CSAC, SAC, TD3, SD3], ids=lambda algorithm: algorithm.name)
def test_what_follows_m_steps_is_discounted_m_times(algorithm):
    learner = algorithm(n_steps=3, discount=0.5)
    counts = [1.0, 2.0, 3.0]
    given = [transition()._replace(steps=jnp.float32(steps)) for steps in counts]
    assert [float(learner.discount_after(one)) for one in given] == [0.5, 0.25, 0.125]
    assert float(learner.discount_after(transition(terminated=1.0)._replace(steps=jnp.float32(2.0)))) == 0.0
    assert float(learner.discount_after(transition())) == 0.5


def test_one_step_draws_are_as_they_were():
    ring = replay([(i, i, i + 1, {}) for i in range(4)], 1)
    batch = ring.sample(jax.random.key(0), jnp.int32(4), 16, Spec(1, 1))
    assert isinstance(batch, Transition)
    assert batch.steps is None


def test_a_truncated_episode_goes_on_in_its_value_over_several_steps():
    # As in the probes: Q = r / (1 - γ) = 5, whatever n is, though an episode is cut off every 5 steps. Had a return of
    # several steps crossed a cut, or been discounted once, it would be another.
    sizes: dict[str, Any] = {"actor_hidden_sizes": (16,), "critic_hidden_sizes": (16,), "batch_size": 32}
    rates: dict[str, Any] = {"actor_learning_rate": 0.01, "critic_learning_rate": 0.01, "target_rate": 0.1}
    algorithm = TD3(n_steps=3, discount=0.8, warmup_steps=100, **sizes, **rates)
    state = run(algorithm, probes.Endless, 900, environments=2, length=5).states[0]
    value = [critic(jnp.zeros(2)) for critic in state.critics]
    np.testing.assert_allclose(value, 5.0, atol=0.4)
