"""The cost of a checkpoint for different replay sizes: how long training pauses, and how much is written.

One seed of CSAC on HalfCheetah-v4 acts randomly and never updates, so that its replay fills quickly; networks and
optimisers are saved as usual.
"""

from __future__ import annotations

import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from benchmarks import stamps
from benchmarks.measuring import Launch, csac_command, failure, read_stamps, started, surroundings, usable_cores
from benchmarks.part import Options, Part
from benchmarks.tables import Row, formatted

if TYPE_CHECKING:
    from collections.abc import Mapping

EVERY = 250  # steps between two time stamps
HELD = [1, 2, 10, 20, 30]  # checkpoints that get a row in the table; the replay is full at the 20th

Files: TypeAlias = dict[Path, int]  # bytes by file


def measure(_: str, options: Options) -> list[Row]:
    """Train until the last checkpoint in HELD is written, and return a row for each of them."""
    interval, held = (2_000, HELD[:2]) if options.quick else (50_000, HELD)
    words = f"--warmup-steps 10000000 --steps 10000001 --checkpoint-interval {interval} --evaluation-interval 0".split()
    launch, seen = Launch([*csac_command("csac"), *words], usable_cores()), {}
    with tempfile.TemporaryDirectory() as written:
        told = {stamps.FOLDER: written, stamps.EVERY: str(EVERY), "XDG_STATE_HOME": written}
        with started([launch], surroundings(**told)) as (folder, (process,)):
            while (at := steps_in(found := read_stamps(Path(written))) / interval) < held[-1] + 0.8:
                if process.poll() is not None:
                    raise failure(folder, process)
                if 0.2 < at % 1 < 0.8:  # not close to a checkpoint being written
                    seen[int(at)] = _files(folder)
                time.sleep(0.1)
    return [row(count, interval, found[0], seen) for count in held]


def steps_in(found: list[np.ndarray]) -> int:
    """Return the number of steps of the single environment."""
    return int(found[0][-1, 0]) if found else 0


def row(count: int, interval: int, stamp: np.ndarray, seen: Mapping[int, Files]) -> Row:
    """Return the cost of checkpoint number `count`: the extra time of the steps around it, and the bytes written."""
    at = int(np.searchsorted(stamp[:, 0], count * interval))
    seconds = float(stamp[at + 1, 1] - stamp[at - 1, 1] - 2 * np.median(np.diff(stamp[:, 1])))
    before, after = seen.get(count - 1, {}), seen.get(count, {})
    new = sum(size for path, size in after.items() if path not in before)
    return {"transitions": count * interval, "seconds": seconds, "bytes": new, "folder_bytes": sum(after.values())}


def _files(folder: Path) -> Files:
    files = {}
    for path in folder.rglob("checkpoint/**/*"):
        with suppress(FileNotFoundError):  # replaced in the meantime
            if path.is_file():
                files[path] = path.stat().st_size
    return files


def render(rows: list[Row]) -> str:
    """Return a row for each checkpoint."""
    columns = {
        "transitions held": "{transitions:,}",
        "seconds": "{seconds:.2f}",
        "MiB written": "{written:.0f}",
        "MiB in the folder": "{held:.0f}",
    }
    sizes = [{"written": row["bytes"] / 2**20, "held": row["folder_bytes"] / 2**20} for row in rows]
    return formatted([row | size for row, size in zip(rows, sizes, strict=True)], columns)


PARTS = [Part("checkpoint", "benchmarks/README.md", "seconds and bytes", ["one seed"], measure, render)]
