"""When `csac train` makes its first update, on the machine's clock."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from benchmarks.measuring import REPORT_STEPS, TASK
from csac.cli import main
from csac.console import progress

if TYPE_CHECKING:
    from collections.abc import Mapping


class FirstUpdate(Exception):
    """Every seed has made its first update."""


class Watch(progress.Reporter):
    """Ends training then."""

    def progress(self, steps_by_seed: Mapping[int, int]) -> None:
        """Raise `FirstUpdate` once every seed has made it."""
        if min(steps_by_seed.values()) >= REPORT_STEPS:
            raise FirstUpdate


def measure(seeds: int) -> dict[str, float]:
    """Be `csac train` until the first update of every seed, and return `time.monotonic()` of then."""
    progress.Reporter = Watch
    try:
        main(["train", TASK, "--preset", "paper", "--warmup-steps", str(REPORT_STEPS), "--seeds", str(seeds)])
    except FirstUpdate:
        return {"first_update": time.monotonic()}
    raise RuntimeError("training ended before its first update")
