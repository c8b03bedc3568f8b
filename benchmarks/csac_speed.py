"""One measurement of csac, in a process of its own: `csac.train`, timed from outside by its reporter.

`speed.py` runs this; it prints one line of JSON. The scripts of the peers take the same arguments.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import multiprocessing
import os
import sys
import time
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from csac import train
from csac.algorithms import ALGORITHMS
from csac.console.progress import Reporter
from csac.presets import hyperparameters

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

STEPS = 1_000_000  # never reached: it sizes the replay as the paper has it
SLACK = 0.02  # of an update interval, by which a window may differ from a whole number of them


class Measured(Exception):
    """The window is over."""


class Clock(Reporter):
    """Shows progress to nobody and notes when each part of it was heard of."""

    def __init__(self, arguments: argparse.Namespace, update_interval: int) -> None:
        super().__init__(Console(file=open(os.devnull, "w")))  # noqa: SIM115
        self.arguments, self.update_interval = arguments, update_interval
        self.start_seconds = self.peak_mib = 0.0
        self.times: list[float] = []
        self.totals: list[int] = []  # environment steps of all seeds together

    def progress(self, steps_by_seed: Mapping[int, int]) -> None:
        """Raise `Measured` once the window has lasted its seconds and its steps and holds whole update intervals."""
        super().progress(steps_by_seed)
        now, arguments = time.monotonic(), self.arguments
        slowest = min(steps_by_seed.values())
        if not self.start_seconds and slowest >= arguments.warmup:
            self.start_seconds = now - arguments.launched
        if slowest < arguments.settled:
            return
        self.times.append(now)
        self.totals.append(sum(steps_by_seed.values()))
        steps = self.totals[-1] - self.totals[0]
        if now - self.times[0] >= arguments.seconds and steps >= arguments.steps and self._is_whole(steps):
            self.peak_mib = peak_mib()  # while the workers live
            raise Measured

    def _is_whole(self, steps: int) -> bool:
        """Return whether there was one update for every `update_interval` steps, near enough.

        Progress is heard of every 250 steps. PPO's interval is 2048, and 41 reports are 10 steps more than 5 intervals.
        """
        intervals = round(steps / self.update_interval)
        return abs(steps - intervals * self.update_interval) <= SLACK * self.update_interval

    def steps_per_second(self) -> float:
        """Return steps over time, of several groups the slope of a line through their progress.

        Groups report a few hundred steps at once, so the window's two ends alone would be off by that much.
        """
        times, totals = np.subtract(self.times, self.times[0]), np.asarray(self.totals)
        if self.arguments.seeds == 1:
            return float((totals[-1] - totals[0]) / times[-1])
        return float(np.polyfit(times, totals, 1)[0])


def peak_mib() -> float:
    """Return the largest resident size of this process and of each of its workers, added up."""
    processes = [os.getpid(), *(child.pid for child in multiprocessing.active_children())]
    return sum(_peak_kib(process) for process in processes if process) / 1024


def _peak_kib(process: int) -> int:
    with open(f"/proc/{process}/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmHWM:"))


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the arguments that `speed.py` gives."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--algorithm", choices=ALGORITHMS, required=True)
    parser.add_argument("--task", required=True)
    parser.add_argument("--seeds", type=int, required=True)
    parser.add_argument("--launched", type=float, required=True, help="time.monotonic() when this process was started")
    parser.add_argument("--warmup", type=int, required=True, help="uniform random steps before the first update")
    parser.add_argument("--settled", type=int, required=True, help="steps of each seed before the window begins")
    parser.add_argument("--seconds", type=float, required=True, help="the window lasts at least this long")
    parser.add_argument("--steps", type=int, required=True, help="the window has at least so many steps")
    parser.add_argument("--evaluation-interval", type=int, required=True, help="0 for no evaluation")
    parser.add_argument("--evaluation-episodes", type=int, required=True)
    parser.add_argument("--interval", type=int, required=True, help="environment steps, and updates, in one dispatch")
    parser.add_argument("--device", choices=("cpu", "gpu"), required=True)
    return parser.parse_args(arguments)


def main() -> None:
    """Train until the window is over and print what was measured."""
    arguments = parse()
    paper = hyperparameters("paper", arguments.algorithm, arguments.task)
    algorithm = ALGORITHMS[arguments.algorithm](**paper)
    if algorithm.cadence.warmup_steps:
        algorithm = dataclasses.replace(algorithm, warmup_steps=arguments.warmup, update_interval=arguments.interval)
    clock = Clock(arguments, algorithm.cadence.update_interval)
    try:
        train(
            algorithm,
            arguments.task,
            steps=STEPS,
            seeds=arguments.seeds,
            directory="run",
            device=arguments.device,
            groups=None,
            evaluation_interval=arguments.evaluation_interval or STEPS,
            evaluation_episodes=arguments.evaluation_episodes,
            reporter=clock,
        )
    except Measured:
        result = {
            "start_seconds": clock.start_seconds,
            "steps": clock.totals[-1] - clock.totals[0],
            "seconds": clock.times[-1] - clock.times[0],
            "steps_per_second": clock.steps_per_second(),
            "peak_mib": clock.peak_mib,
        }
        print(json.dumps(result), flush=True)
    else:
        sys.exit("training ended before the window did")


if __name__ == "__main__":
    main()
