"""The tanh-Gaussian against autodiff, numbers worked by hand and Monte Carlo."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from csac.algorithms.distributions import TanhGaussian, kl, log_ratio, log_tanh_derivative

STANDARD = TanhGaussian(jnp.array([0.0]), jnp.array([0.0]))
SHIFTED = TanhGaussian(jnp.array([1.0]), jnp.array([0.0]))
POLICY = TanhGaussian(jnp.array([0.5, -1.0, 2.0]), jnp.array([-0.5, 0.2, -2.0]))
REFERENCE = TanhGaussian(jnp.array([0.2, -0.5, 2.1]), jnp.array([0.1, 0.0, -1.8]))


def noise_of(policy: TanhGaussian, pre_tanh) -> jax.Array:
    """The noise that gives this value before the tanh."""
    return (jnp.asarray(pre_tanh, jnp.float32) - policy.mean) / jnp.exp(policy.log_std)


def test_log_prob_is_the_change_of_variables():
    pre_tanh = jnp.array([0.3, -1.2, 1.9])
    jacobian = jax.jacobian(jnp.tanh)(pre_tanh)
    expected = jax.scipy.stats.norm.logpdf(pre_tanh, POLICY.mean, jnp.exp(POLICY.log_std)).sum()
    expected -= jnp.log(jnp.abs(jnp.linalg.det(jacobian)))
    assert float(POLICY.log_prob(noise_of(POLICY, pre_tanh))) == pytest.approx(float(expected), abs=1e-5)


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
        return policy.log_prob(noise) + kl(policy, STANDARD) + log_ratio(policy, STANDARD, noise)

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


@pytest.mark.parametrize("log_std", [-4.0, -12.0, -20.0])
def test_densities_of_a_sharp_policy_are_exact(log_std):
    # Beside a mean of 0.8, u = mean + std ξ is known to 6e-8, which is 0.01 std at a log_std of -12.
    noise, mean = np.array([0.7, -1.3]), 0.8
    policy = TanhGaussian(jnp.full(2, mean), jnp.full(2, log_std))
    slope = np.log1p(-(np.tanh(mean + np.exp(log_std) * noise) ** 2))
    expected = np.sum(norm.logpdf(noise) - log_std - slope)
    assert float(policy.log_prob(jnp.array(noise))) == pytest.approx(expected, rel=1e-6)
    assert float(log_ratio(policy, policy, jnp.array(noise))) == 0.0


def test_kl_is_the_mean_log_ratio():
    noise = jax.random.normal(jax.random.key(0), (200_000, 3))
    ratios = jax.vmap(lambda xi: log_ratio(POLICY, REFERENCE, xi))(noise)
    assert float(kl(POLICY, REFERENCE)) == pytest.approx(
        float(ratios.mean()), abs=4 * float(ratios.std()) / 200_000**0.5
    )


def test_the_jacobian_cancels_in_the_log_ratio():
    pre_tanh = jnp.array([0.3, -1.2, 1.9])
    noise, reference_noise = noise_of(POLICY, pre_tanh), noise_of(REFERENCE, pre_tanh)
    expected = POLICY.log_prob(noise) - REFERENCE.log_prob(reference_noise)
    assert float(log_ratio(POLICY, REFERENCE, noise)) == pytest.approx(float(expected), abs=1e-5)
    # At u = 40, where tanh is 1 in float32: log N(40; 0, 1) - log N(40; 1, 1) = (-40² + 39²) / 2 = -39.5.
    assert float(log_ratio(STANDARD, SHIFTED, jnp.array([40.0]))) == pytest.approx(-39.5, abs=1e-3)
