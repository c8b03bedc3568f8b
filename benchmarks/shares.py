"""Where the time of training goes: in the environment, in the learner, in evaluation. One seed, one process, by task.

python benchmarks/shares.py [--algorithm csac] [--steps 200] [TASK ...]

The parts are timed inside a group as `csac train` has it, at the preset `paper`, after the compilation. An evaluation
of ten episodes is timed once, with the policy of that moment, and shared among the 5,000 steps that lie between two by
default. A policy that falls or crashes soon has short episodes: `longest` is the share if all ten lasted to their time
limit.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from contextlib import closing
from typing import TYPE_CHECKING, Any, NamedTuple

import jax

from csac.algorithms import ALGORITHMS
from csac.presets import hyperparameters
from csac.training.group import Group
from csac.training.messages import Settings

if TYPE_CHECKING:
    from collections.abc import Callable

TASKS = ("HalfCheetah-v4", "Walker2d-v4", "Ant-v4", "Hopper-v4", "PyFlyt/QuadX-Waypoints-v1", "PandaReach-v3")
INTERVAL, EPISODES = 5_000, 10
WARMUP = 100  # random steps; as many updates, the compilation among them, follow before the clock starts


class Shares(NamedTuple):
    """Microseconds of one training step, but for the evaluation's seconds and the mean length of its episodes."""

    step: float
    environment: float
    learner: float
    evaluation_seconds: float
    episode_length: float
    longest_length: float

    @property
    def evaluation(self) -> float:
        """An evaluation's share of one training step in microseconds."""
        return self.evaluation_seconds / INTERVAL * 1e6

    @property
    def longest_evaluation(self) -> float:
        """The same if every episode lasted to its time limit."""
        return self.evaluation * self.longest_length / self.episode_length


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


def _timed(part: Any) -> Timed:
    """Have the time taken of every `step` of a part of a group."""
    part.step = Timed(part.step)
    return part.step


def measure(task: str, algorithm: str, steps: int) -> Shares:
    """Train for `steps` after the warm-up, then evaluate once."""
    settings: dict[str, Any] = hyperparameters("paper", algorithm, task)
    learner = dataclasses.replace(ALGORITHMS[algorithm](**settings), replay_size=100_000)
    if learner.cadence.warmup_steps:
        learner = dataclasses.replace(learner, warmup_steps=WARMUP)
    last = 2 * WARMUP + steps
    with closing(Group(Settings(learner, task, {}, last + 1, INTERVAL, EPISODES), [0])) as group:
        for _ in group.run(lambda: group.step == 2 * WARMUP):
            pass
        environment, learning = (_timed(part) for part in (group.environments, group.learner))
        began = time.perf_counter()
        for _ in group.run(lambda: group.step == last):
            pass
        elapsed = time.perf_counter() - began
        policy = group.policies()[0]
        group.evaluator._make_environments()  # which are made once
        began = time.perf_counter()
        episodes = group.evaluator.run(policy)
        evaluation = time.perf_counter() - began
        raw = group.environments.environments[0].raw
        # PyFlyt's tasks end by themselves.
        limit = getattr(raw.spec, "max_episode_steps", None) or getattr(raw.unwrapped, "max_steps", None)
    lengths = [episode.length for episode in episodes]
    mean = sum(lengths) / len(lengths)
    per_step = 1e6 / steps
    return Shares(
        elapsed * per_step, environment.seconds * per_step, learning.seconds * per_step, evaluation, mean, limit or mean
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=TASKS)
    parser.add_argument("--algorithm", choices=ALGORITHMS, default="csac")
    parser.add_argument("--steps", type=int, default=200)
    arguments = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)  # as `train` does
    print("| task | step, ms | environment | evaluation (longest) | the rest | outside the update (longest) |")
    print("|---|---|---|---|---|---|")
    for task in arguments.tasks:
        s = measure(task, arguments.algorithm, arguments.steps)
        whole, longest = s.step + s.evaluation, s.step + s.longest_evaluation
        rest = s.step - s.environment - s.learner
        print(
            f"| {task} | {whole / 1000:.2f} | {s.environment / whole:.1%} "
            f"| {s.evaluation / whole:.1%} ({s.longest_evaluation / longest:.1%}) | {rest / whole:.1%} "
            f"| {1 - s.learner / whole:.1%} ({1 - s.learner / longest:.1%}) |",
            flush=True,
        )


if __name__ == "__main__":
    main()
