"""Actors that move at every few updates of their critics, and Adam's momentum."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac.algorithms import CSAC, SAC, TD3
from csac.algorithms.networks import init_optimiser, make_optimiser
from csac.types import InputError, Spec, Transition

SPEC = Spec(3, 2)
SMALL: dict[str, Any] = {"actor_hidden_sizes": (4,), "critic_hidden_sizes": (4,), "batch_size": 8}
DELAYED = [
    CSAC(policy_delay=3, reference_policy="average", entropy_weight="auto", **SMALL),
    CSAC(policy_delay=3, relative_entropy_form="implicit", critic_normalisation="batch", **SMALL),
    SAC(policy_delay=3, normalise_observations=True, **SMALL),
]
# What a waiting update leaves alone.
IMPROVED = ("actor", "actor_optimiser", "log_temperature", "temperature_optimiser", "learnt_weights", "reference")


def transitions(key: int) -> Transition:
    keys = jax.random.split(jax.random.key(key), 4)
    states, actions = jax.random.normal(keys[0], (2, 8, 3)), jnp.tanh(jax.random.normal(keys[1], (8, 2)))
    return Transition(states[0], actions, jax.random.normal(keys[2], (8,)), states[1], jnp.zeros(8), jnp.zeros(8))


@partial(jax.jit, static_argnums=0)
def update(algorithm, state, step: int):
    return algorithm.update(state, transitions(0), jax.random.key(step), step)


def updates(algorithm, count: int) -> list[tuple[Any, Any]]:
    """The states after 0, 1, ... updates, and what each of these told."""
    found: list[tuple[Any, Any]] = [(algorithm.init(jax.random.key(0), SPEC, 100), {})]
    for step in range(count):
        found.append(update(algorithm, found[-1][0], step))
    return found


def improved(state: Any) -> dict[str, Any]:
    return {name: getattr(state, name) for name in IMPROVED if hasattr(state, name)}


def assert_equal(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def differ(one: Any, other: Any) -> bool:
    return any(not np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True))


def distance(one: Any, other: Any) -> float:
    return max(float(jnp.max(jnp.abs(a - b))) for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True))


@pytest.mark.parametrize("algorithm", DELAYED, ids=lambda algorithm: algorithm.name)
def test_every_third_update_improves_the_actor_and_each_the_critics(algorithm):
    found = updates(algorithm, 6)
    for step in range(6):
        (before, _), (after, metrics) = found[step], found[step + 1]
        assert differ(before.critics, after.critics)
        if step % 3 == 2:
            assert differ(before.actor, after.actor)
        else:
            assert_equal(improved(before), improved(after))
        if step < 2:
            assert metrics["entropy"] == metrics["actor_loss"] == 0.0
        elif step % 3 != 2:
            assert metrics["entropy"] == found[step][1]["entropy"] != 0.0


@pytest.mark.parametrize("algorithm", DELAYED, ids=lambda algorithm: algorithm.name)
def test_the_update_that_improves_is_that_of_an_actor_that_never_waits(algorithm):
    waited = updates(algorithm, 2)[-1][0]
    after, metrics = update(algorithm, waited, 2)
    never, told = update(replace(algorithm, policy_delay=1), waited._replace(actor_metrics=None), 2)
    assert set(metrics) == set(told)
    close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)  # two programs: XLA may sum in another order
    jax.tree.map(close, (after._replace(actor_metrics=None), metrics), (never, told))


def test_the_previous_actor_is_the_one_before_the_actor_last_moved():
    found = updates(CSAC(policy_delay=3, reference_policy="previous", **SMALL), 7)
    assert_equal(found[7][0].reference, found[5][0].actor)
    assert differ(found[7][0].reference, found[6][0].actor)


def test_periodic_references_are_renewed_while_the_actor_waits():
    found = updates(CSAC(policy_delay=3, reference_policy="periodic", reference_period=4, **SMALL), 5)
    assert differ(found[4][0].reference, found[4][0].actor)
    assert_equal(found[5][0].reference, found[3][0].actor)  # update 4 begins a period, and waits


def test_a_refresh_comes_to_what_the_last_movement_in_its_period_measures():
    algorithm = CSAC(
        policy_delay=3,
        reference_policy="periodic",
        reference_period=8,
        relative_entropy_weight="auto",
        relative_entropy_estimator="closed_form",
        **SMALL,
    )
    found = [metrics for _, metrics in updates(algorithm, 15)[1:]]
    # Periods end after updates 7 and 15; the actor moves at 2, 5, 8, 11 and 14.
    refreshes = [float(metrics["relative_entropy_per_refresh"]) for metrics in found]
    assert refreshes[:5] == [0.0] * 5
    assert refreshes[5:14] == [float(found[5]["relative_entropy"])] * 9
    assert refreshes[14] == float(found[14]["relative_entropy"])
    assert 0.0 < refreshes[5] != refreshes[14] > 0.0


def test_references_that_a_waiting_actor_would_take_the_place_of():
    options: list[tuple[dict[str, Any], int]] = [
        ({"critic_reference": "earlier", "reference_policy": "algorithm1"}, 2),
        ({"critic_reference": "earlier", "reference_policy": "periodic", "reference_period": 2}, 3),
        ({"relative_entropy_weight": "auto", "reference_policy": "periodic", "reference_period": 5}, 6),
    ]
    for option, least in options:
        kept = option.get("reference_period", 1)
        with pytest.raises(InputError, match=f"kept for at least {least} updates, not {kept}: an actor that waits"):
            CSAC(policy_delay=kept + 1 if least < 6 else 3, **option)
    CSAC(policy_delay=3, reference_policy="periodic", relative_entropy_weight="auto", reference_period=6)
    CSAC(policy_delay=3, reference_policy="periodic", critic_reference="earlier", reference_period=3)


def test_adam_by_hand():
    # Gradients 1 and 3 with β₁ = 0.5, β₂ = 0.999: corrected means 1 and (0.5·0.5·1 + 0.5·3)/0.75 = 7/3, corrected
    # squares 1 and (0.999·1 + 9)/1.999. Steps of 0.1: 1/√1, then (7/3)/√5.002001.
    optimiser, parameter = make_optimiser(0.1, momentum=0.5), jnp.zeros(())
    state, steps = init_optimiser(optimiser, parameter), []
    for gradient in (1.0, 3.0):
        step, state = optimiser.update(jnp.float32(gradient), state, parameter)
        steps.append(np.asarray(step).item())
    assert steps == pytest.approx([-0.1, -0.1 * (7 / 3) / 5.002001**0.5], rel=1e-5)


@pytest.mark.parametrize("algorithm", [CSAC, SAC, TD3], ids=lambda algorithm: algorithm.name)
def test_momentum_reaches_actor_and_critics(algorithm):
    fast: dict[str, Any] = {"actor_learning_rate": 0.1, "critic_learning_rate": 0.1, "policy_delay": 1}
    plain, slow = (algorithm(adam_momentum=beta, **SMALL, **fast) for beta in (0.9, 0.5))
    (_, (one, _), (two, _)), (_, (first, _), (second, _)) = updates(plain, 2), updates(slow, 2)
    for name in ("actor", "critics"):
        assert distance(getattr(one, name), getattr(first, name)) < 1e-6  # Adam's first step knows one gradient
        assert distance(getattr(two, name), getattr(second, name)) > 1e-4
    with pytest.raises(InputError, match="adam_momentum must be at least 0 and less than 1"):
        algorithm(adam_momentum=1.0)
