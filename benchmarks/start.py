"""Start-up time of `csac`: of its help, and from launch to the first update of every seed."""

from __future__ import annotations

import sys
import tempfile
from typing import NamedTuple

from benchmarks.measuring import (
    TASK,
    Launch,
    Window,
    csac_command,
    time_command,
    time_training,
    usable_cores,
)
from benchmarks.part import Options, Part
from benchmarks.tables import Row, grouped, table, with_range


class Start(NamedTuple):
    """A command without training, or training with this many seeds."""

    name: str
    arguments: tuple[str, ...] = ()
    seeds: int = 0
    code: int = 0


STARTS = [
    Start("`csac --help`", ("--help",)),
    Start("`csac evaluate --help`", ("evaluate", "--help")),
    Start("`csac train --help`", ("train", "--help")),
    Start("a mistake in `csac train`", ("train", TASK, "--stepz", "3"), code=2),
    Start("first update, 1 seed", seeds=1),
    Start("first update, 5 seeds", seeds=5),
]


def measure(start: Start, options: Options) -> list[Row]:
    """Return the seconds of a command, or the seconds to the first update without and with cached programs."""
    with tempfile.TemporaryDirectory() as cache:
        if start.arguments:
            command = [sys.executable, "-m", "csac", *start.arguments]
            return [{"what": start.name, "seconds": time_command(command, start.code, XDG_CACHE_HOME=cache)}]
        return [
            {"what": f"{start.name}, {kept}", "seconds": first_update(start.seeds, cache)}
            for kept in ("nothing kept", "programs kept")
        ]


def first_update(seeds: int, cache: str) -> float:
    """Return the seconds from launch to the first update of all seeds."""
    launch = Launch(csac_command("csac", seeds=seeds), usable_cores())
    return time_training([launch], Window(0.0, settled=250), seeds, XDG_CACHE_HOME=cache)["start_seconds"]


def render(rows: list[Row]) -> str:
    """Return medians and ranges."""
    starts = grouped(rows, "what").items()
    lines = [[what, with_range([row["seconds"] for row in mine], ".2f")] for (what,), mine in starts]
    return table(["", "seconds"], lines)


PARTS = [Part("start", "benchmarks/README.md", "to help, and to the first update", STARTS, measure, render, 3)]
