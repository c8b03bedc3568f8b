"""Where the time of training goes: in the environment, in the learner, in evaluation. One seed in one process.

The parts are timed inside a group as `csac train` has it, at the preset `paper`, after the compilation. An evaluation
is timed once, with the policy of that moment.
"""

from __future__ import annotations

import time
from contextlib import closing
from typing import TYPE_CHECKING, Any

from benchmarks.driver import make_settings
from csac.algorithms import ALGORITHMS
from csac.presets import hyperparameters
from csac.training.group import Group

if TYPE_CHECKING:
    from collections.abc import Callable

ALGORITHM, INTERVAL = "csac", 5_000
WARMUP = 100  # random steps; as many updates, the compilation among them, follow before the clock starts


class Timed:
    """A function that adds up the time spent in it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.seconds = function, 0.0

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        began = time.perf_counter()
        try:
            return self.function(*arguments)
        finally:
            self.seconds += time.perf_counter() - began


def measure(task: str, steps: int, episodes: int) -> dict[str, float]:
    """Return a training step's milliseconds and the shares of its parts, evaluations every 5,000 steps among them.

    A policy that falls or crashes soon has short episodes. `longest` is what it would be if every episode of an
    evaluation lasted to the task's time limit.
    """
    paper: dict[str, Any] = hyperparameters("paper", ALGORITHM, task)
    learner = ALGORITHMS[ALGORITHM](**{**paper, "replay_size": 100_000, "warmup_steps": WARMUP})
    last = 2 * WARMUP + steps
    settings = make_settings(learner, task, last + 1, evaluation_episodes=episodes)
    with closing(Group(settings, [0])) as group:
        _train(group, 2 * WARMUP)
        environment, learning = (_timed(part) for part in (group.environments, group.learner))
        elapsed = _train(group, last)
        group.evaluator._make_environments()  # which are made once
        began = time.perf_counter()
        found = group.evaluator.run(group.policies()[0])
        evaluation = time.perf_counter() - began
        length = sum(episode.length for episode in found) / len(found)
        limit = _longest_episode(group.environments.environments[0].raw) or length
    step, each = elapsed / steps, evaluation / INTERVAL
    whole, longest = step + each, step + each * limit / length
    return {
        "milliseconds": 1000 * whole,
        "environment": environment.seconds / steps / whole,
        "evaluation": each / whole,
        "longest_evaluation": 1 - step / longest,
        "rest": (elapsed - environment.seconds - learning.seconds) / steps / whole,
        "outside_update": 1 - learning.seconds / steps / whole,
        "longest_outside_update": 1 - learning.seconds / steps / longest,
    }


def _timed(part: Any) -> Timed:
    """Have the time taken of every `step` of a part of a group."""
    part.step = Timed(part.step)
    return part.step


def _train(group: Group, last: int) -> float:
    """Train to step `last` and return the seconds."""
    began = time.perf_counter()
    for _ in group.run(lambda: group.step == last):
        pass
    return time.perf_counter() - began


def _longest_episode(raw: Any) -> int | None:
    """Return the task's limit of steps; PyFlyt's tasks end by themselves."""
    return getattr(raw.spec, "max_episode_steps", None) or getattr(raw.unwrapped, "max_steps", None)
