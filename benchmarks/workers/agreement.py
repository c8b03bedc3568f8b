"""Which GPU there is, and whether its numbers are those of the CPU."""

from __future__ import annotations

import os
from typing import Any

import jax
import numpy as np

from benchmarks.driver import HALF_CHEETAH, Driver, make_learner
from benchmarks.measuring import TASK
from csac.presets import hyperparameters
from csac.training.devices import FLAGS, multiply_in_float32, with_exact_kernels


def measure(updates: int, preset: str = "paper") -> dict[str, Any]:
    """Return which GPU there is, and how far CSAC is there from the CPU after so many updates from the same beginning.

    The difference is relative to the size of each array of the learner's state, and the largest of all. Where JAX can
    use no GPU, `device` is "".
    """
    compute_as_csac_does()
    try:
        gpu = jax.devices("gpu")[0]
    except RuntimeError:
        return {"device": ""}
    if not updates:
        return {"device": gpu.device_kind}
    ours, theirs = (learnt(device, updates, preset) for device in (jax.devices("cpu")[0], gpu))
    difference = largest_difference(ours, theirs)
    return {"device": gpu.device_kind, "preset": preset, "updates": updates, "largest_difference": difference}


def compute_as_csac_does() -> None:
    """Ask for the numbers that `csac train --device gpu` has, in this process, whose devices JAX has not looked for."""
    os.environ[FLAGS] = with_exact_kernels(os.environ.get(FLAGS, ""))
    multiply_in_float32()


def learnt(device: Any, updates: int, preset: str) -> list[Any]:
    """Return each seed's whole state, actor, critics and optimisers, after so many updates on this device."""
    seeds = 2
    settings: dict[str, Any] = hyperparameters(preset, "csac", TASK) | {"replay_size": 1_000, "warmup_steps": 0}
    with jax.default_device(device):
        driver = Driver(make_learner("csac", seeds=seeds, **settings), seeds=seeds)
        generator = np.random.default_rng(1)
        for step in range(1, updates + 1):
            # Transitions that differ: a batch of equal ones is nothing but its rounding errors once it is normalised.
            observations, following = generator.standard_normal((2, seeds, HALF_CHEETAH.observation_size), np.float32)
            actions = generator.uniform(-1.0, 1.0, (seeds, HALF_CHEETAH.action_size)).astype(np.float32)
            reward = generator.standard_normal(seeds, np.float32)
            outcome = driver.outcome._replace(next_observation=following, reward=reward, observation=following)
            driver.learner.step(observations, actions, outcome, step)
        return [driver.learner.carry(index).state for index in range(seeds)]


def largest_difference(ours: Any, theirs: Any) -> float:
    """Return the largest difference of two trees of arrays, each relative to the largest number in its array of ours.

    It is not a number where one of the arrays holds such.
    """
    pairs = zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True)
    return float(np.max([_relative(np.asarray(a, np.float64), np.asarray(b, np.float64)) for a, b in pairs]))


def _relative(ours: np.ndarray, theirs: np.ndarray) -> np.floating:
    return np.abs(ours - theirs).max(initial=0.0) / (np.abs(ours).max(initial=0.0) + 1e-6)
