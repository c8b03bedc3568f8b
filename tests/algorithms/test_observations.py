"""Observations on a common scale: the running statistics of CSAC, SAC and TD3, and who sees what by them."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import batch_of, transition, update

from csac.algorithms import CSAC, SAC, TD3
from csac.algorithms.statistics import Statistics, normalise, normalise_batch
from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.types import Spec

SPEC = Spec(1, 1)
SMALL: dict[str, Any] = {"actor_hidden_sizes": (5,), "critic_hidden_sizes": (6,), "normalise_observations": True}
LEARNERS = [CSAC(**SMALL), SAC(**SMALL), TD3(policy_delay=1, **SMALL)]
FAR = batch_of(  # mean 4, standard deviation 2
    transition(observation=2.0, action=0.3, next_observation=5.0),
    transition(observation=6.0, action=-0.6, next_observation=999.0),
)
NEAR = FAR._replace(
    observation=np.array([[-1.0], [1.0]], np.float32), next_observation=np.array([[0.5], [10.0]], np.float32)
)


def test_a_batch_is_seen_by_statistics_that_have_absorbed_it():
    # Before: 2 values of mean 0 and variance 4. Together with 2 and 6: mean 2, variance (4 + 4) / 2 + 4 = 8.
    statistics, batch = normalise_batch(Statistics(*jnp.array([[2.0], [0.0], [4.0], [2.0]])), FAR)
    assert statistics is not None
    np.testing.assert_allclose([statistics.mean[0], statistics.variance[0]], [2.0, 8.0], rtol=1e-6)
    np.testing.assert_allclose(batch.observation, [[0.0], [4.0 / 8.0**0.5]], atol=1e-6)
    np.testing.assert_allclose(batch.next_observation, [[3.0 / 8.0**0.5], [10.0]], atol=1e-6)  # 352 is too far
    assert all(
        np.array_equal(ours, theirs) for ours, theirs in zip(batch[:-1], FAR[:-1], strict=True) if ours.ndim == 1
    )


def test_without_statistics_nothing_changes():
    assert normalise_batch(None, FAR) == (None, FAR)
    assert normalise(None, jnp.array([99.0])) == 99.0


@pytest.mark.parametrize("algorithm", LEARNERS, ids=lambda algorithm: algorithm.name)
def test_learning_from_far_observations_is_learning_from_near_ones(algorithm):
    """By its own statistics the first batch is (-1, 1), whatever its mean and spread."""
    first = algorithm.init(jax.random.key(0), SPEC, 100)
    (far, metrics), (near, expected) = update(algorithm, first, FAR), update(algorithm, first, NEAR)
    compare = partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5)
    jax.tree.map(compare, far._replace(observation_statistics=None), near._replace(observation_statistics=None))
    for name, value in expected.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-4, atol=1e-5)
    for state, moments in ((far, [4.0, 2.0]), (near, [0.0, 1.0])):
        statistics = state.observation_statistics
        np.testing.assert_allclose([statistics.mean[0], statistics.std[0]], moments, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("algorithm", LEARNERS, ids=lambda algorithm: algorithm.name)
def test_the_policy_that_leaves_sees_what_the_algorithm_sees(algorithm):
    state, _ = update(algorithm, algorithm.init(jax.random.key(0), SPEC, 100), FAR)
    network = jax.tree.map(
        lambda leaf: np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf, algorithm.policy(state)
    )
    bound = np.ones(1, np.float32)
    contract = Contract("T-v0", algorithm.name, network.activation, network.head, ((None, (1,)),), (1,), -bound, bound)
    observations = jnp.array([[-400.0], [2.0], [4.0], [7.0], [400.0]])
    act = jax.vmap(partial(algorithm.act, explore=False), in_axes=(None, 0, None))
    actions = act(state, observations, jax.random.key(0))
    np.testing.assert_allclose(Policy(network, contract).act(np.asarray(observations)), actions, atol=1e-6)
    seen = state._replace(observation_statistics=None)
    near = jnp.array([[-10.0], [-1.0], [0.0], [1.5], [10.0]])
    np.testing.assert_allclose(act(seen, near, jax.random.key(0)), actions, atol=1e-6)
