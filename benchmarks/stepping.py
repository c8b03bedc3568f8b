"""Steps per second of each task alone, random actions, resets included: what is left for learning is less.

python benchmarks/stepping.py [--seconds 5] [TASK ...]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from csac.tasks.environment import Environment

TASKS = ("HalfCheetah-v4", "Walker2d-v4", "Ant-v4", "Hopper-v4", "PyFlyt/QuadX-Waypoints-v1", "PandaReach-v3")


def steps_per_second(task: str, seconds: float) -> tuple[float, float]:
    """Return the speed over at least so many seconds, and the mean length of the episodes that ended."""
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
    return steps / elapsed, in_episodes / episodes


def main() -> None:
    """Print the table of docs/tasks.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", default=TASKS)
    parser.add_argument("--seconds", type=float, default=5.0)
    arguments = parser.parse_args()
    print("| task | steps/s | length of a random episode |\n|---|---|---|")
    for task in arguments.tasks:
        speed, length = steps_per_second(task, arguments.seconds)
        print(f"| {task} | {speed:,.0f} | {length:,.0f} |", flush=True)


if __name__ == "__main__":
    main()
