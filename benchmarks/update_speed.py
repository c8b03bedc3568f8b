"""Updates per second of one learner without an environment: add a transition, draw, update, choose the next action.

`roofline.py` and `scaling.py` run this, a process for each measurement; it prints one line of JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from typing import Any

import jax
import numpy as np

from csac.algorithms import ALGORITHMS
from csac.presets import hyperparameters
from csac.tasks.seeds import Steps
from csac.training.learner import Learner
from csac.types import Spec

TASK = "HalfCheetah-v4"  # whose preset it is; nothing here steps it


def make_learner(algorithm: str, spec: Spec, seeds: int = 1, **changes: Any) -> Learner:
    """Return a learner at the paper's settings but for `changes`, whose warm-up is over at once."""
    settings = {**hyperparameters("paper", algorithm, TASK), "warmup_steps": 0, **changes}
    return Learner(ALGORITHMS[algorithm](**settings), spec, range(seeds), settings["replay_size"])


class Driver:
    """Gives a learner the same transition again and again."""

    def __init__(self, learner: Learner, seeds: int = 1) -> None:
        observation_size, action_size = learner.spec
        generator = np.random.default_rng(0)
        self.learner, self.step, self.interval = learner, 0, learner.algorithm.cadence.update_interval
        self.observations = generator.standard_normal((seeds, observation_size), dtype=np.float32)
        self.actions = np.zeros((seeds, action_size), np.float32)
        none = np.zeros(seeds, bool)
        reward = np.zeros(seeds, np.float32)
        self.outcome = Steps(self.observations, reward, none, none, self.observations, [], [])

    def run(self, seconds: float) -> float:
        """Make whole intervals for at least so long, and return environment steps per second."""
        first, began = self.step, time.perf_counter()
        while (elapsed := time.perf_counter() - began) < seconds or self.step == first:
            for _ in range(self.interval):
                self.step += 1
                self.actions = self.learner.step(self.observations, self.actions, self.outcome, self.step)
        return (self.step - first) / elapsed


def main() -> None:
    """Measure one learner."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithm", choices=("csac", "sac", "td3", "sd3"), default="csac")
    parser.add_argument("--cores", help="processors to run on, such as 0,1; by default all")
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--seeds", type=int, default=1, help="side by side in one program")
    parser.add_argument("--observation", type=int, default=17)
    parser.add_argument("--action", type=int, default=6)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--replay", type=int, default=1_000_000)
    parser.add_argument("--interval", type=int, default=1, help="environment steps, and updates, in one dispatch")
    arguments = parser.parse_args()
    if arguments.cores:
        os.sched_setaffinity(0, [int(core) for core in arguments.cores.split(",")])
    jax.config.update("jax_platforms", "cpu" if arguments.device == "cpu" else "cuda")
    if arguments.device == "cpu":
        jax.config.update("jax_cpu_enable_async_dispatch", False)
    learner = make_learner(
        arguments.algorithm,
        Spec(arguments.observation, arguments.action),
        arguments.seeds,
        actor_hidden_sizes=(arguments.width,) * 2,
        critic_hidden_sizes=(arguments.width,) * 2,
        batch_size=arguments.batch,
        replay_size=arguments.replay,
        update_interval=arguments.interval,
    )
    driver = Driver(learner, arguments.seeds)
    driver.run(0.5)
    speed = driver.run(arguments.seconds) * arguments.seeds
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"updates_per_second": speed, "peak_mib": peak}), flush=True)


if __name__ == "__main__":
    main()
