"""Steps per second of each task with random actions, without learning."""

from __future__ import annotations

import time

import numpy as np

from benchmarks.measuring import call
from benchmarks.part import Options, Part
from benchmarks.tables import Row

TASKS = ["HalfCheetah-v4", "Walker2d-v4", "Ant-v4", "Hopper-v4", "PyFlyt/QuadX-Waypoints-v1", "PandaReach-v3"]


def measure(task: str, options: Options) -> list[Row]:
    """Step one task on one core."""
    found = call("benchmarks.stepping:speed", cores=1, task=task, seconds=options.lasting(5.0))
    return [{"task": task, **found}]


def speed(task: str, seconds: float) -> dict[str, float]:
    """Return the speed over at least `seconds` and one episode, and the mean length of finished episodes."""
    from csac.tasks.environment import Environment

    environment = Environment(task)
    environment.reset(0)
    generator = np.random.default_rng(0)
    actions = generator.uniform(-1, 1, (1_000, environment.spec.action_size)).astype(np.float32)
    environment.step(actions[0])  # PyFlyt compiles during its first steps
    environment.reset(0)
    steps, in_episodes, episodes, began = 0, 0, 0, time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds or not episodes:
        _, _, terminated, truncated, _ = environment.step(actions[steps % len(actions)])
        steps += 1
        if terminated or truncated:
            episodes += 1
            in_episodes = steps
            environment.reset(episodes)
    environment.close()
    return {"steps_per_second": steps / elapsed, "episode_length": in_episodes / episodes}


COLUMNS = {
    "task": "{task}",
    "steps/s": "{steps_per_second:,.0f}",
    "length of a random episode": "{episode_length:,.0f}",
}
PARTS = [Part("stepping", "benchmarks/README.md", "each task alone", TASKS, measure, COLUMNS)]
