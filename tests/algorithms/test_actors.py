"""Actors whose layers are normalised: against numbers worked by hand, plain arrays, and the plain MLP that they are."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from csac.algorithms import CSAC, SAC, TD3
from csac.algorithms.actors import begin_moments, learn_actor
from csac.algorithms.networks import MLP, begin_descent, make_mlp
from csac.algorithms.normalisation import EPSILON, Moments, fold
from csac.types import Layer, Spec, Transition

SMALL: dict[str, Any] = {"actor_hidden_sizes": (5,), "critic_hidden_sizes": (4,), "batch_size": 8}
NORMALISED = [
    CSAC(actor_normalisation="batch", reference_policy="previous", **SMALL),
    SAC(actor_normalisation="batch", normalise_observations=True, **SMALL),
    TD3(actor_normalisation="batch", policy_delay=1, **SMALL),
]
SPEC = Spec(3, 2)


def transitions(key: int) -> Transition:
    """Eight of them; their states lie far from zero."""
    keys = jax.random.split(jax.random.key(key), 4)
    states, actions = 3.0 + jax.random.normal(keys[0], (2, 8, 3)), jnp.tanh(jax.random.normal(keys[1], (8, 2)))
    return Transition(states[0], actions, jax.random.normal(keys[2], (8,)), states[1], jnp.zeros(8), jnp.zeros(8))


def test_one_step_of_a_linear_actor_by_hand():
    # Inputs 1 and 3, whose mean square is 5, are seen as 1/√5 and 3/√5: the mean output is 2 · 2/√5 + 1, its gradient
    # 2/√5 for the weight and 1 for the bias. The inputs of a last layer are not centred: their running mean stays 0.
    actor = MLP((Layer(jnp.array([[2.0]]), jnp.array([1.0])),))
    moments = (Moments(jnp.array([0.0]), jnp.array([1.0])),)
    optimiser = optax.sgd(0.5)

    def loss(actor: MLP, observation: Any) -> tuple[Any, Any]:
        return actor(observation)[0], {"output": actor(observation)[0]}

    observations = jnp.array([[1.0], [3.0]])
    learnt = learn_actor(optimiser, loss, actor, moments, begin_descent(optimiser, actor), observations)
    seen = 2.0 / (5.0 + EPSILON) ** 0.5
    assert float(learnt.metrics["output"]) == pytest.approx(2.0 * seen + 1.0)
    assert float(learnt.actor.layers[0].weight[0, 0]) == pytest.approx(2.0 - 0.5 * seen)
    assert float(learnt.actor.layers[0].bias[0]) == pytest.approx(1.0 - 0.5)
    assert learnt.moments is not None
    assert float(learnt.moments[0].mean[0]) == 0.0
    assert float(learnt.moments[0].variance[0]) == pytest.approx(1.0 + 0.01 * (5.0 - 1.0))


def test_gradients_pass_through_the_moments_of_the_batch():
    actor = make_mlp(jax.random.key(0), 3, (5,), 2)
    observations = transitions(0).observation
    optimiser = optax.sgd(1.0)

    def loss(actor: MLP, observation: Any) -> tuple[Any, Any]:
        return jnp.sum(jnp.sin(actor(observation))), {}

    def of_the_batch(actor: MLP) -> Any:
        (first, first_bias), (second, second_bias) = actor.layers
        inputs = observations - observations.mean(0, keepdims=True)
        inputs = inputs / jnp.sqrt((inputs**2).mean(0, keepdims=True) + EPSILON)
        hidden = jnp.maximum(inputs @ first + first_bias[None], 0.0)
        hidden = hidden / jnp.sqrt((hidden**2).mean(0, keepdims=True) + EPSILON)
        return jnp.sin(hidden @ second + second_bias[None]).sum(1).mean()

    moments = begin_moments(actor, "batch")
    learnt = learn_actor(optimiser, loss, actor, moments, begin_descent(optimiser, actor), observations)
    expected = jax.tree.map(lambda value, slope: value - slope, actor, jax.grad(of_the_batch)(actor))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), learnt.actor, expected)


@partial(jax.jit, static_argnums=0)
def update(algorithm: Any, state: Any, step: int) -> Any:
    return algorithm.update(state, transitions(step), jax.random.key(step), step)[0]


@pytest.mark.parametrize("algorithm", NORMALISED, ids=lambda algorithm: algorithm.name)
def test_whoever_asks_the_actor_gets_the_plain_network_that_its_running_moments_make_of_it(algorithm):
    begun = algorithm.init(jax.random.key(0), SPEC, 100)
    state = update(algorithm, update(algorithm, begun, 0), 1)
    plain = fold(state.actor, state.actor_moments)
    assert not np.allclose(plain.layers[0].bias, state.actor.layers[0].bias)

    # The policy that leaves, and acting: the plain network's.
    jax.tree.map(np.testing.assert_array_equal, algorithm.policy(state).parameters.actors[0], plain.layers)
    same = state._replace(actor=plain, actor_moments=None)
    other = replace(algorithm, actor_normalisation="none")
    acting = jnp.array([3.0, 2.0, 4.0]), jax.random.key(7)
    for explore in (True, False):
        np.testing.assert_array_equal(
            algorithm.act(state, *acting, explore=explore), other.act(same, *acting, explore=explore)
        )

    # The critics' targets, and the reference that is kept: those of one that was plain all along.
    after, plainly = update(algorithm, state, 2), update(other, same, 2)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), after.critics, plainly.critics)
    if isinstance(algorithm, CSAC):
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), after.reference, plain)
    if isinstance(algorithm, TD3):
        expected = jax.tree.map(
            lambda target, source: target + 0.005 * (source - target),
            state.target_actor,
            fold(after.actor, after.actor_moments),
        )
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), after.target_actor, expected)


def test_moments_follow_the_batches_only_when_the_actor_learns():
    algorithm = SAC(actor_normalisation="batch", policy_delay=2, **SMALL)
    states: list[Any] = [algorithm.init(jax.random.key(0), SPEC, 100)]
    for step in range(2):
        states.append(update(algorithm, states[-1], step))
    first, second, third = (state.actor_moments for state in states)
    jax.tree.map(np.testing.assert_array_equal, first, second)
    seen = transitions(1).observation
    np.testing.assert_allclose(third[0].mean, 0.01 * seen.mean(0), rtol=1e-5)
    np.testing.assert_allclose(third[0].variance, 0.99 + 0.01 * seen.var(0), rtol=1e-5)
