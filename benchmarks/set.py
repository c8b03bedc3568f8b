"""Five seeds of SAC on two cores: seed-steps per second of one command, from launch to exit.

The command first runs for a few steps, so that its compiled programs are cached.
"""

from __future__ import annotations

import statistics
import sys

from benchmarks.measuring import TASK, time_command
from benchmarks.part import Options, Part
from benchmarks.tables import Row, table, with_range

SEEDS, WARM_UP = 5, 300  # updates begin at step 250


def command(steps: int) -> list[str]:
    """Return the timed command; it evaluates only at its last step."""
    words = f"--algorithm sac --preset paper --warmup-steps 250 --seeds {SEEDS} --steps {steps} --directory run"
    evaluation = f"--evaluation-interval {steps} --evaluation-episodes 1"
    return [sys.executable, "-m", "csac", "train", TASK, *words.split(), *evaluation.split()]


def measure(_: str, options: Options) -> list[Row]:
    """Time the training of five seeds."""
    steps = WARM_UP if options.quick else 5_000
    time_command(command(WARM_UP), cores=2)
    seconds = time_command(command(steps), cores=2)
    return [{"seeds": SEEDS, "steps": steps, "seconds": seconds, "seed_steps_per_second": SEEDS * steps / seconds}]


def render(rows: list[Row]) -> str:
    """Return the median time and speed, and the range of the speed."""
    speeds = with_range([row["seed_steps_per_second"] for row in rows], ".0f")
    seconds = f"{statistics.median(row['seconds'] for row in rows):.1f}"
    line = [f"`csac train --seeds {rows[0]['seeds']}`", f"{rows[0]['steps']:,}", seconds, speeds]
    return table(["", "steps of each seed", "seconds", "seed-steps/s"], [line])


PARTS = [Part("set", "benchmarks/README.md", "five seeds in one command", ["five seeds"], measure, render, 3)]
