"""The speed of `csac.train`, timed from outside by its reporter. The scripts of the peers take the same arguments."""

from __future__ import annotations

import multiprocessing
import os
import time
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.console import Console

from benchmarks.measuring import ROLLOUT_STEPS, Window
from csac import train
from csac.algorithms import ALGORITHMS
from csac.console.progress import Reporter
from csac.presets import hyperparameters

if TYPE_CHECKING:
    from collections.abc import Mapping

STEPS = 1_000_000  # never reached: it sizes the replay as the paper has it
SLACK = 0.02  # of an update interval, by which a window may differ from a whole number of them


class Measured(Exception):
    """The window is over."""


class Clock(Reporter):
    """Shows progress to nobody and notes when each part of it was heard of."""

    def __init__(self, window: Window, launched: float, seeds: int, update_interval: int) -> None:
        super().__init__(Console(file=open(os.devnull, "w")))  # noqa: SIM115
        self.window, self.launched, self.seeds, self.update_interval = window, launched, seeds, update_interval
        self.start_seconds = self.peak_mib = 0.0
        self.times: list[float] = []
        self.totals: list[int] = []  # environment steps of all seeds together

    def progress(self, steps_by_seed: Mapping[int, int]) -> None:
        """Raise `Measured` once the window has lasted its seconds and its steps and holds whole update intervals."""
        super().progress(steps_by_seed)
        now, window = time.monotonic(), self.window
        slowest = min(steps_by_seed.values())
        if not self.start_seconds and slowest >= window.warmup:
            self.start_seconds = now - self.launched
        if slowest < window.settled:
            return
        self.times.append(now)
        self.totals.append(sum(steps_by_seed.values()))
        steps = self.totals[-1] - self.totals[0]
        if now - self.times[0] >= window.seconds and steps >= window.steps and self._is_whole(steps):
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
        if self.seeds == 1:
            return float((totals[-1] - totals[0]) / times[-1])
        return float(np.polyfit(times, totals, 1)[0])


def peak_mib() -> float:
    """Return the largest resident size of this process and of each of its workers, added up."""
    processes = [os.getpid(), *(child.pid for child in multiprocessing.active_children())]
    return sum(_peak_kib(process) for process in processes if process) / 1024


def _peak_kib(process: int) -> int:
    with open(f"/proc/{process}/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmHWM:"))


def measure(
    algorithm: str,
    task: str,
    preset: str,
    seeds: int,
    interval: int,
    device: Literal["cpu", "gpu"],
    launched: float,
    groups: int | None = None,
    **counted: Any,
) -> dict[str, float]:
    """Train until the window is over, and return what was measured.

    Args:
        algorithm: its name; it has the settings of the preset, but for the warm-up.
        task: a Gymnasium id.
        preset: paper or strong.
        seeds: how many are trained.
        interval: environment steps, and updates, in one dispatch; PPO's is its rollout.
        device: cpu or gpu.
        launched: `time.monotonic()` when this process was started.
        groups: the processes that the seeds are split over; None for as many as csac chooses.
        counted: the fields of `Window`.
    """
    window, settings = Window(**counted), hyperparameters(preset, algorithm, task)
    if algorithm == "ppo":
        interval = ROLLOUT_STEPS
    else:
        settings |= {"warmup_steps": window.warmup, "update_interval": interval}
    clock = Clock(window, launched, seeds, interval)
    try:
        train(
            ALGORITHMS[algorithm](**settings),
            task,
            steps=STEPS,
            seeds=seeds,
            directory="run",
            device=device,
            groups=groups,
            evaluation_interval=window.evaluation_interval or STEPS,
            evaluation_episodes=window.evaluation_episodes,
            reporter=clock,
        )
    except Measured:
        return {
            "start_seconds": clock.start_seconds,
            "steps": clock.totals[-1] - clock.totals[0],
            "seconds": clock.times[-1] - clock.times[0],
            "steps_per_second": clock.steps_per_second(),
            "peak_mib": clock.peak_mib,
        }
    raise RuntimeError("training ended before the window did")
