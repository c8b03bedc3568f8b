"""Each network descends by its own optimiser, with the hyperparameters that are its own, from weights of known size."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
from equations import update

from csac.algorithms import CSAC, SAC, SD3, TD3
from csac.algorithms.networks import make_mlp
from csac.types import Spec, Transition

SMALL: dict[str, Any] = {"actor_hidden_sizes": (8,), "critic_hidden_sizes": (8,), "batch_size": 16}
ALGORITHMS = {
    "csac": CSAC(**SMALL),
    "sac": SAC(**SMALL),
    "sac, normalised critics": SAC(critic_normalisation="batch", **SMALL),
    "td3": TD3(**SMALL),
    "sd3": SD3(noise_samples=3, **{**SMALL, "batch_size": 8}),  # a mini-batch for each of its pairs
}
NAMES = ("actor", "critics")
STILL = 1e-20  # a learning rate, or a bound on a gradient, by which no parameter of 32 bits moves
each = pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)


def after_updates(algorithm: Any, count: int = 4) -> dict[str, list[Any]]:
    """The networks before and after a few updates; SD3 has two of each."""
    keys = jax.random.split(jax.random.key(1), 4)
    states, actions = jax.random.normal(keys[0], (2, 16, 3)), jax.random.uniform(keys[1], (16, 2), minval=-1.0)
    batch = Transition(states[0], actions, jax.random.normal(keys[2], (16,)), states[1], np.zeros(16), np.zeros(16))
    state = algorithm.init(jax.random.key(0), Spec(3, 2), 100)
    found: dict[str, list[Any]] = {"actor": [], "critics": []}
    for step in range(count + 1):
        if step in (0, count):
            pairs = [state] if hasattr(state, "actor") else [state.first, state.second]
            found["actor"].append([pair.actor for pair in pairs])
            found["critics"].append([getattr(pair, "critics", getattr(pair, "critic", None)) for pair in pairs])
        state, _ = update(algorithm, state, batch, step)
    return found


def moved(before: Any, after: Any) -> set[bool]:
    """Whether each network has moved."""
    return {
        any(not np.array_equal(*pair) for pair in zip(*map(jax.tree.leaves, networks), strict=True))
        for networks in zip(before, after, strict=True)
    }


@each
def test_every_network_moves(algorithm):
    networks = after_updates(algorithm)
    assert {name: moved(*networks[name]) for name in NAMES} == {"actor": {True}, "critics": {True}}


@each
@pytest.mark.parametrize(("rate", "stays", "moves"), [("actor", *NAMES), ("critic", *reversed(NAMES))])
def test_a_learning_rate_is_that_of_its_network_alone(algorithm, rate, stays, moves):
    networks = after_updates(replace(algorithm, **{f"{rate}_learning_rate": STILL}))
    assert (moved(*networks[stays]), moved(*networks[moves])) == ({False}, {True})


@each
def test_a_bound_on_gradients_is_that_of_both_networks(algorithm):
    networks = after_updates(replace(algorithm, max_gradient_norm=STILL))  # far below Adam's epsilon
    assert (moved(*networks["actor"]), moved(*networks["critics"])) == ({False}, {False})


def test_the_first_weights_and_biases_fill_the_range_of_their_inputs():
    for layer, inputs in zip(make_mlp(jax.random.key(0), 16, (400, 900), 40).layers, (16, 400, 900), strict=True):
        largest = max(float(np.abs(layer.weight).max()), float(np.abs(layer.bias).max()))
        assert 0.99 / inputs**0.5 < largest <= 1 / inputs**0.5
        assert float(np.std(layer.weight)) == pytest.approx(1 / (3 * inputs) ** 0.5, rel=0.02)  # of a uniform number
