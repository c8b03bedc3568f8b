"""Weights that are learnt: where their constraint is active they hold it, where it is not they fall to their floor."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from equations import (
    CLOSED_FORM,
    LINEAR,
    PERIODIC,
    POLICY,
    PREVIOUS,
    REFERENCE,
    batch_of,
    begin,
    gaussian,
    linear,
    transition,
    update,
)

from csac.algorithms import CSAC
from csac.algorithms.adaptation import (
    LEAST_WEIGHT,
    MOST_WEIGHT,
    Weights,
    adapt_weights,
    current_weights,
    make_weights,
    weight_loss,
)
from csac.algorithms.networks import make_optimiser
from csac.types import Spec, Transition

GIVEN, OPTIMISER = Weights(0.2, "auto"), make_optimiser(0.02)


def learn(relative_entropy_at, updates, target=0.02):
    """τ after some updates, where it brings about this relative entropy."""

    def one(learnt, _):
        measured = {"relative_entropy": relative_entropy_at(current_weights(GIVEN, learnt).relative_entropy)}
        return adapt_weights(learnt, measured, Weights(0.0, target), True, OPTIMISER), None

    return current_weights(
        GIVEN, jax.lax.scan(one, make_weights(GIVEN, Weights(1.0, 0.5), OPTIMISER), length=updates)[0]
    )


def test_a_weight_settles_where_its_constraint_is_met():
    # Where Q rises by 1 with the mean of a Gaussian of std 0.3, the best mean for τ lies std²/τ from the reference: a
    # relative entropy of std²/2τ², which is the target 0.02 at τ = 0.3/√0.04 = 1.5.
    weights = learn(lambda tau: 0.09 / (2 * tau**2), 2000)
    assert float(weights.relative_entropy) == pytest.approx(1.5, rel=1e-3)
    assert weights.entropy == 0.2  # given, and not learnt


@pytest.mark.parametrize(("measured", "end"), [(1e-9, LEAST_WEIGHT), (1.0, MOST_WEIGHT)])
def test_a_weight_stays_within_its_bounds(measured, end):
    assert float(learn(lambda tau: jnp.float32(measured), 1000).relative_entropy) == pytest.approx(end, rel=1e-5)


def test_a_weight_rises_where_its_constraint_is_hurt():
    # d/d(log w) [log w · (-2 - (-1))] = -1, and descent goes against it.
    assert float(jax.grad(weight_loss, has_aux=True)(0.3, -2.0, least=-1.0)[0]) == -1.0


# CSAC's own updates. Q is ±3 times the action, and changes its side with each copy of the reference, so that the
# policy goes to and fro for ever. Without a restraint a period has a relative entropy of about 20 nats.
PERIOD = 100


def told_by(algorithm, slope_at, updates, examples, names):
    """Return these metrics of each update, float64 [update], where Q is `slope_at(step)` times the action."""
    batch = batch_of(*[transition()] * examples)

    def one(state, step):
        critic = jax.tree.map(lambda leaf: leaf * slope_at(step), linear([[0.0], [1.0]], [0.0]))
        key = jax.random.fold_in(jax.random.key(0), step)
        state, metrics = algorithm.update(state._replace(critics=(critic, critic)), batch, key, step)
        return state, [metrics[name] for name in names]

    state = begin(algorithm)._replace(actor=gaussian(0.0, 0.5))
    _, found = jax.jit(lambda state: jax.lax.scan(one, state, jnp.arange(updates)))(state)
    return [np.asarray(values, np.float64) for values in found]


def relative_entropies(target, updates, actor_learning_rate=0.03):
    """The relative entropy and τ of each update of a policy that follows Q."""
    algorithm = CSAC(
        entropy_weight=0.2,
        relative_entropy_weight="auto",
        target_relative_entropy=target,
        reference_period=PERIOD,
        **PERIODIC,
        actor_learning_rate=actor_learning_rate,
        critic_learning_rate=1e-9,  # the critics are given
        weight_learning_rate=0.005,
        actor_hidden_sizes=(),
        critic_hidden_sizes=(),
        discount=0.0,
    )
    slope_at = lambda step: jnp.where((step // PERIOD) % 2, -3.0, 3.0)  # noqa: E731
    return told_by(algorithm, slope_at, updates, 16, ("relative_entropy", "relative_entropy_weight"))


def test_what_a_refresh_comes_to_is_held_at_its_target_where_the_policy_strives_away():
    # Not the mean over all ages of the reference: the policy is on its way for most of a period.
    held, weights = relative_entropies(0.05, updates=6000, actor_learning_rate=0.003)  # of one action dimension
    assert held[PERIOD - 1 :: PERIOD][-20:].mean() == pytest.approx(0.05, rel=0.03)
    assert held[-20 * PERIOD :].mean() < 0.95 * 0.05
    assert 3.0 < weights[-1000:].min() < weights[-1000:].max() < 6.0
    free, _ = relative_entropies(1000.0, updates=3000, actor_learning_rate=0.003)
    assert free[PERIOD - 1 :: PERIOD][-10:].mean() > 2 * 0.05, "it was τ that held it"


def test_the_weight_falls_to_its_floor_where_the_policy_stays_near_by_itself():
    free, weights = relative_entropies(1000.0, updates=3000)
    np.testing.assert_allclose(weights[:PERIOD], 0.5, rtol=1e-6)  # nothing is measured before the first renewal
    assert weights[PERIOD] < 0.499
    assert weights[-1] == pytest.approx(LEAST_WEIGHT, rel=1e-5)
    assert free[-1000:].mean() > 5.0


def entropies(target, updates=3000):
    """The entropy and σ of each update of a policy that Q = 3a pulls to the edge of its actions."""
    algorithm = CSAC(
        entropy_weight="auto",
        relative_entropy_weight=0.0,
        target_entropy=target,
        weight_learning_rate=0.01,
        **CLOSED_FORM,
        **{**LINEAR, "actor_learning_rate": 0.01, "critic_learning_rate": 1e-9, "discount": 0.0},
    )
    return told_by(algorithm, lambda step: 3.0, updates, 64, ("entropy", "entropy_weight"))


def test_the_entropy_is_held_at_its_target_where_the_value_pulls_the_policy_together():
    # The best policy, exp(3a/σ) on [-1, 1], has an entropy of 1 + log(σ/3) where σ is small: -1 at σ = 3/e² = 0.41.
    # A tanh-Gaussian is not quite that.
    held, weights = entropies(-1.0)
    assert held[-1000:].mean() == pytest.approx(-1.0, abs=0.03)
    assert weights[-1000:].mean() == pytest.approx(0.41, rel=0.2)


def test_the_entropy_s_weight_falls_to_its_floor_where_the_policy_stays_wide_by_itself():
    free, weights = entropies(-100.0)
    assert weights[-1] == pytest.approx(LEAST_WEIGHT, rel=1e-5)
    assert -100.0 < free[-1] < -1.0


def test_both_weights_are_told_as_they_were_used():
    algorithm = CSAC(
        entropy_weight="auto",
        relative_entropy_weight="auto",
        target_entropy=100.0,
        weight_learning_rate=0.1,
        actor_hidden_sizes=(),
        critic_hidden_sizes=(),
        **PERIODIC,
    )
    state = begin(algorithm)
    state, metrics = update(algorithm, state, batch_of(transition()))
    assert float(metrics["entropy_weight"]) == 1.0
    assert float(metrics["relative_entropy_weight"]) == 0.5
    # Adam's first step is the learning rate: up, as the entropy is below 100. The first refresh is not over yet.
    assert float(state.learnt_weights.entropy.log_weight) == pytest.approx(0.1, abs=1e-5)
    assert float(state.learnt_weights.relative_entropy.log_weight) == pytest.approx(math.log(0.5), abs=1e-6)


@pytest.mark.parametrize(
    ("choice", "measured_at"),  # the update that measured what each update goes by; None before there is one
    [
        ("periodic", [None, None, 2, 2, 2, 5, 5, 5]),
        ("average", [None, 1, 2, 3, 4, 5, 6, 7]),  # at first the reference is the actor
    ],
)
def test_the_weight_goes_by_the_relative_entropy_of_the_last_refresh(choice, measured_at):
    target, rate = 0.3, 0.1
    algorithm = CSAC(
        relative_entropy_weight="auto",
        reference_policy=choice,
        reference_period=3,
        **CLOSED_FORM,
        target_relative_entropy=target,
        weight_learning_rate=rate,
        **LINEAR,
    )
    state, found = begin(algorithm), []
    batch = batch_of(transition(), transition(observation=-1.0, action=-0.5))
    for step in range(8):
        state, metrics = update(algorithm, state, batch, step)
        found.append((metrics["relative_entropy"], metrics["relative_entropy_per_refresh"], state.learnt_weights))

    expected: Any = jnp.log(0.5)
    adam = optax.adam(rate)
    moments = adam.init(expected)
    for at, (_, per_refresh, learnt) in zip(measured_at, found, strict=True):
        if at is None:
            assert float(per_refresh) == 0.0
        else:
            assert float(per_refresh) == float(found[at][0])
            move, moments = adam.update(target - found[at][0], moments)
            expected = optax.apply_updates(expected, move)
        assert float(learnt.relative_entropy.log_weight) == pytest.approx(float(expected), abs=1e-6)
    assert len({float(one) for one, _, _ in found}) >= 6  # so that each names its update; 0 with a new copy


def test_both_targets_grow_with_the_action_dimensions():
    # Two dimensions. KL = 2·0.5²/2 = 0.25 lies between 0.2 and 2·0.2, and the entropy, about 2 (1.4189385 - 2.169) =
    # -1.5, between -2 and -1: both weights fall, where targets of one dimension would raise both.
    def pair(mean):
        return linear([[0.0] * 4], [mean, mean, -2.169, -2.169])

    algorithm = CSAC(
        entropy_weight="auto",
        relative_entropy_weight="auto",
        **PREVIOUS,
        target_relative_entropy=0.2,
        weight_learning_rate=0.1,
        **LINEAR,
    )
    state = begin(algorithm, Spec(1, 2))
    state = state._replace(actor=pair(0.0), reference=pair(0.5 * math.exp(-2.169)))
    nothing = np.zeros(64, np.float32)
    observations = np.ones((64, 1), np.float32)
    batch = Transition(observations, np.zeros((64, 2), np.float32), nothing, observations, nothing, nothing)
    state, metrics = update(algorithm, state, batch)
    assert float(metrics["relative_entropy"]) == pytest.approx(0.25, rel=1e-4)
    assert float(metrics["entropy"]) == pytest.approx(-1.5, abs=0.4)
    assert float(state.learnt_weights.entropy.log_weight) == pytest.approx(-0.1, abs=1e-5)
    assert float(state.learnt_weights.relative_entropy.log_weight) == pytest.approx(math.log(0.5) - 0.1, abs=1e-5)


def test_the_target_charges_the_weight_that_is_learnt():
    # τ = 2, KL = 0.4431472, critics 0 and target critics 3: y = 2 + 0.5 (3 - 2·0.4431472), and the loss is 2 y².
    algorithm = CSAC(entropy_weight=0.0, relative_entropy_weight="auto", **PREVIOUS, **LINEAR)
    nothing, three = linear([[0.0], [0.0]], [0.0]), linear([[0.0], [0.0]], [3.0])
    state = begin(algorithm)
    tau = state.learnt_weights.relative_entropy._replace(log_weight=jnp.log(jnp.float32(2.0)))
    state = state._replace(
        actor=POLICY,
        reference=REFERENCE,
        critics=(nothing, nothing),
        target_critics=(three, three),
        learnt_weights=state.learnt_weights._replace(relative_entropy=tau),
    )
    _, metrics = update(algorithm, state, batch_of(transition()))
    assert float(metrics["critic_loss"]) == pytest.approx(2 * (3.5 - 0.4431472) ** 2, rel=1e-5)
