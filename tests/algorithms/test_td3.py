"""TD3's equations against numbers worked by hand, and its delay."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import LINEAR, ONE, always, batch_of, linear, transition, update

from csac.algorithms.td3 import TD3

# The target actor's action is 0.3. Q₁' = s + 2a and Q₂' = 3 - a at s = 1 cross at a = 2/3.
TARGET_CRITICS = (linear([[1.0], [2.0]], [0.0]), linear([[0.0], [-1.0]], [3.0]))


@pytest.mark.parametrize(
    ("action", "noise", "expected"),
    [
        (0.3, 0.0, 0.3),
        (0.3, 1.0, 0.5),  # 0.2 ξ
        (0.3, 10.0, 0.8),  # 2 is clipped to 0.5
        (0.3, -10.0, -0.2),
        (0.9, 1.0, 1.0),  # 1.1 is no action
        (-0.9, -10.0, -1.0),
    ],
)
def test_target_actions_are_smoothed_and_clipped_twice(action, noise, expected):
    smoothed = TD3().smoothed_action(always(action), jnp.ones(1), jnp.array([noise]))
    assert float(smoothed[0]) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("noise", "terminated", "truncated", "expected"),
    [
        (0.0, 0.0, 0.0, 3.44),  # a = 0.3: min(1.6, 2.7), 2 + 0.9·1.6
        (10.0, 0.0, 0.0, 3.98),  # a = 0.8: min(2.6, 2.2), 2 + 0.9·2.2: the second critic is the smaller one
        (-1.0, 0.0, 0.0, 3.08),  # a = 0.1: min(1.2, 2.9), 2 + 0.9·1.2
        (0.0, 1.0, 0.0, 2.0),  # nothing follows
        (0.0, 1.0, 1.0, 2.0),
        (0.0, 0.0, 1.0, 3.44),  # the environment was only stopped
    ],
)
def test_the_critic_target(noise, terminated, truncated, expected):
    step = transition(terminated=terminated, truncated=truncated)
    target = TD3(discount=0.9).critic_target(step, jnp.array([noise]), target_actor=always(0.3), targets=TARGET_CRITICS)
    assert float(target) == pytest.approx(expected, abs=1e-5)


def test_the_actor_loss_is_of_the_first_critic_alone():
    for action, expected in ((0.3, -1.6), (0.8, -2.6)):  # at 0.8 the second critic is smaller
        loss, _ = TD3().actor_loss(always(action), jnp.ones(1), critics=TARGET_CRITICS)
        assert float(loss) == pytest.approx(expected)


def linear_state(algorithm: TD3):
    """Both critics Q = 0.01 a, target critics Q' = 4a - 22, the actor 0 and its target 0.5, everywhere."""
    critic, target_critic = linear([[0.0], [0.01]], [0.0]), linear([[0.0], [4.0]], [-22.0])
    return algorithm.init(jax.random.key(0), ONE, 1000)._replace(
        actor=always(0.0),
        target_actor=always(0.5),
        critics=(critic, critic),
        target_critics=(target_critic, target_critic),
    )


def test_a_delayed_update_moves_the_actor_against_the_new_critics_and_the_targets_last():
    # y = 0 + 0.5 (4·0.5 - 22) = -10 and Q = 0.01 at a = 1: a loss of 2·10.01². In Adam's first step all
    # parameters of the critics go down by 0.1. The slope in the action turns from 0.01 to -0.09: the actor goes down
    # only if it sees the new critics. Targets: halfway from the old ones to the new.
    algorithm = TD3(target_noise=0.0, **LINEAR)
    before = linear_state(algorithm)
    state, metrics = update(algorithm, before, batch_of(transition(action=1.0, reward=0.0)), 1)
    assert float(metrics["critic_loss"]) == pytest.approx(200.4002, rel=1e-6)
    assert float(metrics["q_mean"]) == pytest.approx(0.01)
    assert float(metrics["actor_loss"]) == pytest.approx(0.2, abs=1e-5)  # -Q₁ = 0.1 s + 0.09 a + 0.1 at s = 1, a = 0
    assert float(state.actor.layers[0].bias[0]) == pytest.approx(-0.1, abs=1e-5)
    assert float(state.target_actor.layers[0].bias[0]) == pytest.approx((math.atanh(0.5) - 0.1) / 2, abs=1e-5)
    for new, target in zip(state.critics, state.target_critics, strict=True):
        np.testing.assert_allclose(new.layers[0].weight, [[-0.1], [-0.09]], atol=1e-6)
        np.testing.assert_allclose(target.layers[0].weight, [[-0.05], [1.955]], atol=1e-6)
        np.testing.assert_allclose(target.layers[0].bias, [-11.05], atol=1e-5)


def test_actor_and_targets_move_with_every_delay_th_update_alone():
    delay = 3
    algorithm = TD3(policy_delay=delay, **LINEAR)
    state, batch, loss = linear_state(algorithm), batch_of(transition()), 0.0
    for step in range(6):
        before = state
        state, metrics = update(algorithm, before, batch, step)
        is_due = step % delay == delay - 1
        for name in ("actor", "target_actor", "target_critics", "actor_optimiser"):
            ours, theirs = (jax.tree.leaves(getattr(x, name)) for x in (before, state))
            moved = not all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))
            assert moved == is_due, (name, step)
        assert not np.array_equal(before.critics[0].layers[0].bias, state.critics[0].layers[0].bias)
        assert (float(metrics["actor_loss"]) != loss) == is_due  # that of the last move until then
        loss = float(metrics["actor_loss"])


def test_delayed_update_of_several_seeds_stays_a_conditional():
    algorithm, keys = TD3(actor_hidden_sizes=(5,), critic_hidden_sizes=(6,)), jax.random.split(jax.random.key(0), 3)
    states = jax.eval_shape(jax.vmap(lambda key: algorithm.init(key, ONE, 1000)), keys)
    batches = batch_of(*[batch_of(*[transition()] * 4)] * 3)

    def program(step, axis):
        together = jax.vmap(algorithm.update, in_axes=(0, 0, 0, axis))
        return str(jax.make_jaxpr(together)(states, batches, keys, step))

    assert "cond[" in program(jnp.int32(0), None)
    assert "cond[" not in program(jnp.arange(3), 0)  # a step for each seed: both are computed, then one selected


def test_actions_explore_with_noise_within_the_bounds():
    algorithm = TD3(exploration_std=0.1, **LINEAR)
    act = jax.vmap(algorithm.act, in_axes=(None, None, 0, None))
    keys = jax.random.split(jax.random.key(1), 4000)
    state = linear_state(algorithm)._replace(actor=always(0.4))
    np.testing.assert_allclose(act(state, jnp.ones(1), keys, False), 0.4, rtol=1e-6)
    explored = np.asarray(act(state, jnp.ones(1), keys, True))
    assert explored.mean() == pytest.approx(0.4, abs=0.01)  # standard error 0.0016
    assert explored.std() == pytest.approx(0.1, abs=0.01)
    # At 0.95 the bound is half a standard deviation away: 31 % of the noise goes past it.
    at_the_edge = np.asarray(act(state._replace(actor=always(0.95)), jnp.ones(1), keys, True))
    assert at_the_edge.max() == 1.0
    assert np.mean(at_the_edge == 1.0) == pytest.approx(0.309, abs=0.03)
