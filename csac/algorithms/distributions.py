"""Action distributions of policies, for one example."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from csac.algorithms.shapes import Action, Observation, Scalar
from csac.types import LOG_STD_RANGE

if TYPE_CHECKING:
    from collections.abc import Callable

LOG_TWO = 0.6931471805599453
HALF_LOG_TWO_PI = 0.9189385332046727
GAUSSIAN_ENTROPY = 1.4189385332046727  # of N(0, 1), log(2πe) / 2


class Gaussian(NamedTuple):
    """The distribution N(mean, exp(log_std)²), its dimensions independent."""

    mean: Action
    log_std: Action

    def sample(self, noise: Action) -> Action:
        """Return mean + std ξ for noise ξ ~ N(0, I)."""
        return self.mean + jnp.exp(self.log_std) * noise

    def log_prob(self, value: Action) -> Scalar:
        """Return the log-density of a value."""
        noise = (value - self.mean) * jnp.exp(-self.log_std)
        return jnp.sum(-0.5 * noise**2 - self.log_std - HALF_LOG_TWO_PI)

    def entropy(self) -> Scalar:
        """Return the differential entropy in nats."""
        return jnp.sum(self.log_std + GAUSSIAN_ENTROPY)


class TanhGaussian(NamedTuple):
    """The distribution of tanh(u), u ~ N(mean, exp(log_std)²) (the paper's Eq. actor).

    Methods take the noise ξ ~ N(0, I) of an action, u = mean + std ξ, instead of the action: atanh of a saturated
    action is infinite, and u - mean is mostly rounding error where std is small.
    """

    mean: Action
    log_std: Action

    @classmethod
    def from_output(cls, output: Float[Array, " twice_action"]) -> TanhGaussian:
        """Split a network's output [2 action] into mean and log standard deviation, and clip the latter."""
        mean, log_std = jnp.split(output, 2)
        return cls(mean, jnp.clip(log_std, *LOG_STD_RANGE))

    def pre_tanh(self, noise: Action) -> Action:
        """Return the reparameterised sample u = mean + std ξ."""
        return self.mean + jnp.exp(self.log_std) * noise

    def sample(self, noise: Action) -> Action:
        """Return the action tanh(mean + std ξ)."""
        return jnp.tanh(self.pre_tanh(noise))

    def log_prob(self, noise: Action) -> Scalar:
        """Return the log-density of the action tanh(mean + std ξ)."""
        log_gaussian = -0.5 * noise**2 - self.log_std - HALF_LOG_TWO_PI
        return jnp.sum(log_gaussian - log_tanh_derivative(self.pre_tanh(noise)))

    def mode(self) -> Action:
        """Return tanh(mean), the deterministic action."""
        return jnp.tanh(self.mean)


def log_tanh_derivative(pre_tanh: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return log(1 - tanh²u) elementwise, without the cancellation of the direct formula."""
    return 2.0 * (LOG_TWO - pre_tanh - jax.nn.softplus(-2.0 * pre_tanh))


def log_ratio(policy: TanhGaussian, reference: TanhGaussian, noise: Action) -> Scalar:
    """Return log π(a) - log π̃(a) at π's action tanh(mean + std ξ). The Jacobian of tanh cancels."""
    log_scale = policy.log_std - reference.log_std
    reference_noise = (policy.mean - reference.mean) * jnp.exp(-reference.log_std) + jnp.exp(log_scale) * noise
    return jnp.sum(0.5 * (reference_noise**2 - noise**2) - log_scale)


def kl(policy: TanhGaussian, reference: TanhGaussian) -> Scalar:
    """Return KL(π ‖ π̃) in closed form: that of the Gaussians before tanh, which is invertible."""
    log_scale = policy.log_std - reference.log_std
    shift = (policy.mean - reference.mean) * jnp.exp(-reference.log_std)
    return jnp.sum(0.5 * (jnp.exp(2.0 * log_scale) + shift**2 - 1.0) - log_scale)


def bounded(value: Scalar, bound: float) -> Scalar:
    """Return a log-density, KL or log-ratio of a whole action, clipped to ± bound nats if `bound` is positive."""
    return jnp.clip(value, -bound, bound) if bound > 0 else value


def action_at(actor: Callable[[jax.Array], jax.Array], observation: Observation, noise: Action) -> Action:
    """Return the action tanh(mean + std ξ) of an actor network at one observation."""
    return policy_at(actor, observation).sample(noise)


def policy_at(actor: Callable[[jax.Array], jax.Array], observation: Observation) -> TanhGaussian:
    """Return the distribution that an actor network gives at one observation."""
    return TanhGaussian.from_output(actor(observation))
