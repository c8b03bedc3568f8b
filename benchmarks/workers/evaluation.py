"""What evaluation costs training, in line and in a process beside it: one seed on all cores.

In turns: training alone for a hundred steps, training while a process evaluates once, and evaluating once in line.
Episodes last as long as the task lets a policy of a few hundred updates.
"""

from __future__ import annotations

import time
from contextlib import closing
from statistics import median
from typing import Any

from benchmarks.driver import make_settings
from csac.algorithms import ALGORITHMS
from csac.evaluation.evaluator import Evaluator
from csac.evaluation.pool import EvaluationPool
from csac.presets import hyperparameters
from csac.training.group import Group

ALGORITHM, INTERVAL = "csac", 5_000
WARMUP, STEPS, NEVER = 150, 100, 10**9


def measure(task: str, seconds: float, episodes: int, environment_arguments: dict[str, Any]) -> dict[str, float]:
    """Return the share of time lost with so many episodes every 5,000 steps, of medians, and the speed of training.

    In line it is the evaluation's own time; beside training, that by which training is slower meanwhile.
    """
    paper: dict[str, Any] = hyperparameters("paper", ALGORITHM, task)
    learner = ALGORITHMS[ALGORITHM](**{**paper, "replay_size": 100_000, "warmup_steps": WARMUP})
    settings = make_settings(
        learner,
        task,
        100_000,
        environment_arguments=environment_arguments,
        evaluation_interval=NEVER,
        evaluation_episodes=episodes,
    )
    alone, slower, beside, in_line = [], [], [], []
    pool = EvaluationPool(Evaluator(task, environment_arguments, episodes), 1)
    with closing(Group(settings, [0])) as group, closing(pool):
        pool.start()
        for _ in range(3):
            _train(group, None)  # beyond the compilation
        _train(group, pool)
        group.evaluator.run(group.policies()[0])
        end = time.perf_counter() + seconds
        while time.perf_counter() < end or not in_line:
            steps, elapsed = _train(group, None)
            alone.append(elapsed / steps)
            steps, elapsed = _train(group, pool)
            slower.append(elapsed / steps)
            beside.append(elapsed)
            began = time.perf_counter()
            group.evaluator.run(group.policies()[0])
            in_line.append(time.perf_counter() - began)
    step, slow_step = median(alone), median(slower)
    return {
        "lost_in_line": median(in_line) / (INTERVAL * step + median(in_line)),
        "lost_beside": median(beside) * (1 - step / slow_step) / (INTERVAL * step),
        "steps_per_second_alone": 1 / step,
        "steps_per_second_beside": 1 / slow_step,
        "turns": len(alone),
    }


def _train(group: Group, pool: EvaluationPool | None) -> tuple[int, float]:
    """Train for `STEPS`, or for as long as the pool evaluates once; return the steps and the seconds."""
    began, first = time.perf_counter(), group.step
    running = pool.begin(list(group.policies().values())) if pool else None
    for _ in group.run(lambda: running.is_over if running else group.step == first + STEPS):
        pass
    if running:
        running.episodes(0)  # raises where it has failed
    return group.step - first, time.perf_counter() - began
