"""Measure how long `csac` takes to start: its help, a refusal, and the time from launch to the first update.

    python benchmarks/start.py                       # two minutes on a quiet machine; prints a table
    python benchmarks/start.py --seeds 1 --repetitions 5

Each measurement is a process of its own. The first update of every seed comes after 250 uniform random steps, with the
networks and the replay of the preset `paper`.
"""

from __future__ import annotations

import argparse
import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

TASK = "HalfCheetah-v4"
WARMUP = 250  # csac tells its progress every 250 steps, and its first update is at this one
COMMANDS = (
    ["--help"],
    ["evaluate", "--help"],
    ["train", "--help"],
    ["train", TASK, "--stepz", "3"],  # a mistake
)


class FirstUpdate(Exception):
    """Every seed has made its first update."""


def train_until_first_update(seeds: str) -> None:
    """Be `csac train` until then, and print the time."""
    from csac.cli import main
    from csac.console import progress

    class Watch(progress.Reporter):
        def progress(self, steps_by_seed: Mapping[int, int]) -> None:
            if min(steps_by_seed.values()) >= WARMUP:
                raise FirstUpdate

    progress.Reporter = Watch
    try:
        main(["train", TASK, "--preset", "paper", "--warmup-steps", str(WARMUP), "--seeds", seeds])
    except FirstUpdate:
        print(f"first update at {time.monotonic()}")


def measure_command(arguments: Sequence[str], surroundings: Mapping[str, str], folder: Path) -> float:
    """Return how long a command takes that trains nothing, in seconds."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-m", "csac", *arguments], cwd=folder, env=surroundings, capture_output=True)
    return time.monotonic() - began


def measure_first_update(seeds: int, surroundings: Mapping[str, str], folder: Path) -> float:
    """Return the time from launch to the first update of every seed, in seconds."""
    command = [sys.executable, __file__, "--train-until-first-update", str(seeds)]
    began = time.monotonic()
    done = subprocess.run(command, cwd=folder, env=surroundings, capture_output=True, text=True)
    last = done.stdout.splitlines()[-1:]
    if not last or not last[0].startswith("first update at "):
        sys.exit(f"{' '.join(command)} failed:\n{done.stderr[-3000:]}")
    return float(last[0].rpartition(" ")[2]) - began


def run(numbers_of_seeds: Sequence[int], repetitions: int, folder: Path) -> dict[str, list[float]]:
    """Return the seconds of every repetition of every measurement; they take turns."""
    surroundings = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    # Python's bytecode is kept as well, wherever csac is installed.
    surroundings.pop("PYTHONDONTWRITEBYTECODE", None)
    surroundings["PYTHONPYCACHEPREFIX"] = str(folder / "bytecode")
    caches = (folder / f"cache_{number}" for number in itertools.count())

    def first_update(seeds: int, cache: Path, **others: str) -> float:
        return measure_first_update(seeds, {**surroundings, "XDG_CACHE_HOME": str(cache), **others}, folder)

    taken: dict[str, list[float]] = {}

    def note(name: str, seconds: float) -> None:
        taken.setdefault(name, []).append(seconds)
        print(f"{name}: {seconds:.2f} s", file=sys.stderr, flush=True)

    note("first update, 1 seed, without Python's bytecode", first_update(1, next(caches)))
    for _ in range(repetitions):
        for arguments in COMMANDS:
            note(f"`csac {' '.join(arguments)}`", measure_command(arguments, surroundings, folder))
        for seeds in numbers_of_seeds:
            what, cache = f"first update, {seeds} seed{'s' * (seeds > 1)}", next(caches)
            note(f"{what}, nothing kept", first_update(seeds, cache))
            note(f"{what}, programs kept", first_update(seeds, cache))
    return taken


def markdown(taken: Mapping[str, Sequence[float]]) -> str:
    """Return a table of medians, smallest and largest."""
    lines = ["| | seconds |", "| --- | --- |"]
    for name, seconds in taken.items():
        spread = f" ({min(seconds):.1f} to {max(seconds):.1f})" if len(seconds) > 1 else ""
        lines.append(f"| {name} | {statistics.median(seconds):.2f}{spread} |")
    packages = ", ".join(f"{name} {version(name)}" for name in ("jax", "gymnasium", "mujoco"))
    return "\n".join([*lines, "", f"- {os.cpu_count()} cores, {packages}, csac {version('csac')}"])


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 5])
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--train-until-first-update", metavar="SEEDS", help="be one measurement")
    arguments = parser.parse_args()
    if arguments.train_until_first_update:
        train_until_first_update(arguments.train_until_first_update)
        return
    with tempfile.TemporaryDirectory() as folder:
        print(markdown(run(arguments.seeds, arguments.repetitions, Path(folder))))


if __name__ == "__main__":
    main()
