"""SD3's softmax operator and equations against numbers worked by hand, and the order of its two pairs."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import LINEAR, ONE, always, batch_of, linear, transition, update

from csac.algorithms import sd3 as file
from csac.algorithms.sd3 import SD3, Pair, State, actor_loss, critic_loss, log_density, softmax_operator
from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.types import Spec

SETTINGS: dict[str, Any] = {**LINEAR, "noise_samples": 3}


def operator(values, beta: float, weights=None) -> float:
    values = jnp.array(values, jnp.float32)
    log_weights = jnp.zeros(values.shape) if weights is None else jnp.log(jnp.array(weights))
    return float(softmax_operator(values, beta, log_weights))


def test_the_operator_by_hand():
    # exp(β Q) at β = 2: 1, 4, 16, so (0·1 + log 2·4 + log 4·16) / 21 = 36 log 2 / 21 = 1.1882523
    values = [0.0, math.log(2), math.log(4)]
    assert operator(values, 2.0) == pytest.approx(1.1882523, abs=1e-6)
    # With weights 8, 2, 1: 8, 8, 16, so (8 + 32) log 2 / 32 = 0.8664340
    assert operator(values, 2.0, [8.0, 2.0, 1.0]) == pytest.approx(0.8664340, abs=1e-6)


def test_the_operator_goes_from_the_mean_to_the_maximum():
    values = [-1.0, 0.5, 4.0]
    betas = [operator(values, beta) for beta in (0.0, 0.1, 1.0, 10.0, 1e30)]
    assert betas[0] == pytest.approx(3.5 / 3)
    assert betas[-1] == 4.0
    assert betas == sorted(betas)
    assert operator(values, 0.0, [1.0, 1.0, 2.0]) == pytest.approx(7.5 / 4)  # the weighted mean


@pytest.mark.parametrize("beta", [0.0, 0.05, 500.0])
def test_one_sample_is_its_own_value(beta):
    assert operator([-7.25], beta, [1e-20]) == -7.25


@pytest.mark.parametrize("shift", [-1e6, 1e6])
def test_a_shift_of_the_values_shifts_the_result(shift):
    # β Q is ± 5e8 and ± 1e6 here, and its exponential no number. Floats at 1e6 lie 1/16 apart.
    assert operator([shift - 0.5, shift, shift + 0.5], 500.0) == shift + 0.5
    assert operator([shift, shift + 1.0], math.log(3.0)) == pytest.approx(shift + 0.75, abs=0.0625)


def test_the_density_is_that_of_the_noise_before_clipping():
    # Ratios of N(ξ; 0, I): (1, 2) against (0, 0) is exp(-(1 + 4) / 2), whatever the noise is scaled by.
    density = log_density(jnp.array([[0.0, 0.0], [1.0, 2.0]]))
    assert float(density[1] - density[0]) == pytest.approx(-2.5)


# The target actor's action is 0.6 and σ = 0.2, so that noise 0, 1, -5 and 5 gives 0.6, 0.8, 0.1 and 1: the last two are
# clipped, to 0.6 - 0.5 and, from 1.1, to 1. Q₁' = s + 2a and Q₂' = 3.2 - a at s = 1, so min Q' = 2.2, 2.4, 1.2, 2.2.
TARGET_CRITICS = (linear([[1.0], [2.0]], [0.0]), linear([[0.0], [-1.0]], [3.2]))
NOISE = jnp.array([[0.0], [1.0], [-5.0], [5.0]])


def weighted(values: list[float], weights: list[float]) -> float:
    return sum(value * weight for value, weight in zip(values, weights, strict=True)) / sum(weights)


@pytest.mark.parametrize(
    ("settings", "terminated", "truncated", "value"),
    [
        ({"inverse_temperature": 0.0}, 0.0, 0.0, 2.0),  # the mean of 2.2, 2.4, 1.2 and 2.2
        ({"inverse_temperature": 1e9}, 0.0, 0.0, 2.4),  # the maximum
        # exp(β (Q - 2.2)) at β = 5 log 2: 1, 2, 1/32, 1
        ({"inverse_temperature": 5 * math.log(2)}, 0.0, 0.0, weighted([2.2, 2.4, 1.2, 2.2], [1, 2, 1 / 32, 1])),
        # Importance weights exp(ξ²/2): 1, e^0.5, e^12.5, e^12.5 — the clipped samples' are those of -5 and 5.
        (
            {"inverse_temperature": 5 * math.log(2), "importance_sampling": True},
            0.0,
            0.0,
            weighted([2.2, 2.4, 1.2, 2.2], [1, 2 * math.exp(0.5), math.exp(12.5) / 32, math.exp(12.5)]),
        ),
        ({"inverse_temperature": 0.0}, 1.0, 0.0, 0.0),  # nothing follows
        ({"inverse_temperature": 0.0}, 1.0, 1.0, 0.0),
        ({"inverse_temperature": 0.0}, 0.0, 1.0, 2.0),  # the environment was only stopped
    ],
)
def test_the_critic_target(settings, terminated, truncated, value):
    step = transition(terminated=terminated, truncated=truncated)
    target = SD3(discount=0.9, **settings).critic_target(step, NOISE, target_actor=always(0.6), targets=TARGET_CRITICS)
    assert float(target) == pytest.approx(2.0 + 0.9 * value, abs=1e-5)


def test_the_losses_are_those_of_one_pair():
    # Q(1, 0.5) = 1 + 2·0.5 = 2 with target 3, and Q(1, 0.3) = 1.6.
    loss, metrics = critic_loss(TARGET_CRITICS[0], transition(), jnp.float32(3.0))
    assert (float(loss), float(metrics["q_mean"])) == pytest.approx((1.0, 2.0))
    assert float(actor_loss(always(0.3), jnp.ones(1), critic=TARGET_CRITICS[0])[0]) == pytest.approx(-1.6)


def pair(algorithm: SD3, target_value: float) -> Pair:
    """Q = 0.01 a, the actor 0 and its target 0.5, everywhere: its target critic 4a + b says `target_value` there."""
    made = algorithm.init(jax.random.key(0), ONE, 1000).first
    return made._replace(
        actor=always(0.0),
        critic=linear([[0.0], [0.01]], [0.0]),
        target_actor=always(0.5),
        target_critic=linear([[0.0], [4.0]], [target_value - 2.0]),
    )


ONE_BY_ONE = SD3(batch_size=1, target_noise=0.0, **SETTINGS)


def test_each_pair_learns_in_turn_from_its_own_batch():
    # First pair, reward 0: y = 0.5 min(-20, -18) = -10 and Q(1, 1) = 0.01, a loss of 10.01². In Adam's first step all
    # three parameters go down by 0.1: the slope in the action turns from 0.01 to -0.09, and the actor, which sees the
    # new critic, goes down. Its target critic moves halfway, to -11.05 - 0.05 s + 1.955 a.
    # Second pair, reward 7: y = 7 + 0.5 min(-18, -11.05 + 1.955·0.5) = -2, a loss of 2.01², and all else is alike.
    batch = batch_of(transition(action=1.0, reward=0.0), transition(action=1.0, reward=7.0, next_observation=0.0))
    before = State(pair(ONE_BY_ONE, -20.0), pair(ONE_BY_ONE, -18.0))
    state, metrics = update(ONE_BY_ONE, before, batch)
    assert float(metrics["critic_loss"]) == pytest.approx((10.01**2 + 2.01**2) / 2, rel=1e-5)
    assert float(metrics["q_mean"]) == pytest.approx(0.01)
    assert float(metrics["actor_loss"]) == pytest.approx(0.2, abs=1e-5)  # 0.1 s + 0.09 a + 0.1 at s = 1, a = 0
    for learnt, bias in zip(state, (-11.05, -10.05), strict=True):
        np.testing.assert_allclose(learnt.critic.layers[0].weight, [[-0.1], [-0.09]], atol=1e-6)
        np.testing.assert_allclose(learnt.target_critic.layers[0].weight, [[-0.05], [1.955]], atol=1e-6)
        np.testing.assert_allclose(learnt.target_critic.layers[0].bias, [bias], atol=1e-5)
        assert float(learnt.actor.layers[0].bias[0]) == pytest.approx(-0.1, abs=1e-5)
        assert float(learnt.target_actor.layers[0].bias[0]) == pytest.approx((math.atanh(0.5) - 0.1) / 2, abs=1e-5)


def test_the_second_pair_sees_the_new_target_of_the_first():
    # As above, but the second's own target critic says -1. The first's said -20 and says, at s' = -0.45 and a' = 0.5,
    # -11.05 + 0.05·0.45 + 1.955·0.5 = -10.05: y = 7 - 5.025 = 1.975, where the old one would give -3.
    batch = batch_of(transition(action=1.0, reward=0.0), transition(action=1.0, reward=7.0, next_observation=-0.45))
    before = State(pair(ONE_BY_ONE, -20.0), pair(ONE_BY_ONE, -1.0))
    _, metrics = update(ONE_BY_ONE, before, batch)
    assert float(metrics["critic_loss"]) == pytest.approx((10.01**2 + 1.965**2) / 2, rel=1e-5)


def test_an_update_is_given_a_batch_for_each_pair():
    algorithm = SD3(batch_size=32, **SETTINGS)
    assert algorithm.cadence.transitions_per_update == 64
    assert SD3().cadence.transitions_per_update == 512


def test_targets_in_groups_are_in_their_places(monkeypatch):
    """Groups of 4 and a batch of 7. After terminal steps y = r, and Q(s, a) = s = r leaves no error."""
    monkeypatch.setattr(file, "EXAMPLES_AT_ONCE", 4)
    algorithm = SD3(batch_size=7, **SETTINGS)
    made = pair(algorithm, 0.0)._replace(critic=linear([[1.0], [0.0]], [0.0]))
    batch = batch_of(*[transition(observation=x, reward=x, terminated=1.0) for x in range(14)])
    _, metrics = update(algorithm, State(made, made), batch)
    assert float(metrics["critic_loss"]) == 0.0
    assert float(metrics["q_mean"]) == 6.5


def act(algorithm: SD3, state: State, keys: jax.Array, explore: bool) -> np.ndarray:
    return np.asarray(jax.vmap(algorithm.act, in_axes=(None, None, 0, None))(state, jnp.ones(1), keys, explore))


@pytest.mark.parametrize(("first_value", "second_value", "expected"), [(1.0, 0.5, 0.4), (0.5, 1.0, -0.6)])
def test_the_actor_acts_whose_own_critic_values_it_more(first_value, second_value, expected):
    # Each critic would value the other's action at ±100: that is not asked.
    algorithm = SD3(**SETTINGS)
    first, second = (pair(algorithm, 0.0) for _ in range(2))
    state = State(
        first._replace(actor=always(0.4), critic=linear([[0.0], [-100.0]], [first_value + 40.0])),
        second._replace(actor=always(-0.6), critic=linear([[0.0], [100.0]], [second_value + 60.0])),
    )
    keys = jax.random.split(jax.random.key(1), 4000)
    np.testing.assert_allclose(act(algorithm, state, keys[:2], False), expected, rtol=1e-5)
    explored = act(algorithm, state, keys, True)
    assert explored.mean() == pytest.approx(expected, abs=0.01)  # standard error 0.0016
    assert explored.std() == pytest.approx(0.1, abs=0.01)


def test_of_actions_valued_the_same_the_first_is_taken():
    algorithm, indifferent = SD3(**SETTINGS), linear([[0.0], [0.0]], [1.0])
    both = pair(algorithm, 0.0)._replace(critic=indifferent)
    state = State(both._replace(actor=always(0.4)), both._replace(actor=always(-0.6)))
    np.testing.assert_allclose(act(algorithm, state, jax.random.split(jax.random.key(1), 2), False), 0.4, rtol=1e-5)


def test_exploration_stays_within_the_bounds():
    # At 0.95 the bound is half a standard deviation away: 31 % of the noise goes past it.
    algorithm = SD3(**SETTINGS)
    both = pair(algorithm, 0.0)._replace(actor=always(0.95))
    explored = act(algorithm, State(both, both), jax.random.split(jax.random.key(1), 4000), True)
    assert explored.max() == 1.0
    assert np.mean(explored == 1.0) == pytest.approx(0.309, abs=0.03)


def test_the_policy_that_leaves_acts_as_the_algorithm_does():
    spec, bound = Spec(3, 2), np.ones(2, np.float32)
    algorithm = SD3(actor_hidden_sizes=(8,), critic_hidden_sizes=(8,))
    state = algorithm.init(jax.random.key(3), spec, 1000)
    network = algorithm.policy(jax.tree.map(np.asarray, state))
    contract = Contract("Task-v0", "sd3", network.activation, network.head, ((None, (3,)),), (2,), -bound, bound)
    observations = 3.0 * jax.random.normal(jax.random.key(0), (40, 3))
    actions = jax.vmap(algorithm.act, in_axes=(None, 0, None, None))(state, observations, jax.random.key(0), False)
    np.testing.assert_allclose(Policy(network, contract).act(np.asarray(observations)), actions, atol=1e-6)
    of_the_first = np.isclose(actions, jnp.tanh(jax.vmap(state.first.actor)(observations))).all(axis=1)
    assert 5 < of_the_first.sum() < 35


def test_the_first_state_has_two_different_pairs_with_copies_for_targets():
    state = SD3(actor_hidden_sizes=(4,), critic_hidden_sizes=(4,)).init(jax.random.key(0), ONE, 1000)
    for made in state:
        jax.tree.map(np.testing.assert_array_equal, made.actor, made.target_actor)
        jax.tree.map(np.testing.assert_array_equal, made.critic, made.target_critic)
    assert not np.allclose(state.first.actor.layers[0].weight, state.second.actor.layers[0].weight)
    assert not np.allclose(state.first.critic.layers[0].weight, state.second.critic.layers[0].weight)
    pointers = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(state)]
    assert len(set(pointers)) == len(pointers)
