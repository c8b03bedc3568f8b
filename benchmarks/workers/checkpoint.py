"""What a checkpoint costs beside a replay of any size; and what looking for divergence costs.

CSAC at the paper's settings on HalfCheetah-v4's sizes. Each checkpoint follows as many new transitions of every seed,
and is written as `train` writes it: every seed's files, then the list of them with its checksums.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.driver import Driver, make_learner
from csac.training.checkpoint import Checkpoints, SeedFiles, newest_sound
from csac.types import Ring


def measure(seeds: int, new: int, capacity: int, held: list[int], updates: int = 250) -> dict[str, Any]:
    """Return a row for each checkpoint, and the seconds of reading the last one and of a look for divergence.

    Args:
        seeds: how many are saved.
        new: transitions of each seed between two checkpoints.
        capacity: the size of the replay, in transitions.
        held: after how many transitions of each seed a checkpoint makes a row.
        updates: between two looks for divergence.
    """
    driver = Driver(make_learner("csac", replay_size=min(capacity, 100_000)))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = _checkpoints(driver.learner, folder, seeds, new, capacity, held)
        began = time.monotonic()
        assert newest_sound(folder)[0] is not None
        reading = time.monotonic() - began
    driver.make(updates)
    of_updates = driver.make(updates)
    began = time.monotonic()
    for _ in range(20):
        driver.learner.first_bad(0)
    look = (time.monotonic() - began) / 20
    return {"rows": rows, "reading": reading, "look": look, "look_share": look / of_updates}


def _checkpoints(
    learner: Any, folder: Path, seeds: int, new: int, capacity: int, held: list[int]
) -> list[dict[str, float]]:
    memory = np.random.default_rng(0).normal(size=(capacity, 43)).astype(np.float32)
    files = [SeedFiles(folder, seed, {}) for seed in range(seeds)]
    checkpoints, rows = Checkpoints(folder, 2), []
    for count in range(new, held[-1] + 1, new):
        before = set(_sizes(folder))
        began, saved = time.monotonic(), {}
        for seed_files in files:
            saved |= seed_files.write(count, learner.save(0), Ring(memory, count))
        written = sum(size for path, size in _sizes(folder).items() if path not in before)
        checkpoints.commit(count, saved, {})
        seconds = time.monotonic() - began
        if count in held:
            sizes = {"bytes": written, "folder_bytes": sum(_sizes(folder).values())}
            rows.append({"transitions": count, "seconds": seconds, **sizes})
    return rows


def _sizes(folder: Path) -> dict[Path, int]:
    """Return the bytes of each file in a folder."""
    return {path: path.stat().st_size for path in folder.rglob("*") if path.is_file()}
