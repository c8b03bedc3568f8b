"""Steps per second of a task alone, random actions, resets included: what is left for learning is less."""

from __future__ import annotations

import time

import numpy as np

from csac.tasks.environment import Environment


def measure(task: str, seconds: float) -> dict[str, float]:
    """Return the speed over at least so many seconds and one episode, and the mean length of those that ended."""
    environment = Environment(task)
    environment.reset(0)
    generator = np.random.default_rng(0)
    actions = generator.uniform(-1, 1, (1_000, environment.spec.action_size)).astype(np.float32)
    environment.step(actions[0])  # PyFlyt compiles in its first steps
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
