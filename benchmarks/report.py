"""From measurements to a table in Markdown: medians, ranges, and ratios of what was measured in the same repetition."""

from __future__ import annotations

import csv
import statistics
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


class Measurement(NamedTuple):
    """What one process, or the processes that run side by side, did in one window."""

    repetition: int
    setting: str
    contender: str
    allowed: str  # what does its arithmetic, and on how many cores or threads
    steps_per_second: float  # environment steps, each with its update, of all seeds together
    steps: int
    seconds: float
    start_seconds: float  # from launching the process to its first update: imports, compilation, warm-up
    peak_mib: float  # resident memory, all processes together
    other_load: float  # processors that other programs kept busy meanwhile, the hypervisor's share included


class Reach(NamedTuple):
    """A ratio that is to be reached between two contenders of one setting."""

    setting: str
    contender: str
    peer: str
    ratio: float


def ratios(measurements: Sequence[Measurement], setting: str, contender: str, peer: str) -> list[float]:
    """Return the ratio of steps per second, one for each repetition that has both."""
    ours, theirs = (
        {m.repetition: m.steps_per_second for m in measurements if (m.setting, m.contender) == (setting, name)}
        for name in (contender, peer)
    )
    return [ours[repetition] / theirs[repetition] for repetition in sorted(ours.keys() & theirs.keys())]


def markdown(measurements: Sequence[Measurement], reaches: Sequence[Reach], machine: Sequence[str]) -> str:
    """Return the whole report: what was to be reached, everything measured, and on what."""
    parts = [_reached(measurements, reaches), _measured(measurements), "\n".join(f"- {line}" for line in machine)]
    return "\n\n".join(part for part in parts if part) + "\n"


def write_csv(path: Path, measurements: Sequence[Any]) -> None:
    """Write one row for each measurement, a named tuple, in the order in which they were made."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(measurements[0]._fields)
        for measurement in measurements:
            writer.writerow([f"{value:.4g}" if isinstance(value, float) else value for value in measurement])


def write_between_markers(path: Path, text: str, name: str = "measured") -> None:
    """Replace what stands between the markers `name` of the Markdown file `path`, which is made if there is none."""
    start, stop = (f"<!-- {name}: {end} -->" for end in ("begin", "end"))
    before = path.read_text() if path.exists() else f"{start}\n{stop}\n"
    head, begin, rest = before.partition(start)
    _, end, tail = rest.partition(stop)
    if not (begin and end):
        raise SystemExit(f"{path} lacks the lines {start} and {stop}, between which the table goes")
    path.write_text(f"{head}{start}\n{text}{stop}{tail}")


def _reached(measurements: Sequence[Measurement], reaches: Sequence[Reach]) -> str:
    rows = []
    for setting, contender, peer, wanted in reaches:
        if found := ratios(measurements, setting, contender, peer):
            ratio = statistics.median(found)
            verdict = "yes" if ratio >= wanted else "**no**"
            rows.append([setting, f"{contender} / {peer}", f">= {wanted}", _with_range(found, ".2f"), verdict])
    return table(["setting", "ratio of steps/s", "to reach", "measured", "reached"], rows) if rows else ""


def _measured(measurements: Sequence[Measurement]) -> str:
    rows = []
    for setting, contender in dict.fromkeys((m.setting, m.contender) for m in measurements):
        mine = [m for m in measurements if (m.setting, m.contender) == (setting, contender)]
        speeds = [m.steps_per_second for m in mine]
        first = next(m.contender for m in measurements if m.setting == setting)
        against = ratios(measurements, setting, first, contender)
        rows.append(
            [
                setting,
                contender,
                mine[0].allowed,
                _with_range(speeds, ".0f"),
                _with_range(against, ".2f") if against and contender != first else "",
                f"{statistics.median(m.start_seconds for m in mine):.1f}",
                f"{max(m.peak_mib for m in mine):.0f}",
            ]
        )
    head = ["setting", "", "allowed", "steps/s", "the setting's first / this", "start, s", "peak memory, MiB"]
    return table(head, rows)


def _with_range(values: Sequence[float], form: str) -> str:
    median = f"{statistics.median(values):{form}}"
    return f"{median} ({min(values):{form}} to {max(values):{form}})" if len(values) > 1 else median


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
