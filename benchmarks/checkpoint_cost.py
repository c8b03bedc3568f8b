"""What a checkpoint costs, in seconds and bytes, beside a replay of any size; and what looking for divergence costs.

    python benchmarks/checkpoint_cost.py --out results/reliability

Five seeds of CSAC at the paper's settings on HalfCheetah-v4's sizes. Each checkpoint follows 50,000 new transitions of
every seed, and is written as `train` writes it: every seed's files, then the list of them with its checksums.
"""

from __future__ import annotations

import argparse
import csv
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from csac import CSAC
from csac.tasks.seeds import Steps
from csac.training.checkpoint import Checkpoints, newest_sound
from csac.training.learner import Learner
from csac.training.seed_files import SeedFiles
from csac.types import Ring, Spec

SEEDS, NEW, CAPACITY = 5, 50_000, 1_000_000
HELD = (50_000, 100_000, 500_000, 1_000_000, 1_500_000)
SPEC = Spec(17, 6)


def size_of(folder: Path) -> int:
    """Return the bytes in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def checkpoint_costs(learner: Learner, folder: Path) -> list[dict[str, float]]:
    """Return a row per checkpoint measured: transitions held by then, seconds, bytes newly written."""
    memory = np.random.default_rng(0).normal(size=(CAPACITY, 43)).astype(np.float32)
    files = [SeedFiles(folder, seed, {}) for seed in range(SEEDS)]
    checkpoints, rows = Checkpoints(folder, 2), []
    for count in range(NEW, HELD[-1] + 1, NEW):
        before = {path for path in folder.rglob("*") if path.is_file()}
        began, saved = time.monotonic(), {}
        for seed, seed_files in enumerate(files):
            saved |= seed_files.write(count, learner.save(0), Ring(memory, count))
            assert f"step_{count}.seed_{seed}.safetensors" in saved
        written = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and path not in before)
        checkpoints.commit(count, saved, {})
        seconds = time.monotonic() - began
        if count in HELD:
            rows.append({"transitions": count, "seconds": seconds, "bytes": written, "folder_bytes": size_of(folder)})
    began = time.monotonic()
    assert newest_sound(folder)[0] is not None
    print(f"reading and checking all of the last one: {time.monotonic() - began:.1f} s")
    return rows


def divergence_share(learner: Learner) -> tuple[float, float]:
    """Return seconds of one look at every parameter, and of 250 updates."""
    observations, actions = np.zeros((1, 17), np.float32), np.zeros((1, 6), np.float32)
    flags = np.zeros(1, bool)
    outcome = Steps(observations, np.zeros(1, np.float32), flags, flags, observations, [], [])
    for step in range(1, 300):
        learner.step(observations, actions, outcome, step)
    began = time.monotonic()
    for step in range(300, 550):
        learner.step(observations, actions, outcome, step)
    updates = time.monotonic() - began
    began = time.monotonic()
    for _ in range(20):
        learner.first_bad(0)
    return (time.monotonic() - began) / 20, updates


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for checkpoint_cost.csv")
    parser.add_argument("--folder", type=Path, help="where to write the checkpoints; a temporary folder by default")
    arguments = parser.parse_args()
    learner = Learner(CSAC(warmup_steps=1, replay_size=100_000), SPEC, [0], 100_000)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        rows = checkpoint_costs(learner, Path(folder))
    print(f"{'transitions':>12} {'seconds':>8} {'MiB written':>12} {'MiB in all':>11}   ({SEEDS} seeds)")
    for row in rows:
        megabytes = row["bytes"] / 2**20, row["folder_bytes"] / 2**20
        print(f"{row['transitions']:>12,} {row['seconds']:>8.2f} {megabytes[0]:>12.1f} {megabytes[1]:>11.1f}")
    look, updates = divergence_share(learner)
    share = 100 * look / updates
    print(f"looking for divergence every 250 updates: {1e3 * look:.2f} ms of {updates:.2f} s, {share:.2f} %")
    arguments.out.mkdir(parents=True, exist_ok=True)
    with open(arguments.out / "checkpoint_cost.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    main()
