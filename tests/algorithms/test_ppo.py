"""PPO's equations against numbers worked by hand, and its update against a slow one in plain NumPy."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from csac.algorithms import PPO
from csac.algorithms.ppo import Sample, State, policy_at
from csac.algorithms.returns import advantages_of, discounted_returns, explained_variance
from csac.algorithms.statistics import Statistics
from csac.types import Normaliser, Spec, Transition

if TYPE_CHECKING:
    from collections.abc import Iterable

SMALL = PPO(discount=0.5, rollout_steps=8, minibatches=2, epochs=2, hidden_sizes=(4,))
SWITCHED_OFF = {"normalise_observations": False, "normalise_rewards": False, "normalise_advantages": False}
PLAIN = replace(SMALL, minibatches=1, epochs=1, max_gradient_norm=0.0, adam_epsilon=1e-12, **SWITCHED_OFF)

# Compiling takes longer than running: no optimisation.
compiled = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def rollout(rewards, terminated=(), truncated=()) -> Transition:
    """A rollout with observations and actions at random, and 1 in the flags at the steps named."""
    steps, generator = len(rewards), np.random.default_rng(0)
    flags = [np.isin(np.arange(steps), list(which)).astype(np.float32) for which in (terminated, truncated)]
    observations = generator.normal(2.0, 3.0, (2, steps, 2)).astype(np.float32)
    actions = generator.normal(size=(steps, 1)).astype(np.float32)
    return Transition(observations[0], actions, np.array(rewards, np.float32), observations[1], *flags)


@partial(compiled, static_argnums=0)
def update(algorithm: PPO, state: State, batch: Transition, step: int = 0, seed: int = 0):
    return algorithm.update(state, batch, jax.random.key(seed), jnp.int32(step))


@partial(compiled, static_argnums=(0, 1))
def begin(algorithm: PPO, steps: int = 83) -> State:
    return algorithm.init(jax.random.key(7), Spec(2, 1), steps)


# Advantages.
# γ = λ = 1/2. Step 1 was truncated, step 2 terminated, and the rollout is cut after step 4, in mid-episode.
# δ = 1 + 0.5·0.5 - 1 = 0.25 | 2 + 0.5·8 - 0.5 = 5.5 | 3 - 2 = 1 | 4 + 0.5·4 - 1 = 5 | 5 + 0.5·6 - 4 = 4
# A₄ = 4; A₃ = 5 + 0.25·4 = 6; A₂ = 1; A₁ = 5.5; A₀ = 0.25 + 0.25·5.5 = 1.625
EPISODES = rollout([1, 2, 3, 4, 5], terminated=[2], truncated=[1])
VALUES, NEXT_VALUES = jnp.array([1, 0.5, 2, 1, 4]), jnp.array([0.5, 8, 100, 4, 6])


def test_advantages():
    # With λ = 0, one-step errors. With λ = 1, returns less the value, to the end of the episode or of the rollout,
    # whichever is first, with what follows valued unless it terminated:
    # 1 + 0.5·2 + 0.25·8 = 4 | 2 + 0.5·8 = 6 | 3 | 4 + 0.5·5 + 0.25·6 = 8 | 5 + 0.5·6 = 8; less 1, 0.5, 2, 1, 4
    for trace, expected in ((0.5, [1.625, 5.5, 1, 6, 4]), (0.0, [0.25, 5.5, 1, 5, 4]), (1.0, [3, 5.5, 1, 7, 4])):
        np.testing.assert_array_equal(advantages_of(EPISODES, VALUES, NEXT_VALUES, 0.5, trace), expected)


# Losses; those of the policy are compared with slow ones below.


@pytest.mark.parametrize(
    ("value", "old_value", "target", "clipped", "plain"),
    [
        (1.5, 1.0, 2.0, 0.32, 0.125),  # (1.2 - 2)² = 0.64 is more than (1.5 - 2)² = 0.25
        (1.5, 1.0, 1.0, 0.125, 0.125),  # (1.2 - 1)² = 0.04 is less
        (0.5, 1.0, 0.0, 0.32, 0.125),
        (1.1, 1.0, 2.0, 0.405, 0.405),  # within the range: 0.9² / 2
    ],
)
def test_value_loss(value, old_value, target, clipped, plain):
    assert float(PPO(clip_range=0.2).value_loss(value, old_value, target)) == pytest.approx(clipped)
    assert float(PPO(clip_value_loss=False).value_loss(value, old_value, target)) == pytest.approx(plain)


def test_the_loss_weighs_its_parts():
    algorithm = replace(PLAIN, value_loss_weight=0.25, entropy_weight=0.5, clip_range=0.2)
    parameters = begin(SMALL).parameters._replace(log_std=jnp.array([0.5]))
    sample = Sample(jnp.ones(2), jnp.array([0.3]), *(jnp.float32(x) for x in (-2.0, 0.5, 1.5, 3.0)))
    loss, metrics = algorithm.loss(parameters, sample)
    # Entropy of N(·, e^0.5²): 0.5 + log(2πe) / 2 = 1.9189385
    assert float(metrics["entropy"]) == pytest.approx(1.9189385, abs=1e-6)
    weighted = metrics["actor_loss"] + 0.25 * metrics["critic_loss"] - 0.5 * 1.9189385
    assert float(loss) == pytest.approx(float(weighted), abs=1e-6)
    log_ratio = float(policy_at(parameters, sample.observation).log_prob(sample.action)) + 2.0
    assert float(metrics["approximate_kl"]) == pytest.approx(math.exp(log_ratio) - 1 - log_ratio, rel=1e-5)
    assert bool(metrics["clip_fraction"]) == (abs(math.exp(log_ratio) - 1) > 0.2)


def test_explained_variance():
    # Var[3, 1, 2] = 2/3; the errors 1, 0, -1 have as much, 0.5, 0.5, 0.5 have none.
    targets = jnp.array([3.0, 1.0, 2.0])
    assert float(explained_variance(jnp.array([2.0, 1.0, 3.0]), targets)) == pytest.approx(0.0, abs=1e-6)
    assert float(explained_variance(targets - 0.5, targets)) == pytest.approx(1.0)
    assert float(explained_variance(targets, jnp.ones(3))) == 0.0


# Statistics.


def test_statistics_are_those_of_everything_absorbed():
    generator = np.random.default_rng(1)
    values = generator.normal([0.0, 100.0, -3.0], [1.0, 0.1, 50.0], (300, 3)).astype(np.float32)
    statistics = Statistics.create((3,))
    for part in np.split(values, [7, 8, 150]):
        statistics = statistics.absorb(jnp.array(part))
    assert float(statistics.total) == 300
    np.testing.assert_allclose(statistics.mean, values.astype(float).mean(0), rtol=1e-5)
    np.testing.assert_allclose(statistics.variance, values.astype(float).var(0), rtol=1e-4)
    np.testing.assert_allclose(statistics.std**2, statistics.variance + 1e-8, rtol=1e-5)


def test_statistics_of_very_long_runs_stay_those_of_the_values():
    statistics = Statistics(jnp.float32(2**24), jnp.zeros(()), jnp.ones(()), jnp.ones(()))
    for value in (1.0, -1.0) * 200:
        statistics = statistics.absorb(jnp.array([value]))
    assert float(statistics.total) == 1e6
    np.testing.assert_allclose(statistics.variance, 1.0, rtol=1e-4)


def test_what_never_varies_is_centred_and_stays_so():
    statistics = Statistics.create((4,))
    values = jnp.tile(jnp.array([0.1, -1234.567, 3e6, 0.0]), (77, 1))
    for _ in range(3):
        statistics = statistics.absorb(values)
    normalised = PPO(normalisation_limit=1e9).normalise(statistics, values[0])
    np.testing.assert_allclose(normalised[jnp.array([0, 3])], 0.0, atol=1e-3)
    # The spread that rounding leaves is as large as its error, where that is more than the root of 1e-8.
    assert (np.abs(normalised) < 2.0).all()
    np.testing.assert_array_equal(PPO().normalise(statistics, values[0] + 1.0), 10.0)


def test_observations_and_rewards_are_clipped_after_scaling():
    statistics = Statistics(jnp.ones(()), jnp.array([1.0, 1.0]), jnp.array([4.0, 4.0]), jnp.array([2.0, 2.0]))
    np.testing.assert_array_equal(PPO().normalise(statistics, jnp.array([4.0, -99.0])), [1.5, -10.0])
    algorithm, returns = PPO(normalisation_limit=3.0), Statistics(*jnp.array([9.0, 5.0, 16.0, 4.0]))
    np.testing.assert_array_equal(algorithm.scale(returns, jnp.array([2.0, -8.0, 99.0])), [0.5, -2.0, 3.0])
    assert float(replace(algorithm, normalise_rewards=False).scale(returns, jnp.float32(99.0))) == 99.0


def test_discounted_returns_start_anew_after_an_end_and_go_on_after_a_rollout():
    # γ = 1/2: 1 | 2 + 0.5 = 2.5 | 3 + 1.25 = 4.25, terminated | 4 and 2 + 0.5·4 = 4 | 1 + 2 = 3, truncated | 6 | 0 + 3
    returns, last = discounted_returns(jnp.zeros(()), rollout([1, 2, 3, 4], terminated=[2]), 0.5)
    np.testing.assert_array_equal(returns, [1, 2.5, 4.25, 4])
    returns, last = discounted_returns(last, rollout([2, 1, 6, 0], truncated=[1]), 0.5)
    np.testing.assert_array_equal(returns, [4, 3, 6, 3])
    assert float(last) == 3.0
    for ends in ({"terminated": [3]}, {"truncated": [3]}):
        assert float(discounted_returns(last, rollout([2, 1, 6, 0], **ends), 0.5)[1]) == 0.0


def test_statistics_move_once_in_an_update_and_the_policy_takes_them_along():
    batch = rollout(range(8))
    state = begin(SMALL)
    before = SMALL.policy(state).parameters.normaliser
    state, _ = update(SMALL, state, batch)
    after = SMALL.policy(state).parameters.normaliser
    assert isinstance(before, Normaliser)
    assert isinstance(after, Normaliser)
    np.testing.assert_array_equal((*before.mean, *before.std, before.limit), [0, 0, 1, 1, 10])
    np.testing.assert_allclose(after.mean, batch.observation.mean(0), rtol=1e-5)
    np.testing.assert_allclose(after.std, batch.observation.std(0), rtol=1e-5)
    assert SMALL.policy(state).head == "clipped_gaussian"
    assert SMALL.policy(state).activation == "tanh"
    assert PLAIN.policy(state).parameters.normaliser is None


# Learning.


def test_linear_learning_rate():
    # 83 steps are 10 rollouts of 8 and some more: the last update has a tenth of the first one's learning rate.
    state = begin(SMALL, steps=83)
    rates = [float(SMALL.learning_rate_at(jnp.int32(k), state.total_updates)) for k in (0, 5, 9)]
    assert rates == pytest.approx([3e-4, 1.5e-4, 3e-5], rel=1e-6)
    assert float(update(SMALL, state, rollout(range(8)), 5)[1]["learning_rate"]) == pytest.approx(1.5e-4)
    constant = replace(SMALL, learning_rate_schedule="constant")
    assert float(constant.learning_rate_at(jnp.int32(9), state.total_updates)) == pytest.approx(3e-4)
    assert float(begin(SMALL, 3).total_updates) == 1.0  # a run shorter than a rollout
    assert (SMALL.cadence.has_schedule, constant.cadence.has_schedule) == (True, False)


def test_the_first_minibatch_sees_the_policy_that_acted():
    state, batch = begin(PLAIN), rollout(range(8), terminated=[3])
    samples = compiled(PLAIN.samples)(state, state, batch)
    _, metrics = update(PLAIN, state, batch)
    assert float(metrics["approximate_kl"]) == pytest.approx(0.0, abs=1e-6)
    assert float(metrics["clip_fraction"]) == 0.0
    assert float(metrics["actor_loss"]) == pytest.approx(-float(samples.advantage.mean()), rel=1e-5)
    # ½ (V - (A + V))²
    assert float(metrics["critic_loss"]) == pytest.approx(0.5 * float((samples.advantage**2).mean()), rel=1e-5)


def test_shuffling_keeps_each_transition_once_and_whole():
    ids = jnp.arange(8.0)
    samples = Sample(jnp.stack([ids, -ids], axis=1), ids[:, None], ids, ids, ids, ids)
    shuffled = jax.tree.map(np.asarray, compiled(SMALL.shuffled)(samples, jax.random.key(0)))
    assert shuffled.observation.shape == (2, 4, 2)
    np.testing.assert_array_equal(np.sort(shuffled.value.ravel()), ids)
    for field in (
        shuffled.observation[..., 0],
        -shuffled.observation[..., 1],
        shuffled.action[..., 0],
        shuffled.target,
    ):
        np.testing.assert_array_equal(field, shuffled.value)


def test_actions_are_unclipped_samples_or_the_clipped_mean():
    state = begin(SMALL)
    actor = jax.tree.map(lambda leaf: leaf * 0.0, state.parameters.actor)
    last = actor.layers[-1]._replace(bias=jnp.array([0.9]))
    actor = replace(actor, layers=(*actor.layers[:-1], last))
    state = state._replace(parameters=state.parameters._replace(actor=actor, log_std=jnp.log(jnp.array([0.5]))))
    act = compiled(jax.vmap(partial(SMALL.act, explore=True), in_axes=(None, None, 0)))
    samples = act(state, jnp.ones(2), jax.random.split(jax.random.key(0), 4000))
    assert samples.mean() == pytest.approx(0.9, abs=0.04)  # standard error 0.008
    assert samples.std() == pytest.approx(0.5, abs=0.03)
    assert samples.max() > 1.5
    beyond = replace(actor, layers=(*actor.layers[:-1], last._replace(bias=jnp.array([1.7]))))
    for mean, expected in ((actor, 0.9), (beyond, 1.0)):
        state = state._replace(parameters=state.parameters._replace(actor=mean))
        assert float(SMALL.act(state, jnp.ones(2), jax.random.key(0), explore=False)[0]) == pytest.approx(expected)


@pytest.fixture(scope="module")
def first_state() -> State:
    return PPO().init(jax.random.key(0), Spec(17, 6), 10_000)


def test_the_networks_begin_orthogonal_and_the_policy_nearly_the_same_everywhere(first_state):
    parameters = first_state.parameters
    for network, gain in ((parameters.actor, 0.01), (parameters.critic, 1.0)):
        first, hidden, last = (np.asarray(layer.weight) for layer in network.layers)
        np.testing.assert_allclose(first @ first.T, 2 * np.eye(17), atol=1e-5)
        np.testing.assert_allclose(hidden @ hidden.T, 2 * np.eye(64), atol=1e-5)
        np.testing.assert_allclose(last.T @ last, gain**2 * np.eye(last.shape[1]), atol=1e-5)
        assert not any(np.any(layer.bias) for layer in network.layers)
    assert not np.any(parameters.log_std)


def test_no_two_parts_of_the_first_state_share_a_buffer(first_state):
    pointers = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(first_state)]
    assert len(set(pointers)) == len(pointers)


# A whole update, another way: Python's loops, 64 bits, gradients by differences, Adam written out.


class Slow:
    """PPO for one hidden layer. All parameters are one vector."""

    def __init__(self, algorithm: PPO, state: State, total_updates: int) -> None:
        self.algorithm, self.total_updates = algorithm, total_updates
        self.leaves, self.structure = jax.tree.flatten(state.parameters)
        self.parameters = np.concatenate([np.ravel(leaf).astype(float) for leaf in self.leaves])
        self.moments = np.zeros((2, self.parameters.size))
        self.descents = 0
        self.observations: list[np.ndarray] = []
        self.returns: list[float] = []
        self.running = 0.0

    def outputs(self, parameters: np.ndarray, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means [n, 1], values [n], log standard deviation [1]."""
        ends = np.cumsum([leaf.size for leaf in self.leaves])[:-1]
        arrays = [part.reshape(leaf.shape) for part, leaf in zip(np.split(parameters, ends), self.leaves, strict=True)]
        actor, critic, log_std = jax.tree.unflatten(self.structure, arrays)
        (first, second), (third, fourth) = actor.layers, critic.layers
        means = np.tanh(observations @ first.weight + first.bias) @ second.weight + second.bias
        values = np.tanh(observations @ third.weight + third.bias) @ fourth.weight + fourth.bias
        return means, values[:, 0], log_std

    def normalised(self, observations: np.ndarray) -> np.ndarray:
        if not self.observations:
            return observations.astype(float)
        seen = np.concatenate(self.observations).astype(float)
        return np.clip((observations - seen.mean(0)) / np.sqrt(seen.var(0) + 1e-8), -10, 10)

    def log_probs(self, parameters: np.ndarray, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        means, _, log_std = self.outputs(parameters, observations)
        return scipy.stats.norm.logpdf(actions, means, np.exp(log_std)).sum(axis=1)

    def update(self, batch: Transition, step: int, minibatches: Iterable[np.ndarray]) -> None:
        """Learn from the parts of the rollout that have these indices, one after the other."""
        algorithm = self.algorithm
        old_log_probs = self.log_probs(self.parameters, self.normalised(batch.observation), batch.action)
        self.observations.append(batch.observation)
        ended = (batch.terminated + batch.truncated) > 0
        for reward, end in zip(batch.reward.tolist(), ended, strict=True):
            self.running = algorithm.discount * self.running + reward
            self.returns.append(self.running)
            self.running = 0.0 if end else self.running
        rewards = np.clip(batch.reward / np.sqrt(np.var(self.returns) + 1e-8), -10, 10)

        observations = self.normalised(batch.observation)
        old_values = self.outputs(self.parameters, observations)[1]
        next_values = self.outputs(self.parameters, self.normalised(batch.next_observation))[1]
        advantages, advantage = np.zeros(len(rewards)), 0.0
        for t in reversed(range(len(rewards))):
            follows = 0.0 if batch.terminated[t] else next_values[t]
            trace = 0.0 if ended[t] else algorithm.discount * algorithm.trace_decay * advantage
            advantages[t] = advantage = rewards[t] + algorithm.discount * follows - old_values[t] + trace
        targets = advantages + old_values

        def loss(parameters: np.ndarray, part: np.ndarray) -> float:
            scaled = (advantages[part] - advantages[part].mean()) / (advantages[part].std() + 1e-8)
            ratios = np.exp(self.log_probs(parameters, observations[part], batch.action[part]) - old_log_probs[part])
            _, values, log_std = self.outputs(parameters, observations[part])
            low, high = 1 - algorithm.clip_range, 1 + algorithm.clip_range
            gains = np.minimum(ratios * scaled, np.clip(ratios, low, high) * scaled)
            moves = np.clip(values - old_values[part], -algorithm.clip_range, algorithm.clip_range)
            errors = np.maximum((values - targets[part]) ** 2, (old_values[part] + moves - targets[part]) ** 2)
            entropy = scipy.stats.norm.entropy(0, np.exp(log_std)).sum()
            weights = algorithm.value_loss_weight, algorithm.entropy_weight
            return -gains.mean() + weights[0] * errors.mean() / 2 - weights[1] * entropy

        for part in minibatches:
            self.descend(partial(loss, part=part), algorithm.learning_rate * (1 - step / self.total_updates))

    def descend(self, loss, learning_rate: float) -> None:
        small = 1e-6 * np.eye(self.parameters.size)
        gradient = np.array([(loss(self.parameters + d) - loss(self.parameters - d)) / 2e-6 for d in small])
        gradient *= min(1.0, self.algorithm.max_gradient_norm / np.linalg.norm(gradient))
        self.descents += 1
        self.moments[0] = 0.9 * self.moments[0] + 0.1 * gradient
        self.moments[1] = 0.999 * self.moments[1] + 0.001 * gradient**2
        first, second = self.moments[0] / (1 - 0.9**self.descents), self.moments[1] / (1 - 0.999**self.descents)
        self.parameters = self.parameters - learning_rate * first / (np.sqrt(second) + self.algorithm.adam_epsilon)


def test_an_update_agrees_with_a_slow_one():
    # Adam's epsilon is large, or its steps would not depend on the size of the gradient; the learning rate is large
    # and the range is narrow, so that ratios and values are clipped.
    algorithm = replace(
        SMALL,
        rollout_steps=16,
        minibatches=2,
        epochs=2,
        learning_rate=0.3,
        clip_range=0.05,
        entropy_weight=0.1,
        adam_epsilon=0.1,
        max_gradient_norm=0.3,
    )
    state = begin(SMALL)._replace(total_updates=jnp.float32(5))
    first = state.parameters.actor.layers[0].weight
    slow = Slow(algorithm, state, 5)
    indices: Any = jnp.arange(16)  # in place of samples
    order_of = compiled(jax.vmap(partial(algorithm.shuffled, indices)))
    for step in range(3):
        batch = rollout(np.sin(np.arange(16) * (step + 1)), terminated=[4 + step], truncated=[11])
        batch = batch._replace(observation=batch.observation * (step + 1) - step)
        orders = order_of(jax.random.split(jax.random.key(step), algorithm.epochs))
        assert not np.array_equal(orders[0], orders[1])
        state, metrics = update(algorithm, state, batch, step, seed=step)
        slow.update(batch, step, [part for epoch in np.asarray(orders) for part in epoch])
        assert metrics["clip_fraction"] > 0
        ours = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(state.parameters)])
        np.testing.assert_allclose(ours, slow.parameters, atol=1e-5)
    assert np.abs(state.parameters.actor.layers[0].weight - first).max() > 0.03
