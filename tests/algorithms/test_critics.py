"""Critics whose layers are normalised over the batch: against numbers worked by hand, and against plain arrays."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import SPEC, assert_close, batch_of, begin, linear, transition, transitions, update

from csac.algorithms import CSAC, SAC, TD3
from csac.algorithms.critics import (
    Critics,
    min_q,
    normalised_critic_loss,
    q_value,
    q_values,
    update_critics,
)
from csac.algorithms.distributions import policy_at
from csac.algorithms.networks import BATCH, init_optimiser, make_mlp, make_optimiser
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
    moments = jax.vmap(moments_of, axis_name=BATCH)([jnp.array([[1.0], [5.0]]), jnp.array([[3.0], [7.0]])])
    np.testing.assert_allclose(moments.mean, [[4.0], [4.0]])
    np.testing.assert_allclose(moments.variance, [[5.0], [5.0]])


def test_moments_about_zero():
    # 1, 3, 5, 7: (1 + 9 + 25 + 49) / 4
    values = [jnp.array([[1.0], [5.0]]), jnp.array([[3.0], [7.0]])]
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
    ours = jax.vmap(partial(normalised_pass, critic), axis_name=BATCH)([inputs[:16], inputs[16:]])
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

    (our_loss, our_mean), our_gradient = jax.value_and_grad(ours, has_aux=True)(critics)
    (their_loss, their_mean), their_gradient = jax.value_and_grad(theirs, has_aux=True)(critics)
    np.testing.assert_allclose([our_loss, our_mean], [their_loss, their_mean], rtol=1e-5)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=2e-3, atol=2e-5), our_gradient, their_gradient)


class Learning(NamedTuple):
    critics: Critics
    target_critics: Critics | None
    critic_optimiser: Any


def test_the_critics_of_the_actors_loss_are_the_new_ones_by_the_moments_of_the_step():
    optimiser, batch = make_optimiser(0.1), FAR
    critics = two_critics()
    state = Learning(critics, None, init_optimiser(optimiser, critics))
    learnt, folded, metrics = update_critics(optimiser, state, batch, NOISE, soft_target, next_action)
    assert set(metrics) == {"critic_loss", "q_mean"}

    inputs = pairs_of(batch, jnp.tanh(NOISE))
    for old, new, plain in zip(critics, learnt.critics, folded, strict=True):
        seen = jax.vmap(partial(normalised_pass, old), axis_name=BATCH)([inputs[:16], inputs[16:]])
        expected = fold(new, jax.tree.map(lambda leaf: leaf[0], seen.moments))
        assert_close(plain, expected)
        assert not np.allclose(new.layers[1].weight, old.layers[1].weight)


def products(**changes: Any) -> float:
    """Operations of one compiled update of SAC, as XLA counts them: nearly all of them are matrix products."""
    algorithm = SAC(actor_hidden_sizes=(64, 64), critic_hidden_sizes=(64, 64), **changes)
    state, batch = begin(algorithm, SPEC), FAR
    counted: Any = jax.jit(algorithm.update).lower(state, batch, jax.random.key(0), 0).compile().cost_analysis()
    return counted["flops"]


def test_one_pass_gives_values_targets_and_moments():
    # In products of a hidden layer SAC needs 16 (benchmarks/products.py). Normalised critics need 2 + 2 forward and
    # twice as many backward, where plain ones with targets have 2 + 2 and 4: 20. Each further pass would cost 2 or 4.
    assert 1.2 < products(critic_normalisation="batch") / products() < 1.4


@pytest.mark.parametrize("algorithm", NORMALISED, ids=NAMES)
def test_an_actor_climbs_the_new_critics_by_the_moments_of_the_step(algorithm):
    state, batch, key = begin(algorithm, SPEC), FAR, jax.random.key(7)
    after, metrics = update(algorithm, state, batch, 7)
    noises = jax.random.normal(key, batch.action.shape if isinstance(algorithm, TD3) else (2, *batch.action.shape))
    noise, actor_noise = (noises, noises) if isinstance(algorithm, TD3) else noises

    def next_action(observation, noise):
        if isinstance(algorithm, TD3):
            return algorithm.smoothed_action(state.target_actor, observation, noise)
        return policy_at(state.actor, observation).sample(noise)

    next_actions = jax.vmap(next_action)(batch.next_observation, noise)
    inputs = pairs_of(batch, next_actions)
    critics = []
    for old, new in zip(state.critics, after.critics, strict=True):
        passed = jax.vmap(partial(normalised_pass, old), axis_name=BATCH)([inputs[:16], inputs[16:]])
        critics.append(fold(new, jax.tree.map(lambda leaf: leaf[0], passed.moments)))

    def loss(observation, noise):
        if isinstance(algorithm, TD3):
            return -q_value(critics[0], observation, jnp.tanh(state.actor(observation)))
        policy = policy_at(state.actor, observation)  # CSAC's reference as well, so far
        weight = 1.0 if isinstance(algorithm, SAC) else algorithm.entropy_weight
        return weight * policy.log_prob(noise) - min_q((critics[0], critics[1]), observation, policy.sample(noise))

    expected = jax.vmap(loss)(batch.observation, actor_noise).mean()
    np.testing.assert_allclose(metrics["actor_loss"], expected, rtol=1e-4, atol=1e-5)


def test_a_linear_critic_by_hand():
    # The target actor's action is 0, without noise, and the actor's is another. Pairs (s, a): (1, 0.5), (3, -0.5) and
    # next (1, 0), (3, 0). Of a last layer's inputs only the scale is normalised: their mean squares are 5 and 0.125.
    # With Q = 2 ŝ + â - 1 for both critics, ŝ = s / √5 and â = a / √0.125: Q = 1.308641 and 0.269067; Q' = -0.105573
    # at (1, 0). Targets with γ = 0.5: 1.947214 and 2 (terminal). Losses 2 (0.638572² + 1.730933²) / 2 = 3.403903, mean
    # of Q 0.788854.
    critic = linear([[2.0], [1.0]], [-1.0])
    algorithm = TD3(
        critic_normalisation="batch", target_noise=0.0, discount=0.5, actor_hidden_sizes=(), critic_hidden_sizes=()
    )
    still = linear([[0.0]], [0.0])
    state = begin(algorithm)
    state = state._replace(critics=(critic, critic), actor=linear([[0.0]], [1.0]), target_actor=still)
    batch = batch_of(
        transition(observation=1.0, action=0.5, next_observation=1.0),
        transition(observation=3.0, action=-0.5, next_observation=3.0, terminated=1.0),
    )
    _, metrics = update(algorithm, state, batch)
    assert float(metrics["q_mean"]) == pytest.approx(0.788854, rel=1e-2)
    assert float(metrics["critic_loss"]) == pytest.approx(3.403903, rel=1e-2)  # ε is 1 % of the smaller variance


@pytest.mark.parametrize("algorithm", NORMALISED, ids=NAMES)
def test_normalised_critics_have_no_targets_and_keep_no_statistics(algorithm):
    state = begin(algorithm, SPEC)
    assert state.target_critics is None
    state, metrics = update(algorithm, state, FAR)
    assert state.target_critics is None
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, metrics)))
    plain = type(algorithm)(**{**vars(algorithm), "critic_normalisation": "none"}).init(jax.random.key(0), SPEC, 100)
    jax.tree.map(np.testing.assert_array_equal, plain.critics, begin(algorithm, SPEC).critics)
    assert plain.target_critics is not None


def test_seeds_side_by_side_are_normalised_apart():
    algorithm = NORMALISED[0]
    states = [begin(algorithm, SPEC), update(algorithm, begin(algorithm, SPEC), FAR, 1)[0]]
    batches = [FAR, transitions(16, 2, shift=15.0, scale=10.0)]
    together = jax.jit(jax.vmap(partial(update, algorithm)))
    _, metrics = together(*(jax.tree.map(lambda *x: jnp.stack(x), *both) for both in (states, batches)))
    for seed in (0, 1):
        _, alone = update(algorithm, states[seed], batches[seed])
        for name, value in alone.items():
            np.testing.assert_allclose(metrics[name][seed], value, rtol=1e-4, atol=1e-5)
