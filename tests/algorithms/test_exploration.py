"""Correlated exploration noise: standard normal at each step, with the correlations that it should have."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import SPEC, begin

from csac.algorithms import CSAC, SAC, SD3, TD3
from csac.algorithms.exploration import OCTAVES, keys_at, keys_of, noise_of, uniform_of
from csac.training.one_seed import OneSeed
from csac.types import Spec

STEPS = 2**14


def series(noise: Any, of: Any = noise_of, size: int = 4) -> np.ndarray:
    """The noise of many steps, [step, dimension]."""
    keys = jax.jit(jax.vmap(partial(keys_at, noise, jax.random.key(3))))(jnp.arange(STEPS))
    return np.asarray(jax.jit(jax.vmap(lambda key: of(noise, key, size)))(keys))


def correlation(values: np.ndarray, lag: int) -> float:
    """The mean product of values so far apart, whose variance is known to be 1."""
    return float(np.mean(values[lag:] * values[:-lag]))


def test_ou_noise_falls_off_by_its_pull():
    values = series("ou")
    assert (values.mean(), values.var()) == (pytest.approx(0.0, abs=0.05), pytest.approx(1.0, abs=0.05))
    for lag in (1, 2, 5, 20):
        assert correlation(values, lag) == pytest.approx(0.85**lag, abs=0.05)


def test_pink_noise_is_correlated_over_all_octaves():
    # A draw that is held for L steps is shared by steps k apart with probability max(0, 1 - k / L).
    values = series("pink")
    assert values.std() == pytest.approx(1.0, abs=0.1)
    for lag in (1, 4, 32, 200):
        shared = sum(max(0.0, 1.0 - lag / 2**octave) for octave in range(OCTAVES)) / OCTAVES
        assert correlation(values, lag) == pytest.approx(shared, abs=0.1)


def test_uniform_noise_fills_the_range_of_actions_evenly():
    values = series("pink", uniform_of, 16)
    assert np.abs(values).max() <= 1.0
    np.testing.assert_allclose(np.quantile(values, [0.25, 0.5, 0.75]), [-0.5, 0.0, 0.5], atol=0.12)


def test_environments_have_noise_of_their_own_and_follow_their_own_steps():
    run_key = jax.random.key(1)
    keys = keys_of("pink", run_key, jnp.int32(12), 2)
    first, second = (np.asarray(noise_of("pink", key, 3)) for key in keys)
    assert not np.allclose(first, second)
    again = keys_of("pink", run_key, jnp.int32(13), 2)  # within the same turn
    np.testing.assert_array_equal(noise_of("pink", again[0], 3), first)


@pytest.mark.parametrize("algorithm", [CSAC, SAC, TD3, SD3], ids=lambda algorithm: algorithm.name)
def test_the_noise_is_that_of_the_actions(algorithm):
    sizes: dict[str, Any] = {"actor_hidden_sizes": (), "critic_hidden_sizes": ()}
    learner = algorithm(exploration_noise="ou", **sizes)
    state, observation = begin(learner, SPEC), jnp.zeros(3)
    keys = keys_at("ou", jax.random.key(0), jnp.int32(5))
    noise = noise_of("ou", keys, 2)
    if hasattr(learner, "exploration_std"):
        expected = jnp.clip(learner.act(state, observation, keys, False) + 0.1 * noise, -1.0, 1.0)
    else:
        outputs = state.actor(observation)
        expected = jnp.tanh(outputs[:2] + jnp.exp(outputs[2:]) * noise)
    np.testing.assert_allclose(learner.act(state, observation, keys, True), expected, rtol=1e-5)


def test_warm_up_actions_are_the_correlated_noise_of_each_environment():
    sizes: dict[str, Any] = {"actor_hidden_sizes": (4,), "critic_hidden_sizes": (4,)}
    one = OneSeed(SAC(exploration_noise="pink", warmup_steps=64, **sizes), Spec(3, 2, 2), 64)
    carry = jax.jit(one.begin)(np.asarray(jax.random.key_data(jax.random.key(0))))
    explore = jax.jit(one.explore)
    actions = [np.asarray(explore(carry, jnp.zeros((2, 3)), jnp.int32(step))) for step in (14, 16, 14)]
    keys = keys_of("pink", jax.random.wrap_key_data(carry.key), jnp.int32(14), 2)
    np.testing.assert_array_equal(actions[0], actions[2])
    np.testing.assert_allclose(actions[0], [uniform_of("pink", key, 2) for key in keys], rtol=1e-6)
    assert np.abs(actions[0] - actions[1]).max() > 0
