"""What an update costs as the run grows: with seeds, width, batch, observation, replay; a table and a log-log picture.

    make scaling          # writes scaling.csv, scaling.png and the tables of docs/performance.md

Seeds are trained as users train them, in as many processes as csac chooses. Everything else is one learner on all
cores, without an environment. Every measurement is a process of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from cases import Case
from products import operations, update_products
from report import table, write_between_markers, write_csv
from speed import Protocol, describe_processor, measure

HERE = Path(__file__).resolve().parent
ALGORITHM = "csac"
AXES: dict[str, list[int]] = {
    "seeds": [1, 2, 5, 10, 25],
    "width": [64, 128, 256, 512, 1024],
    "batch": [64, 128, 256, 512, 1024, 2048, 4096],
    "observation": [3, 17, 27, 105, 376],  # Pendulum, HalfCheetah, Ant, Ant with contact forces, Humanoid
    "replay": [10_000, 100_000, 1_000_000, 10_000_000],
}


class Point(NamedTuple):
    """One measurement."""

    axis: str
    value: int
    updates_per_second: float  # of all seeds together
    peak_mib: float  # all processes together
    giga_operations: float  # in the products of one update

    @property
    def milliseconds(self) -> float:
        """For one update."""
        return 1000 / self.updates_per_second


def measured(axis: str, value: int, seconds: float) -> Point:
    """Measure one point of an axis, everything else at the paper's settings."""
    if axis == "seeds":
        case = Case(f"{value} seeds", "csac", "csac", ALGORITHM, seeds=value)
        result = measure(case, 0, Protocol(seconds=seconds, seconds_of_five=seconds, settled=260))
        return Point(axis, value, result.steps_per_second, result.peak_mib, _cost())
    command = [sys.executable, HERE / "update_speed.py", "--algorithm", ALGORITHM, "--seconds", str(seconds)]
    with tempfile.TemporaryDirectory() as folder:
        answer = subprocess.run(
            [*command, f"--{axis}", str(value)],
            capture_output=True,
            text=True,
            check=True,
            cwd=folder,
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
        )
    found = json.loads(answer.stdout.splitlines()[-1])
    return Point(axis, value, found["updates_per_second"], found["peak_mib"], _cost(**{axis: value}))


def _cost(width: int = 256, batch: int = 256, observation: int = 17, replay: int = 0) -> float:
    return operations(update_products(ALGORITHM, (width, width), batch, observation)) / 1e9


def report(points: list[Point]) -> str:
    """Return a table for each axis; `growth` is what the time grows by where the operations grow by a factor."""
    parts = []
    for axis in dict.fromkeys(point.axis for point in points):
        mine = [point for point in points if point.axis == axis]
        rows = []
        for before, point in zip([None, *mine], mine, strict=False):
            growth = ""
            if before and axis != "seeds":
                operations_grew = point.giga_operations / before.giga_operations
                growth = f"{point.milliseconds / before.milliseconds:.2f} ({operations_grew:.2f})"
            rows.append(
                [
                    f"{point.value:,}",
                    f"{point.updates_per_second:.0f}",
                    f"{point.milliseconds:.2f}",
                    f"{point.giga_operations * point.updates_per_second:.0f}",
                    growth,
                    f"{point.peak_mib:,.0f}",
                ]
            )
        head = [axis, "updates/s", "ms for one", "10⁹ operations/s", "time x (operations x)", "peak memory, MiB"]
        parts.append(table(head, rows))
    return "\n\n".join(parts)


def draw(points: list[Point], path: Path) -> None:
    """Draw the time of one update against each axis, both logarithmic, beside what the operations alone would take."""
    from matplotlib.figure import Figure

    axes_names = list(dict.fromkeys(point.axis for point in points))
    figure = Figure(figsize=(3.0 * len(axes_names), 3.2), layout="constrained")
    panels = figure.subplots(1, len(axes_names), sharey=True, squeeze=False)[0]
    for panel, axis in zip(panels, axes_names, strict=True):
        mine = [point for point in points if point.axis == axis]
        values, times = [point.value for point in mine], [point.milliseconds for point in mine]
        panel.loglog(values, times, marker="o", color="#0072B2", label="measured")
        middle = min(mine, key=lambda point: abs(point.giga_operations - _cost()))
        ideal = [middle.milliseconds * point.giga_operations / middle.giga_operations for point in mine]
        panel.loglog(values, ideal, linestyle="--", color="#777777", label="in proportion to its operations")
        panel.set_xlabel({"seeds": "seeds, all together", "observation": "observation size"}.get(axis, axis))
        panel.grid(True, which="both", alpha=0.25)
    panels[0].set_ylabel("ms for one update")
    panels[0].legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Measure, print and, where asked, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for scaling.csv and scaling.png")
    parser.add_argument("--page", type=Path, help="Markdown file whose marked part becomes the tables")
    parser.add_argument("--axis", choices=AXES, action="append", help="only this one; may be given again")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each measurement")
    arguments = parser.parse_args()
    points = []
    for axis in arguments.axis or AXES:
        for value in AXES[axis]:
            points.append(measured(axis, value, arguments.seconds))
            point = points[-1]
            print(f"{axis} {value:,}: {point.milliseconds:.2f} ms, {point.peak_mib:,.0f} MiB", flush=True)
    text = f"{report(points)}\n\n{describe_processor()}\n"
    print(f"\n{text}")
    if arguments.out:
        write_csv(arguments.out / "scaling.csv", points)
        draw(points, arguments.out / "scaling.png")
    if arguments.page:
        write_between_markers(arguments.page, text, "scaling")


if __name__ == "__main__":
    main()
