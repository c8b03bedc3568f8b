"""Weights that are learnt: where their constraint is active they hold it, where it is not they fall to their floor."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import ONE, batch_of, gaussian, linear, transition, update

from csac.algorithms import CSAC
from csac.algorithms.adaptation import (
    LEAST_WEIGHT,
    MOST_WEIGHT,
    Weights,
    adapted,
    begin_weights,
    weight_loss,
    weights_now,
)
from csac.algorithms.networks import make_optimiser

GIVEN = (0.2, "auto")
OPTIMISER = make_optimiser(0.02)


def learn(relative_entropy_at, updates, target=0.02):
    """τ after some updates, where it brings about this relative entropy."""

    def one(learnt, _):
        weights = weights_now(GIVEN, learnt)
        slack = Weights(jnp.zeros(()), target - relative_entropy_at(weights.relative_entropy))
        return adapted(learnt, slack, OPTIMISER), None

    learnt = begin_weights(GIVEN, Weights(1.0, 0.5), OPTIMISER)
    return weights_now(GIVEN, jax.lax.scan(one, learnt, length=updates)[0])


def test_a_weight_settles_where_its_constraint_is_met():
    # Where Q rises by 1 with the mean of a Gaussian of std 0.3, the best mean for τ lies std²/τ from the reference: a
    # relative entropy of std²/2τ², which is the target 0.02 at τ = 0.3/√0.04 = 1.5.
    weights = learn(lambda tau: 0.09 / (2 * tau**2), 2000)
    assert float(weights.relative_entropy) == pytest.approx(1.5, rel=1e-3)
    assert weights.entropy == 0.2  # given, and not learnt


@pytest.mark.parametrize(("measured", "end"), [(0.0, LEAST_WEIGHT), (1.0, MOST_WEIGHT)])
def test_a_weight_stays_within_its_bounds(measured, end):
    assert float(learn(lambda tau: jnp.float32(measured), 1000).relative_entropy) == pytest.approx(end, rel=1e-5)


def test_a_weight_rises_where_its_constraint_is_hurt():
    # d/d(log w) [log w · slack] = slack = -1, and descent goes against it.
    assert float(jax.grad(weight_loss, has_aux=True)(0.3, -1.0)[0]) == -1.0


# CSAC's own updates. Q is ±3 times the action, and changes its side with each copy of the reference, so that the
# policy goes to and fro for ever. Without a restraint a period has a relative entropy of about 20 nats.
PERIOD = 100


def relative_entropies(target, updates):
    """The relative entropy and τ of each update of a policy that follows Q."""
    algorithm = CSAC(
        entropy_weight=0.2,
        relative_entropy_weight="auto",
        target_relative_entropy=target,
        reference_period=PERIOD,
        actor_learning_rate=0.03,
        critic_learning_rate=1e-9,  # the critics are given
        weight_learning_rate=0.005,
        actor_hidden_sizes=(),
        critic_hidden_sizes=(),
        discount=0.0,
    )
    batch = batch_of(*[transition()] * 16)

    def one(state, step):
        side = jnp.where((step // PERIOD) % 2, -3.0, 3.0)
        critic = jax.tree.map(lambda leaf: leaf * side, linear([[0.0], [1.0]], [0.0]))
        key = jax.random.fold_in(jax.random.key(0), step)
        state, metrics = algorithm.update(state._replace(critics=(critic, critic)), batch, key, step)
        return state, (metrics["relative_entropy"], metrics["relative_entropy_weight"])

    state = algorithm.init(jax.random.key(0), ONE, 1000)._replace(actor=gaussian(0.0, 0.5))
    _, found = jax.jit(lambda state: jax.lax.scan(one, state, jnp.arange(updates)))(state)
    return [np.asarray(values, np.float64) for values in found]


def test_the_relative_entropy_is_held_at_its_target_where_the_policy_strives_away():
    held, weights = relative_entropies(0.1, updates=4000)  # per action dimension, of which there is one
    assert held[-1000:].mean() == pytest.approx(0.1, rel=0.05)
    assert 1.0 < weights[-1000:].min() < weights[-1000:].max() < 10.0


def test_the_weight_falls_to_its_floor_where_the_policy_stays_near_by_itself():
    free, weights = relative_entropies(1000.0, updates=3000)
    assert weights[0] == pytest.approx(0.5)
    assert weights[-1] == pytest.approx(LEAST_WEIGHT, rel=1e-5)
    assert free[-1000:].mean() > 5.0  # so that what held it above was τ


def test_both_weights_are_told_as_they_were_used():
    algorithm = CSAC(
        entropy_weight="auto",
        relative_entropy_weight="auto",
        target_entropy=100.0,
        weight_learning_rate=0.1,
        actor_hidden_sizes=(),
        critic_hidden_sizes=(),
    )
    state = algorithm.init(jax.random.key(0), ONE, 1000)
    state, metrics = update(algorithm, state, batch_of(transition()))
    assert float(metrics["entropy_weight"]) == 1.0
    assert float(metrics["relative_entropy_weight"]) == 0.5
    # Adam's first step is the learning rate: up, as the entropy is below 100, and down, as the reference is the actor.
    assert float(state.learnt_weights.entropy.log_weight) == pytest.approx(0.1, abs=1e-5)
    assert float(state.learnt_weights.relative_entropy.log_weight) == pytest.approx(math.log(0.5) - 0.1, abs=1e-5)
