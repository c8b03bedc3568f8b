"""What off-policy algorithms share: each network's own optimiser, Adam's momentum, and actors that wait."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import SPEC, assert_close, assert_equal, begin, differ, transitions, update

from csac.algorithms import CSAC, SAC, SD3, TD3
from csac.algorithms.networks import init_optimiser, make_mlp

SMALL: dict[str, Any] = {"actor_hidden_sizes": (4,), "critic_hidden_sizes": (4,), "batch_size": 8}
ALGORITHMS = {
    "csac": CSAC(**SMALL),
    "sac, normalised critics": SAC(critic_normalisation="batch", **SMALL),
    "td3": TD3(**SMALL),
    "sd3": SD3(noise_samples=3, **{**SMALL, "batch_size": 4}),  # a mini-batch for each of its pairs
}
STILL = 1e-20  # a learning rate, or a bound on a gradient, by which no parameter of 32 bits moves


def networks_of(state: Any) -> tuple[list[Any], list[Any]]:
    """Actors and critics."""
    pairs = [state] if hasattr(state, "actor") else [state.first, state.second]
    return [pair.actor for pair in pairs], [getattr(pair, "critics", getattr(pair, "critic", None)) for pair in pairs]


def moved(algorithm: Any) -> tuple[set[bool], set[bool]]:
    """Whether actors and critics move within two updates, of which TD3 moves its actor in the second."""
    first = state = begin(algorithm, SPEC)
    for step in range(2):
        state, _ = update(algorithm, state, transitions(8), step)
    before, after = networks_of(first), networks_of(state)
    actors, critics = ({differ(*pair) for pair in zip(*kind, strict=True)} for kind in zip(before, after, strict=True))
    return actors, critics


@pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)
def test_actors_and_critics_have_learning_rates_of_their_own(algorithm):
    assert moved(replace(algorithm, actor_learning_rate=STILL)) == ({False}, {True})


def test_gradient_bound_holds_for_actor_and_critics():
    assert moved(TD3(**{**SMALL, "max_gradient_norm": STILL})) == ({False}, {False})  # far below Adam's epsilon


def test_the_first_weights_and_biases_fill_the_range_of_their_inputs():
    for layer, inputs in zip(make_mlp(jax.random.key(0), 16, (400, 900), 40).layers, (16, 400, 900), strict=True):
        largest = max(float(np.abs(layer.weight).max()), float(np.abs(layer.bias).max()))
        assert 0.99 / inputs**0.5 < largest <= 1 / inputs**0.5
        assert float(np.std(layer.weight)) == pytest.approx(1 / (3 * inputs) ** 0.5, rel=0.02)  # of a uniform number


def test_adam_by_hand():
    # Gradients 1 and 3 with β₁ = 0.5, β₂ = 0.999: corrected means 1 and (0.5·0.5·1 + 0.5·3)/0.75 = 7/3, corrected
    # squares 1 and (0.999·1 + 9)/1.999. Steps of 0.1: 1/√1, then (7/3)/√5.002001.
    optimiser, parameter = CSAC(adam_momentum=0.5).optimiser(0.1), jnp.zeros(())
    state, steps = init_optimiser(optimiser, parameter), []
    for gradient in (1.0, 3.0):
        step, state = optimiser.update(jnp.float32(gradient), state, parameter)
        steps.append(np.asarray(step).item())
    assert steps == pytest.approx([-0.1, -0.1 * (7 / 3) / 5.002001**0.5], rel=1e-5)


DELAYED = [
    CSAC(
        policy_delay=3,
        reference_policy="average",
        reference_rate=1.0,
        entropy_weight="auto",
        policy_average_rate=0.25,
        **SMALL,
    ),
    SAC(policy_delay=3, normalise_observations=True, policy_average_rate=0.25, **SMALL),
]
delayed = pytest.mark.parametrize("algorithm", DELAYED, ids=lambda algorithm: algorithm.name)
# What a waiting update leaves alone.
IMPROVED = ("actor", "actor_optimiser", "temperature", "reference", "average")


@lru_cache
def updates(algorithm: Any) -> list[tuple[Any, Any]]:
    """The states after 0 to 7 updates, and the metrics of each of these."""
    found: list[tuple[Any, Any]] = [(begin(algorithm, SPEC), {})]
    for step in range(7):
        found.append(update(algorithm, found[-1][0], transitions(8), step))
    return found


@delayed
def test_every_third_update_improves_the_actor_and_each_the_critics(algorithm):
    found = updates(algorithm)
    for step in range(7):
        (before, _), (after, metrics) = found[step], found[step + 1]
        assert differ(before.critics, after.critics)
        if step % 3 == 2:
            assert differ(before.actor, after.actor)
        else:
            for name in IMPROVED:
                assert_equal(getattr(before, name, None), getattr(after, name, None))
        if step < 2:
            assert metrics["entropy"] == metrics["actor_loss"] == 0.0
        elif step % 3 != 2:
            assert metrics["entropy"] == found[step][1]["entropy"] != 0.0


@delayed
def test_update_that_improves_is_one_without_delay_or_average(algorithm):
    state, without = updates(algorithm)[2][0], {"actor_metrics": None, "average": None}
    after, metrics = updates(algorithm)[3]
    plain = replace(algorithm, policy_delay=1, policy_average_rate=1.0)
    expected = update(plain, state._replace(**without), transitions(8), 2)
    assert_close((after._replace(**without), metrics), expected)


def test_the_reference_of_one_update_ago_is_the_actor_before_it_last_moved():
    found = updates(DELAYED[0])
    assert_close(found[7][0].reference, found[5][0].actor, rtol=1e-6, atol=1e-7)
    assert differ(found[7][0].reference, found[6][0].actor)


def test_periodic_references_are_renewed_while_the_actor_waits():
    found = updates(CSAC(policy_delay=3, reference_policy="periodic", reference_period=4, **SMALL))
    assert differ(found[4][0].reference, found[4][0].actor)
    assert_equal(found[5][0].reference, found[3][0].actor)  # update 4 begins a period, and waits


@delayed
def test_average_of_past_actors_is_evaluated_and_exported(algorithm):
    (first, _), (state, _) = updates(algorithm)[3], updates(algorithm)[6]
    average = jax.tree.map(lambda one, other: one / 11 + 10 * other / 11, first.actor, state.actor)
    assert_close((first.average, state.average), (first.actor, average), rtol=1e-6, atol=1e-7)
    assert_equal(algorithm.policy(state).parameters.actors[0], state.average.layers)
    observation, key = jnp.ones(SPEC.observation_size), jax.random.key(0)
    for actor, explore in ((state.actor, True), (state.average, False)):
        action = algorithm.act(state._replace(actor=actor, average=None), observation, key, explore)
        assert_equal(algorithm.act(state, observation, key, explore), action)


def test_an_average_moves_by_its_rate_once_that_is_above_a_tenth_of_the_last_actors():
    average_after: Any = SAC(policy_average_rate=0.25).average_after  # of numbers, for networks
    steps = [average_after(jnp.zeros(()), jnp.ones(()), step) for step in (0, 10, 29, 30, 31, 10_000)]
    np.testing.assert_allclose(steps, [1, 10 / 20, 10 / 39, 0.25, 0.25, 0.25], rtol=1e-6)
