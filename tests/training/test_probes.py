"""Each algorithm, in the real loop, learns the values of tasks whose values are known (after Jones, "Debugging RL")."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from trainer import run

from csac.algorithms import CSAC, PPO, SAC, SD3, TD3
from csac.algorithms.critics import q_values
from csac.algorithms.distributions import TanhGaussian, policy_at
from csac.algorithms.ppo import value_at

DISCOUNT = 0.9
COMMON: dict[str, Any] = {
    "discount": DISCOUNT,
    "target_rate": 0.1,
    "actor_learning_rate": 3e-3,
    "critic_learning_rate": 3e-3,
    "actor_hidden_sizes": (32, 32),
    "critic_hidden_sizes": (32, 32),
    "batch_size": 64,
    "warmup_steps": 64,
    "replay_size": 500,
}
SETTINGS: dict[str, Any] = {**COMMON, "entropy_weight": 1e-3}
# Noise enough to see all actions: critics are asked about those that the actor would not take, too.
NOISY: dict[str, Any] = {**COMMON, "exploration_std": 0.5}


RELATIVE: dict[str, Any] = {**SETTINGS, "relative_entropy_weight": 0.01}
ALGORITHMS = {
    "sac": SAC(**SETTINGS),
    "csac-periodic": CSAC(
        reference_policy="periodic", reference_period=100, relative_entropy_estimator="closed_form", **RELATIVE
    ),
    "csac-average": CSAC(reference_policy="average", relative_entropy_estimator="sampled", **RELATIVE),
    "td3": TD3(**NOISY),
    "sd3": SD3(noise_samples=4, **NOISY),
}


@pytest.fixture(params=ALGORITHMS)
def algorithm(request):
    return ALGORITHMS[request.param]


def values(state, observation: float, actions=(-0.8, 0.0, 0.8)) -> np.ndarray:
    """Both critics' values of a few actions, [critic, action]."""
    pairs = jnp.array([observation]), jnp.array(actions)[:, None]
    critics = state.critics if hasattr(state, "critics") else (state.first.critic, state.second.critic)
    return np.stack(jax.vmap(q_values, in_axes=(None, None, 0))(critics, *pairs))


def best_action(algorithm, state, observation: float) -> float:
    return float(algorithm.act(state, jnp.array([observation]), jax.random.key(0), explore=False)[0])


def entropy(policy: TanhGaussian) -> float:
    """The entropy of a policy of one action dimension, by Gauss-Hermite quadrature."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    log_prob = jax.vmap(policy.log_prob)(jnp.array(nodes, jnp.float32)[:, None])
    return -float(weights @ np.asarray(log_prob) / weights.sum())


class TerminalReward(probes.ObservationActionReward):
    """Observation x = -1 or 1, reward 1 - (action - x/2)², then the end. Were the end no end, values would be 10."""

    def reward(self, action: float) -> float:
        return 1.0 + super().reward(action)


def test_the_best_action_depends_on_the_observation_and_termination_ends_the_value(algorithm):
    state = run(algorithm, TerminalReward, 2500).states[0]
    for observation in (-1.0, 1.0):
        best = observation / 2
        assert best_action(algorithm, state, observation) == pytest.approx(best, abs=0.15)
        np.testing.assert_allclose(values(state, observation, (best,)), 1.0, atol=0.06)
        np.testing.assert_allclose(values(state, observation, (best - 0.4, best + 0.3)), [[0.84, 0.91]] * 2, atol=0.06)


@pytest.mark.parametrize("algorithm", [CSAC, SAC], ids=lambda algorithm: algorithm.name)
def test_entropy_has_its_weight_in_the_value(algorithm):
    # Every action is as good as another, so the policy spreads out and Q = (r + γ σ H) / (1 - γ) with its entropy H,
    # nearly log 2: with σ = 1 about 10 + 6.2. The relative entropy is zero once nothing moves.
    state = run(algorithm(**{**SETTINGS, "entropy_weight": 1.0}), probes.Endless, 1250).states[0]
    policy_entropy = entropy(policy_at(state.actor, jnp.zeros(1)))
    assert np.log(2) - 0.1 < policy_entropy < np.log(2)
    np.testing.assert_allclose(values(state, 0.0), (1 + DISCOUNT * policy_entropy) / (1 - DISCOUNT), atol=0.6)


class Onward(probes.Endless):
    """Observation 0, then 1 until the truncation, which is the reward of the next step; at the end it is 1 as well.

    With a discount γ the value at 1 is 1 / (1 - γ) and at 0 it is γ / (1 - γ): 10 and 9. It would be less if nothing
    followed, or if the first observation of the next episode stood for the last of this one.
    """

    def step(self, action: np.ndarray) -> probes.Result:
        reward = float(self.observation[0])
        self.observation = np.ones(1, np.float32)
        return self.observation, reward, *super().step(action)[2:]


@pytest.mark.parametrize("name", ["sac", "sd3"])  # the targets of each by hand: test_equations.py, test_td3.py
def test_a_truncated_episode_goes_on_from_its_last_observation(name):
    state = run(ALGORITHMS[name], Onward, 2000, length=2).states[0]
    np.testing.assert_allclose(values(state, 1.0), 10.0, atol=0.4)
    np.testing.assert_allclose(values(state, 0.0), 9.0, atol=0.4)


PPO_SETTINGS: dict[str, Any] = {
    "discount": DISCOUNT,
    "learning_rate": 3e-3,
    "learning_rate_schedule": "constant",
    "clip_value_loss": False,
    "rollout_steps": 128,
    "minibatches": 4,
    "hidden_sizes": (32, 32),
    "normalise_rewards": False,
}


def test_ppo_learns_known_values_over_truncation_in_four_environments():
    algorithm = PPO(**PPO_SETTINGS)
    # In each environment, rollouts of 32 steps end within an episode of 3 as well.
    state = run(algorithm, Onward, 6144, environments=4, length=3).states[0]
    for observation, value in {0.0: 9.0, 1.0: 10.0}.items():
        assert state_value(algorithm, state, observation) == pytest.approx(value, rel=0.02)


def test_ppo_learns_values_in_units_of_the_spread_of_returns():
    algorithm = PPO(**{**PPO_SETTINGS, "normalise_rewards": True})
    state = run(algorithm, probes.DelayedReward, 1536).states[0]
    # Half of the discounted returns so far are 0, half are 1.
    assert float(state.returns.std) == pytest.approx(0.5)
    assert state_value(algorithm, state, 0.0) == pytest.approx(DISCOUNT / 0.5, rel=0.02)
    assert state_value(algorithm, state, 1.0) == pytest.approx(1.0 / 0.5, rel=0.02)


def test_ppo_finds_the_best_action_and_values_its_own_noise():
    algorithm = PPO(**PPO_SETTINGS)
    state = run(algorithm, TerminalReward, 3072).states[0]
    std = float(np.exp(state.parameters.log_std[0]))
    assert std < 0.25
    for observation in (-1.0, 1.0):
        mean = best_action(algorithm, state, observation)
        assert mean == pytest.approx(observation / 2, abs=0.1)
        # E 1 - (a - best)² of a Gaussian action
        expected = 1 - std**2 - (mean - observation / 2) ** 2
        assert state_value(algorithm, state, observation) == pytest.approx(expected, abs=0.02)


def state_value(algorithm: PPO, state, observation: float) -> float:
    seen = algorithm.normalise(state.observation_statistics, jnp.array([observation]))
    return float(value_at(state.parameters, seen))
