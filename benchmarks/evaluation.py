"""What evaluation costs training, in line and in a process beside it: one seed on all cores.

python benchmarks/evaluation.py TASK [--seconds 10] [--episodes 10] [--env-kwargs JSON]

In turns: training alone for a hundred steps, training while a process evaluates once, and evaluating once in line. From
the medians of these the share of time lost with so many episodes every 5,000 steps: in line it is the evaluation's own
time; beside training, that by which training is slower meanwhile. Episodes last as long as the task lets a policy of a
few hundred updates.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from contextlib import closing
from statistics import median
from typing import Any

import jax

from csac.algorithms import ALGORITHMS
from csac.evaluation.evaluator import Evaluator
from csac.evaluation.pool import EvaluationPool
from csac.presets import hyperparameters
from csac.training.group import Group
from csac.training.messages import Settings

INTERVAL, WARMUP, STEPS, NEVER = 5_000, 150, 100, 10**9


def train(group: Group, pool: EvaluationPool | None) -> tuple[int, float]:
    """Train for `STEPS`, or for as long as the pool evaluates once; return the steps and the seconds."""
    began, first = time.perf_counter(), group.step
    running = pool.begin(list(group.policies().values())) if pool else None
    for _ in group.run(lambda: running.is_over if running else group.step == first + STEPS):
        pass
    if running:
        running.episodes(0)  # raises where it has failed
    return group.step - first, time.perf_counter() - began


def measure(task: str, algorithm: str, seconds: float, episodes: int, environment_arguments: dict[str, Any]) -> None:
    """Print what was measured."""
    learner = dataclasses.replace(
        ALGORITHMS[algorithm](**hyperparameters("paper", algorithm, task)), replay_size=100_000, warmup_steps=WARMUP
    )
    settings = Settings(learner, task, environment_arguments, 100_000, NEVER, episodes)
    alone, beside, durations, in_line, lengths = [], [], [], [], []
    pool = EvaluationPool(Evaluator(task, environment_arguments, episodes), 1)
    with closing(Group(settings, [0])) as group, closing(pool):
        pool.start()
        for _ in range(3):
            train(group, None)  # beyond the compilation
        train(group, pool)
        group.evaluator.run(group.policies()[0])
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            steps, elapsed = train(group, None)
            alone.append(elapsed / steps)
            steps, elapsed = train(group, pool)
            beside.append(elapsed / steps)
            durations.append(elapsed)
            began = time.perf_counter()
            lengths += [episode.length for episode in group.evaluator.run(group.policies()[0])]
            in_line.append(time.perf_counter() - began)
    step, slower, duration, evaluation = map(median, (alone, beside, durations, in_line))
    lost_in_line = evaluation / (INTERVAL * step + evaluation)
    lost_beside = duration * (1 - step / slower) / (INTERVAL * step)
    print(
        f"{task}: {1 / step:.1f} steps/s alone, {1 / slower:.1f} while a process evaluates\n"
        f"  an evaluation (episodes of {sum(lengths) / len(lengths):.0f} steps) takes {evaluation:.2f} s in line, "
        f"{duration:.2f} s beside training\n"
        f"  lost with {episodes} episodes every {INTERVAL:,} steps: {lost_in_line:.1%} in line, "
        f"{lost_beside:.1%} beside (medians of {len(alone)} turns)",
        flush=True,
    )


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("--algorithm", choices=[name for name in ALGORITHMS if name != "ppo"], default="csac")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--env-kwargs", type=json.loads, default={})
    options = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)  # as `csac.train` does
    measure(options.task, options.algorithm, options.seconds, options.episodes, options.env_kwargs)


if __name__ == "__main__":
    main()
