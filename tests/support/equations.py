"""The smallest networks, and one transition whose numbers are worked by hand."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac.algorithms import CSAC
from csac.algorithms.networks import MLP
from csac.types import Layer, Spec, Transition

ONE, SPEC = Spec(1, 1), Spec(3, 2)


def linear(weight: list[list[float]], bias: list[float]) -> MLP:
    return MLP((Layer(jnp.array(weight), jnp.array(bias)),))


def gaussian(mean: float, std: float) -> MLP:
    """A policy that is tanh(N(mean, std²)) everywhere."""
    return linear([[0.0, 0.0]], [mean, math.log(std)])


def always(action: float) -> MLP:
    """An actor whose action is this one everywhere."""
    return linear([[0.0]], [math.atanh(action)])


def transition(observation=1.0, action=0.5, reward=2.0, next_observation=1.0, terminated=0.0, truncated=0.0):
    observation, action, next_observation = (np.array([x], np.float32) for x in (observation, action, next_observation))
    reward, terminated, truncated = (np.array(x, np.float32) for x in (reward, terminated, truncated))
    return Transition(observation, action, reward, next_observation, terminated, truncated)


def batch_of(*transitions: Transition) -> Transition:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *transitions)


def transitions(size: int, key: int = 0, shift: float = 0.0, scale: float = 1.0) -> Transition:
    """Random ones of SPEC, one of them terminal, whose states have this mean and standard deviation."""
    draw = np.random.default_rng(key)
    states = (shift + scale * draw.normal(size=(2, size, 3))).astype(np.float32)
    actions, rewards = np.tanh(draw.normal(size=(size, 2))), draw.normal(size=size)
    terminated = np.arange(size) == 3
    floats = (array.astype(np.float32) for array in (actions, rewards, terminated))
    action, reward, terminated = floats
    return Transition(states[0], action, reward, states[1], terminated, np.zeros(size, np.float32))


@partial(jax.jit, static_argnums=0)
def update(algorithm, state, batch: Transition, step: int = 0):
    return algorithm.update(state, batch, jax.random.key(step), step)


@partial(jax.jit, static_argnums=(0, 1))
def begin(algorithm, spec: Spec = ONE):
    return algorithm.init(jax.random.key(0), spec, 1000)


def assert_equal(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def assert_close(one: Any, other: Any, rtol: float = 1e-4, atol: float = 1e-5) -> None:
    jax.tree.map(partial(np.testing.assert_allclose, rtol=rtol, atol=atol), one, other)


def differ(one: Any, other: Any) -> bool:
    return any(not np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True))


def share_no_buffer(state: Any) -> bool:
    pointers = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(state)]
    return len(set(pointers)) == len(pointers)


# Policy tanh(N(0, 1)), reference tanh(N(1, 2²)), noise 0.5, so u = 0.5, a = tanh 0.5 = 0.4621172, 1 - a² = 0.7864477.
# log N(u; 0, 1) = -0.125 - 0.9189385              = -1.0439385
# log N(u; 1, 2²) = -0.03125 - 0.6931472 - 0.9189385 = -1.6433357
# log π = -1.0439385 - log 0.7864477 = -1.0439385 + 0.2402290 = -0.8037095;  log π̃ = -1.6433357 + 0.2402290 = -1.4031067
# sampled: log π - log π̃ = 0.5993972;  closed form: KL = log 2 + (1² + 1²) / (2·2²) - 1/2 = 0.4431472
# Q₁ = s + 2a = 1.9242343, Q₂ = 3 - a = 2.5378828 at s = 1, so min Q = 1.9242343
POLICY, REFERENCE, NOISE = gaussian(0.0, 1.0), gaussian(1.0, 2.0), jnp.array([0.5])
CRITICS = (linear([[1.0], [2.0]], [0.0]), linear([[0.0], [-1.0]], [3.0]))


CLOSED_FORM: dict[str, Any] = {"relative_entropy_estimator": "closed_form"}
REFERENCES: dict[str, dict[str, Any]] = {
    "the actor itself": {"reference_policy": "periodic", "reference_period": 1},
    "one update ago": {"reference_policy": "average", "reference_rate": 1.0},
    "periodic": {"reference_policy": "periodic", "reference_period": 3},
    "average": {"reference_policy": "average", "reference_rate": 0.25},
}


def csac(**settings) -> CSAC:
    return CSAC(**{"entropy_weight": 0.2, "relative_entropy_weight": 0.5, "discount": 0.9, **CLOSED_FORM, **settings})


LINEAR = {
    "actor_hidden_sizes": (),
    "critic_hidden_sizes": (),
    "discount": 0.5,
    "target_rate": 0.5,
    "actor_learning_rate": 0.1,
    "critic_learning_rate": 0.1,
}
