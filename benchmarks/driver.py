"""A learner without an environment: add a transition, draw, update, choose the next action."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.measuring import TASK
from csac.algorithms import ALGORITHMS
from csac.presets import hyperparameters
from csac.tasks.seeds import Steps
from csac.training.learner import Learner
from csac.training.messages import Settings
from csac.training.plan import Plan
from csac.types import Algorithm, Spec

HALF_CHEETAH = Spec(17, 6)


def make_learner(algorithm: str, spec: Spec = HALF_CHEETAH, seeds: int = 1, **changes: Any) -> Learner:
    """Return a learner at the paper's settings but for `changes`, whose warm-up is over at once."""
    settings = {**hyperparameters("paper", algorithm, TASK), "warmup_steps": 0, **changes}
    return Learner(ALGORITHMS[algorithm](**settings), spec, range(seeds), settings["replay_size"])


def make_settings(algorithm: Algorithm, task: str, steps: int, **options: Any) -> Settings:
    """Return what a group is told that is evaluated at its end alone, but for `options`, and never saved."""
    options = {"evaluation_interval": steps, "checkpoint_interval": 0, **options}
    return Settings(Plan(algorithm=algorithm, task=task, task_name=task, groups=((0,),), steps=steps, **options))


class Driver:
    """Gives a learner the same transition again and again."""

    def __init__(self, learner: Learner, seeds: int = 1, interval: int = 1) -> None:
        observation_size, action_size = learner.spec
        generator = np.random.default_rng(0)
        self.learner, self.step, self.interval = learner, 0, interval
        self.observations = generator.standard_normal((seeds, observation_size), dtype=np.float32)
        self.actions = np.zeros((seeds, action_size), np.float32)
        none = np.zeros(seeds, bool)
        reward = np.zeros(seeds, np.float32)
        self.outcome = Steps(self.observations, reward, none, none, self.observations, [], [])

    def make(self, steps: int) -> float:
        """Make so many environment steps, each with its update, and return the seconds that they took."""
        began = time.perf_counter()
        for _ in range(steps):
            self.step += 1
            self.actions = self.learner.step(self.observations, self.actions, self.outcome, self.step)
        return time.perf_counter() - began

    def run(self, seconds: float) -> float:
        """Make whole intervals for at least so long, and return environment steps per second."""
        first, began = self.step, time.perf_counter()
        while (elapsed := time.perf_counter() - began) < seconds or self.step == first:
            self.make(self.interval)
        return (self.step - first) / elapsed
