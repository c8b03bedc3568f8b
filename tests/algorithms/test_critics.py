"""Critics whose layers are normalised over the batch: against numbers worked by hand, and against plain arrays."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import SPEC, begin, transitions, update

from csac.algorithms import CSAC, SAC, TD3
from csac.algorithms.critics import (
    Critics,
    min_q,
    normalised_critic_loss,
    q_value,
    q_values,
)
from csac.algorithms.distributions import policy_at
from csac.algorithms.networks import BATCH, make_mlp
from csac.algorithms.normalisation import EPSILON, Moments, fold, fold_layer, moments_of, normalised_pass
from csac.types import Layer, Transition

SMALL: dict[str, Any] = {"actor_hidden_sizes": (5,), "critic_hidden_sizes": (8, 8), "batch_size": 16}
NORMALISED = [
    CSAC(critic_normalisation="batch", **SMALL),
    SAC(critic_normalisation="batch", **SMALL),
    TD3(critic_normalisation="batch", policy_delay=1, **SMALL),
]
NAMES = [algorithm.name for algorithm in NORMALISED]
NOISE = jnp.asarray(np.random.default_rng(4).normal(size=(16, 2)), jnp.float32)


FAR = transitions(16, shift=3.0, scale=2.0)


def two_critics() -> Critics:
    first, second = jax.random.split(jax.random.key(0))
    inputs = SPEC.observation_size + SPEC.action_size
    return make_mlp(first, inputs, (8, 8), 1), make_mlp(second, inputs, (8, 8), 1)


def test_the_moments_are_those_of_all_inputs_of_all_examples():
    # 1, 3, 5, 7: mean 4, variance (9 + 1 + 1 + 9) / 4; the first two belong to one example, the others to the next.
    values = [jnp.array([[1.0], [5.0]]), jnp.array([[3.0], [7.0]])]
    moments = jax.vmap(moments_of, axis_name=BATCH)(values)
    np.testing.assert_allclose(moments.mean, [[4.0], [4.0]])
    np.testing.assert_allclose(moments.variance, [[5.0], [5.0]])
    # About zero: (1 + 9 + 25 + 49) / 4
    moments = jax.vmap(partial(moments_of, centred=False), axis_name=BATCH)(values)
    np.testing.assert_allclose(moments.mean, [[0.0], [0.0]])
    np.testing.assert_allclose(moments.variance, [[21.0], [21.0]])


def test_a_folded_layer_normalises_its_inputs():
    # Standard deviations 2 and 0.5: (6 - 4) / 2 · 2 + (1 - 2) / 0.5 · 3 + 1 = 2 - 6 + 1
    moments = Moments(jnp.array([4.0, 2.0]), jnp.array([4.0, 0.25]) - EPSILON)
    weight, bias, *_ = fold_layer(Layer(jnp.array([[2.0], [3.0]]), jnp.array([1.0])), moments)
    assert float((jnp.array([6.0, 1.0]) @ weight + bias)[0]) == pytest.approx(-3.0)


def test_a_unit_that_is_silent_in_the_batch_is_not_blown_up():
    weight, *_ = fold_layer(Layer(jnp.ones((1, 1)), jnp.zeros(1)), Moments(jnp.zeros(1), jnp.zeros(1)))
    assert float(weight[0, 0]) == pytest.approx(1 / math.sqrt(1e-3))


def normalised_values(critic: Any, inputs: Any) -> Any:
    """What one critic says of inputs [example, in], each layer's at mean 0, but for the last's, and mean square 1."""
    for weight, bias, *_ in critic.layers[:-1]:
        inputs = inputs - inputs.mean(0, keepdims=True)
        inputs = inputs / jnp.sqrt((inputs**2).mean(0, keepdims=True) + EPSILON)
        inputs = jnp.maximum(inputs @ weight + bias[None], 0.0)
    weight, bias, *_ = critic.layers[-1]
    return (inputs / jnp.sqrt((inputs**2).mean(0, keepdims=True) + EPSILON) @ weight + bias[None])[:, 0]


def pairs_of(batch: Transition, next_actions: Any) -> Any:
    """Both kinds of pairs, one below the other: what the critics are normalised over."""
    now = jnp.concatenate([batch.observation, batch.action], axis=1)
    return jnp.concatenate([now, jnp.concatenate([batch.next_observation, next_actions], axis=1)])


def test_a_network_with_the_moments_folded_in_says_what_the_normalised_one_does():
    (critic, _), batch = two_critics(), FAR
    inputs = pairs_of(batch, jnp.tanh(NOISE))
    passes = jax.jit(jax.vmap(partial(normalised_pass, critic), axis_name=BATCH))
    ours = passes([inputs[:16], inputs[16:]])
    moments, folded = jax.tree.map(lambda leaf: leaf[0], (ours.moments, ours.folded))
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5)
    close(jnp.concatenate(ours.outputs)[:, 0], normalised_values(critic, inputs))
    close(jax.vmap(folded)(inputs)[:, 0], normalised_values(critic, inputs))
    jax.tree.map(close, fold(critic, moments), folded)


def soft_target(transition: Transition, noise: Any, *, targets: Critics) -> Any:
    """A target that asks the critics at the next action."""
    values = q_values(targets, transition.next_observation, jnp.tanh(noise))
    return transition.reward + 0.9 * (1.0 - transition.terminated) * (jnp.minimum(*values) - noise.sum())


def next_action(observation: Any, noise: Any) -> Any:
    return jnp.tanh(noise)


def test_loss_and_gradient_are_those_of_one_pass_over_both_batches():
    critics, batch = two_critics(), FAR

    def ours(critics):
        loss = partial(normalised_critic_loss, critic_target=soft_target, next_action=next_action)
        losses, metrics = jax.vmap(loss, (None, 0, 0), axis_name=BATCH)(critics, batch, NOISE)
        return losses.mean(), metrics["q_mean"].mean()

    def theirs(critics):
        inputs = pairs_of(batch, jnp.tanh(NOISE))
        first, second = (normalised_values(critic, inputs) for critic in critics)
        future = jnp.minimum(first[16:], second[16:]) - NOISE.sum(1)
        target = jax.lax.stop_gradient(batch.reward + 0.9 * (1.0 - batch.terminated) * future)
        losses = (first[:16] - target) ** 2 + (second[:16] - target) ** 2
        return losses.mean(), (first[:16] + second[:16]).mean() / 2.0

    (our_loss, our_mean), our_gradient = jax.jit(jax.value_and_grad(ours, has_aux=True))(critics)
    (their_loss, their_mean), their_gradient = jax.jit(jax.value_and_grad(theirs, has_aux=True))(critics)
    np.testing.assert_allclose([our_loss, our_mean], [their_loss, their_mean], rtol=1e-5)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=2e-3, atol=2e-5), our_gradient, their_gradient)


def test_one_pass_gives_values_targets_and_moments():
    # In products of a hidden layer SAC needs 16 (benchmarks/products.py). Normalised critics need 2 + 2 forward and
    # twice as many backward, where plain ones with targets have 2 + 2 and 4: 20. Each further pass would cost 2 or 4.
    # XLA counts 23 in all: layers of other sizes and what is no product are 3.
    algorithm = SAC(actor_hidden_sizes=(256, 256), critic_hidden_sizes=(256, 256), critic_normalisation="batch")
    state = jax.eval_shape(lambda key: algorithm.init(key, SPEC, 1000), jax.random.key(0))
    counted: Any = jax.jit(algorithm.update).lower(state, FAR, jax.random.key(0), 0).compile().cost_analysis()
    assert 20 < counted["flops"] / (2 * 16 * 256 * 256) < 24


@pytest.mark.parametrize("algorithm", NORMALISED, ids=NAMES)
def test_actor_loss_is_of_the_updated_critics_by_the_moments_of_the_batch(algorithm):
    """With noise of its own for each transition, and for the actor another than for the critics' targets."""
    state, batch, key = begin(algorithm, SPEC), FAR, jax.random.key(7)
    after, metrics = update(algorithm, state, batch, 7)
    assert state.target_critics is after.target_critics is None
    noises = jax.random.normal(key, batch.action.shape if isinstance(algorithm, TD3) else (2, *batch.action.shape))
    noise, actor_noise = (noises, noises) if isinstance(algorithm, TD3) else noises

    def next_action(observation, noise):
        if isinstance(algorithm, TD3):
            return algorithm.smoothed_action(state.target_actor, observation, noise)
        return policy_at(state.actor, observation).sample(noise)

    def loss(critics, observation, noise):
        if isinstance(algorithm, TD3):
            return -q_value(critics[0], observation, jnp.tanh(state.actor(observation)))
        policy = policy_at(state.actor, observation)  # CSAC's reference as well, so far
        weight = 1.0 if isinstance(algorithm, SAC) else algorithm.entropy_weight
        return weight * policy.log_prob(noise) - min_q((critics[0], critics[1]), observation, policy.sample(noise))

    @jax.jit
    def mean_loss():
        inputs, critics = pairs_of(batch, jax.vmap(next_action)(batch.next_observation, noise)), []
        for old, new in zip(state.critics, after.critics, strict=True):
            passed = jax.vmap(partial(normalised_pass, old), axis_name=BATCH)([inputs[:16], inputs[16:]])
            critics.append(fold(new, jax.tree.map(lambda leaf: leaf[0], passed.moments)))
        return jax.vmap(partial(loss, critics))(batch.observation, actor_noise).mean()

    expected = mean_loss()
    np.testing.assert_allclose(metrics["actor_loss"], expected, rtol=1e-4, atol=1e-5)


def test_normalised_critics_have_the_initial_weights_of_plain_ones():
    plain = begin(SAC(**SMALL), SPEC)
    jax.tree.map(np.testing.assert_array_equal, plain.critics, begin(NORMALISED[1], SPEC).critics)
    assert plain.target_critics is not None


def test_seeds_side_by_side_are_normalised_apart():
    algorithm = NORMALISED[2]
    states = [begin(algorithm, SPEC), update(algorithm, begin(algorithm, SPEC), FAR, 1)[0]]
    batches = [FAR, transitions(16, 2, shift=15.0, scale=10.0)]
    together = jax.jit(jax.vmap(partial(update, algorithm)))
    _, metrics = together(*(jax.tree.map(lambda *x: jnp.stack(x), *both) for both in (states, batches)))
    for seed in (0, 1):
        _, alone = update(algorithm, states[seed], batches[seed])
        for name, value in alone.items():
            np.testing.assert_allclose(metrics[name][seed], value, rtol=1e-4, atol=1e-5)
