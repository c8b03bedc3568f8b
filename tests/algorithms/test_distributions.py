"""The tanh-Gaussian against autodiff, numerical integration and Monte Carlo."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac.algorithms.distributions import TanhGaussian, kl, log_ratio, log_tanh_derivative

# Actions tanh(u) on an even grid of u: finer where the density of the action is steep.
GRID = np.linspace(-12.0, 12.0, 24001)
WIDTHS = (GRID[1] - GRID[0]) / np.cosh(GRID) ** 2  # da = (1 - tanh²u) du

STANDARD = TanhGaussian(jnp.array([0.0]), jnp.array([0.0]))
SHIFTED = TanhGaussian(jnp.array([1.0]), jnp.array([0.0]))
NARROW = TanhGaussian(jnp.array([0.6]), jnp.array([-1.0]))
WIDE = TanhGaussian(jnp.array([-0.4]), jnp.array([0.3]))
POLICY = TanhGaussian(jnp.array([0.5, -1.0, 2.0]), jnp.array([-0.5, 0.2, -2.0]))
REFERENCE = TanhGaussian(jnp.array([0.2, -0.5, 2.1]), jnp.array([0.1, 0.0, -1.8]))


def log_density(policy: TanhGaussian) -> np.ndarray:
    """The log-density of the action at each point of the grid."""
    return np.asarray(jax.vmap(policy.log_prob)(jnp.array(GRID[:, None], jnp.float32)), np.float64)


def test_log_prob_is_the_change_of_variables():
    pre_tanh = jnp.array([0.3, -1.2, 1.9])
    jacobian = jax.jacobian(jnp.tanh)(pre_tanh)
    expected = jax.scipy.stats.norm.logpdf(pre_tanh, POLICY.mean, jnp.exp(POLICY.log_std)).sum()
    expected -= jnp.log(jnp.abs(jnp.linalg.det(jacobian)))
    assert float(POLICY.log_prob(pre_tanh)) == pytest.approx(float(expected), abs=1e-5)


@pytest.mark.parametrize("policy", [NARROW, WIDE])
def test_the_density_of_the_action_integrates_to_one(policy):
    assert np.exp(log_density(policy)) @ WIDTHS == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("policy", [NARROW, WIDE])
def test_the_density_agrees_with_where_samples_fall(policy):
    noise = jax.random.normal(jax.random.key(0), (100_000, 1))
    share = np.mean(np.tanh(jax.vmap(policy.pre_tanh)(noise)) < 0.3)
    expected = np.exp(log_density(policy)) @ (WIDTHS * (np.tanh(GRID) < 0.3))
    assert share == pytest.approx(expected, abs=0.006)  # four standard errors


def test_log_tanh_derivative_where_tanh_is_flat():
    # 1 - tanh²u = 4 / (e^u + e^-u)², which is 4 e^(-2|u|) in the tails: log 4 - 2|u|, though tanh(20) is 1 in float32.
    tails = jnp.array([-100.0, -20.0, 0.0, 20.0, 100.0])
    expected = [math.log(4) - 200, math.log(4) - 40, 0.0, math.log(4) - 40, math.log(4) - 200]
    np.testing.assert_allclose(log_tanh_derivative(tails), expected, rtol=1e-6, atol=1e-6)
    gradients = jax.vmap(jax.grad(log_tanh_derivative))(tails)
    np.testing.assert_allclose(gradients, -2 * np.tanh(tails), atol=1e-6)


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, -30.0), (0.0, 9.0), (90.0, -30.0), (-90.0, 9.0)])
def test_extreme_networks_give_finite_numbers(mean, log_std):
    def loss(output, noise):
        policy = TanhGaussian.from_output(output)
        pre_tanh = policy.pre_tanh(noise)
        return policy.log_prob(pre_tanh) + kl(policy, STANDARD) + log_ratio(policy, STANDARD, pre_tanh)

    value, gradient = jax.value_and_grad(loss)(jnp.array([mean, log_std]), jnp.array([3.0]))
    assert np.isfinite(value)
    assert np.isfinite(gradient).all()


def test_network_output_is_mean_and_log_std_side_by_side_and_clipped():
    policy = TanhGaussian.from_output(jnp.array([1.0, 2.0, -50.0, 50.0]))
    np.testing.assert_array_equal(policy.mean, [1.0, 2.0])
    np.testing.assert_array_equal(policy.log_std, [-20.0, 2.0])
    np.testing.assert_allclose(policy.mode(), np.tanh([1.0, 2.0]), rtol=1e-6)


def test_kl_by_hand():
    # log(2/1) + (1² + (0 - 1)²) / (2·2²) - 1/2 = 0.6931472 + 0.25 - 0.5
    reference = TanhGaussian(jnp.array([1.0]), jnp.array([math.log(2.0)]))
    assert float(kl(STANDARD, reference)) == pytest.approx(0.4431472, abs=1e-6)
    assert float(kl(STANDARD, STANDARD)) == 0.0


def test_kl_is_the_mean_log_ratio():
    noise = jax.random.normal(jax.random.key(0), (200_000, 3))
    ratios = jax.vmap(lambda xi: log_ratio(POLICY, REFERENCE, POLICY.pre_tanh(xi)))(noise)
    assert float(kl(POLICY, REFERENCE)) == pytest.approx(
        float(ratios.mean()), abs=4 * float(ratios.std()) / 200_000**0.5
    )


@pytest.mark.parametrize(("policy", "reference"), [(NARROW, WIDE), (WIDE, NARROW)])
def test_kl_beneath_the_tanh_is_the_kl_of_the_actions(policy, reference):
    log_p, log_q = log_density(policy), log_density(reference)
    expected = (np.exp(log_p) * (log_p - log_q)) @ WIDTHS
    assert float(kl(policy, reference)) == pytest.approx(expected, rel=1e-3)


def test_the_jacobian_cancels_in_the_log_ratio():
    pre_tanh = jnp.array([0.3, -1.2, 1.9])
    expected = POLICY.log_prob(pre_tanh) - REFERENCE.log_prob(pre_tanh)
    assert float(log_ratio(POLICY, REFERENCE, pre_tanh)) == pytest.approx(float(expected), abs=1e-5)
    # At u = 40, where tanh is 1 in float32: log N(40; 0, 1) - log N(40; 1, 1) = (-40² + 39²) / 2 = -39.5.
    assert float(log_ratio(STANDARD, SHIFTED, jnp.array([40.0]))) == pytest.approx(-39.5, abs=1e-3)
