"""Updates of one learner without an environment, on the same transition repeatedly."""

from __future__ import annotations

import resource
import time
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.measuring import TASK
from csac.algorithms import ALGORITHMS
from csac.presets import hyperparameters
from csac.training.learner import Learner
from csac.types import Spec

HALF_CHEETAH = Spec(17, 6)


def make_learner(
    algorithm: str, spec: Spec = HALF_CHEETAH, seeds: int = 1, preset: str = "paper", **changes: Any
) -> Learner:
    """Return a learner without warm-up, with the settings of a preset and `changes`."""
    settings: dict[str, Any] = {**hyperparameters(preset, algorithm, TASK), "warmup_steps": 0, **changes}
    return Learner(ALGORITHMS[algorithm](**settings), spec, range(seeds), settings["replay_size"])


class Driver:
    """Feed transitions to a learner in place of an environment."""

    def __init__(self, learner: Learner, seeds: int = 1) -> None:
        self.learner, self.step = learner, 0
        self.actions = np.zeros((seeds, learner.spec.action_size), np.float32)
        observation = np.random.default_rng(0).standard_normal((seeds, learner.spec.observation_size), np.float32)
        self.transition = observation, np.zeros(seeds, np.float32), observation

    def make_step(self, observation: np.ndarray, reward: np.ndarray, next_observation: np.ndarray) -> None:
        """Add one transition of every seed, update, and choose the next actions."""
        none = np.zeros(len(reward), bool)
        outcome: Any = SimpleNamespace(
            next_observation=next_observation,
            reward=reward,
            terminated=none,
            truncated=none,
            observation=next_observation,
        )
        self.step += 1
        self.actions = self.learner.step(observation, self.actions, outcome, self.step)

    def run(self, seconds: float, interval: int = 1) -> float:
        """Make whole intervals of steps for at least `seconds`, and return environment steps per second."""
        first, began = self.step, time.perf_counter()
        while (elapsed := time.perf_counter() - began) < seconds or self.step == first:
            for _ in range(interval):
                self.make_step(*self.transition)
        return (self.step - first) / elapsed


def measure(
    algorithm: str,
    seconds: float,
    interval: int = 1,
    observation: int = 17,
    width: int = 256,
    batch: int = 256,
    replay: int = 1_000_000,
) -> dict[str, float]:
    """Return updates per second, with `interval` updates per dispatch, and the peak memory in MiB."""
    changes: dict[str, Any] = {"actor_hidden_sizes": (width,) * 2, "critic_hidden_sizes": (width,) * 2}
    changes |= {"batch_size": batch, "replay_size": replay, "update_interval": interval}
    driver = Driver(make_learner(algorithm, Spec(observation, 6), **changes))
    driver.run(min(seconds, 0.5), interval)
    speed = driver.run(seconds, interval)
    return {"updates_per_second": speed, "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}
