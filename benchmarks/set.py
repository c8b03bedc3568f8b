"""Five seeds of SAC on two cores: seed-steps per second of one command, from launch to exit.

The command is run once before, for a few steps, so that its compiled programs are kept.
"""

from __future__ import annotations

import statistics
import sys

from benchmarks.measuring import TASK, time_command
from benchmarks.part import Options, Part
from benchmarks.tables import Row, table, with_range

SEEDS, WARM_UP = 5, 300  # at 250 the updates begin


def command(steps: int) -> list[str]:
    """Return what is timed: it is evaluated at its last step alone."""
    words = f"--algorithm sac --preset paper --warmup-steps 250 --seeds {SEEDS} --steps {steps} --directory run"
    evaluation = f"--evaluation-interval {steps} --evaluation-episodes 1"
    return [sys.executable, "-m", "csac", "train", TASK, *words.split(), *evaluation.split()]


def measure(_: str, options: Options) -> list[Row]:
    """Train a set."""
    steps = WARM_UP if options.quick else 5_000
    time_command(command(WARM_UP), cores=2)
    seconds = time_command(command(steps), cores=2)
    return [{"seeds": SEEDS, "steps": steps, "seconds": seconds, "seed_steps_per_second": SEEDS * steps / seconds}]


def render(rows: list[Row]) -> str:
    """Return the medians and ranges."""
    speeds = with_range([row["seed_steps_per_second"] for row in rows], ".0f")
    seconds = f"{statistics.median(row['seconds'] for row in rows):.1f}"
    line = [f"`csac train --seeds {rows[0]['seeds']}`", f"{rows[0]['steps']:,}", seconds, speeds]
    return table(["", "steps of each seed", "seconds", "seed-steps/s"], [line])


PARTS = [Part("set", "benchmarks/README.md", "five seeds in one command", ["five seeds"], measure, render, 3)]
