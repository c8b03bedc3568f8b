"""What off-policy algorithms share: each network's own optimiser, Adam's momentum, and actors that wait."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import SPEC, assert_close, assert_equal, begin, differ, transitions, update

from csac.algorithms import CSAC, SAC, SD3, TD3
from csac.algorithms.networks import init_optimiser, make_mlp

SMALL: dict[str, Any] = {"actor_hidden_sizes": (4,), "critic_hidden_sizes": (4,), "batch_size": 8}
SMALL |= {"max_gradient_norm": 1e9}
ALGORITHMS = {
    "csac": CSAC(**SMALL),
    "sac": SAC(**SMALL),
    "sac, normalised critics": SAC(critic_normalisation="batch", **SMALL),
    "td3": TD3(**SMALL),
    "sd3": SD3(noise_samples=3, **{**SMALL, "batch_size": 4}),  # a mini-batch for each of its pairs
}
STILL = 1e-20  # a learning rate, or a bound on a gradient, by which no parameter of 32 bits moves
each = pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)


def networks_of(state: Any) -> tuple[list[Any], list[Any]]:
    """Actors and critics."""
    pairs = [state] if hasattr(state, "actor") else [state.first, state.second]
    return [pair.actor for pair in pairs], [getattr(pair, "critics", getattr(pair, "critic", None)) for pair in pairs]


def moved(algorithm: Any, **changes: float) -> tuple[set[bool], set[bool]]:
    """Whether actors and critics move within two updates, of which TD3 moves its actor in the second."""
    first = state = begin(algorithm, SPEC)
    for step in range(2):
        state, _ = update(replace(algorithm, **changes), state, transitions(8), step)
    before, after = networks_of(first), networks_of(state)
    actors, critics = ({differ(*pair) for pair in zip(*kind, strict=True)} for kind in zip(before, after, strict=True))
    return actors, critics


@each
def test_every_network_moves_by_a_learning_rate_of_its_own_and_within_the_bound_on_gradients(algorithm):
    assert moved(algorithm, actor_learning_rate=STILL) == ({False}, {True})
    assert moved(algorithm, critic_learning_rate=STILL) == ({True}, {False})
    assert moved(algorithm, max_gradient_norm=STILL) == ({False}, {False})  # far below Adam's epsilon


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
    CSAC(policy_delay=3, reference_policy="average", entropy_weight="auto", **SMALL),
    SAC(policy_delay=3, normalise_observations=True, **SMALL),
]
# What a waiting update leaves alone.
IMPROVED = ("actor", "actor_optimiser", "temperature", "reference")


def updates(algorithm: Any, count: int) -> list[tuple[Any, Any]]:
    """The states after 0, 1, ... updates, and what each of these told."""
    found: list[tuple[Any, Any]] = [(begin(algorithm, SPEC), {})]
    for step in range(count):
        found.append(update(algorithm, found[-1][0], transitions(8), step))
    return found


@pytest.mark.parametrize("algorithm", DELAYED, ids=lambda algorithm: algorithm.name)
def test_every_third_update_improves_the_actor_and_each_the_critics(algorithm):
    found = updates(algorithm, 6)
    for step in range(6):
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


@pytest.mark.parametrize("algorithm", DELAYED, ids=lambda algorithm: algorithm.name)
def test_an_update_that_improves_is_one_without_a_delay(algorithm):
    waited, _ = updates(algorithm, 2)[-1]
    after, metrics = update(algorithm, waited, transitions(8), 2)
    without = waited._replace(actor_metrics=None)
    never, told = update(replace(algorithm, policy_delay=1), without, transitions(8), 2)
    assert_close((after._replace(actor_metrics=None), metrics), (never, told))


def test_the_reference_of_one_update_ago_is_the_actor_before_it_last_moved():
    found = updates(CSAC(policy_delay=3, reference_policy="average", reference_rate=1.0, **SMALL), 7)
    assert_close(found[7][0].reference, found[5][0].actor, rtol=1e-6, atol=1e-7)
    assert differ(found[7][0].reference, found[6][0].actor)


def test_periodic_references_are_renewed_while_the_actor_waits():
    found = updates(CSAC(policy_delay=3, reference_policy="periodic", reference_period=4, **SMALL), 5)
    assert differ(found[4][0].reference, found[4][0].actor)
    assert_equal(found[5][0].reference, found[3][0].actor)  # update 4 begins a period, and waits


@pytest.mark.parametrize("kind", [CSAC, SAC])
def test_the_average_of_past_actors_leaves_and_changes_no_training(kind):
    plain, averaging = kind(policy_delay=2, **SMALL), kind(policy_delay=2, policy_average_rate=0.25, **SMALL)
    found = updates(averaging, 4)
    average = jax.tree.map(lambda one, other: one / 11 + 10 * other / 11, found[2][0].actor, found[4][0].actor)
    state = found[4][0]
    assert_close((found[2][0].average, state.average), (found[2][0].actor, average), rtol=1e-6, atol=1e-7)
    assert_equal(averaging.policy(state).parameters.actors[0], state.average.layers)
    observation, key = jnp.ones(SPEC.observation_size), jax.random.key(0)
    for actor, explore in ((state.actor, True), (state.average, False)):
        action = plain.act(state._replace(actor=actor, average=None), observation, key, explore)
        assert_equal(averaging.act(state, observation, key, explore), action)
    assert_equal(state._replace(average=None), updates(plain, 4)[-1][0])


def test_an_average_moves_by_its_rate_once_that_is_above_a_tenth_of_the_last_actors():
    average_after: Any = SAC(policy_average_rate=0.25).average_after  # of numbers, for networks
    steps = [average_after(jnp.zeros(()), jnp.ones(()), step) for step in (0, 10, 29, 30, 31, 10_000)]
    np.testing.assert_allclose(steps, [1, 10 / 20, 10 / 39, 0.25, 0.25, 0.25], rtol=1e-6)
