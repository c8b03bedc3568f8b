"""The smallest networks, and one transition whose numbers are worked by hand."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac.algorithms import CSAC
from csac.algorithms.adaptation import Weights
from csac.algorithms.networks import MLP
from csac.types import Layer, Spec, Transition

ONE = Spec(1, 1)


def linear(weight: list[list[float]], bias: list[float]) -> MLP:
    return MLP((Layer(jnp.array(weight), jnp.array(bias)),))


def gaussian(mean: float, std: float) -> MLP:
    """A policy that is tanh(N(mean, std²)) everywhere."""
    return linear([[0.0, 0.0]], [mean, math.log(std)])


def transition(observation=1.0, action=0.5, reward=2.0, next_observation=1.0, terminated=0.0, truncated=0.0):
    observation, action, next_observation = (np.array([x], np.float32) for x in (observation, action, next_observation))
    reward, terminated, truncated = (np.array(x, np.float32) for x in (reward, terminated, truncated))
    return Transition(observation, action, reward, next_observation, terminated, truncated)


def batch_of(*transitions: Transition) -> Transition:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *transitions)


@partial(jax.jit, static_argnums=0)
def update(algorithm, state, batch: Transition, step: int = 0):
    return algorithm.update(state, batch, jax.random.key(step), step)


# Policy tanh(N(0, 1)), reference tanh(N(1, 2²)), noise 0.5, so u = 0.5, a = tanh 0.5 = 0.4621172, 1 - a² = 0.7864477.
# log N(u; 0, 1) = -0.125 - 0.9189385              = -1.0439385
# log N(u; 1, 2²) = -0.03125 - 0.6931472 - 0.9189385 = -1.6433357
# log π = -1.0439385 - log 0.7864477 = -1.0439385 + 0.2402290 = -0.8037095;  log π̃ = -1.6433357 + 0.2402290 = -1.4031067
# sampled: log π - log π̃ = 0.5993972;  closed form: KL = log 2 + (1² + 1²) / (2·2²) - 1/2 = 0.4431472
# Q₁ = s + 2a = 1.9242343, Q₂ = 3 - a = 2.5378828 at s = 1, so min Q = 1.9242343
POLICY, REFERENCE, NOISE = gaussian(0.0, 1.0), gaussian(1.0, 2.0), jnp.array([0.5])
CRITICS = (linear([[1.0], [2.0]], [0.0]), linear([[0.0], [-1.0]], [3.0]))


CLOSED_FORM: dict[str, Any] = {"relative_entropy_estimator": "closed_form"}
PERIODIC: dict[str, Any] = {"reference_policy": "periodic", **CLOSED_FORM}


def csac(**settings) -> CSAC:
    return CSAC(**{"entropy_weight": 0.2, "relative_entropy_weight": 0.5, "discount": 0.9, **CLOSED_FORM, **settings})


BOTH_WEIGHTS = Weights(0.2, 0.5)

LINEAR = {
    "actor_hidden_sizes": (),
    "critic_hidden_sizes": (),
    "discount": 0.5,
    "target_rate": 0.5,
    "actor_learning_rate": 0.1,
    "critic_learning_rate": 0.1,
}
