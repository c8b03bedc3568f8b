"""The cost of an update as seeds, network width, batch, observation or replay grow.

Seeds are trained by one command on two cores. The other axes use one learner on all cores, without an environment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.measuring import Launch, call, csac_command, time_training, usable_cores
from benchmarks.part import Options, Part
from benchmarks.products import operations, update_products
from benchmarks.tables import Row, grouped, table

if TYPE_CHECKING:
    from pathlib import Path

ALGORITHM = "csac"
AXES: dict[str, list[int]] = {
    "seeds": [1, 2, 5, 10, 25],
    "width": [64, 128, 256, 512, 1024],
    "batch": [64, 128, 256, 512, 1024, 2048, 4096],
    "observation": [3, 17, 27, 105, 376],  # Pendulum, HalfCheetah, Ant, Ant with contact forces, Humanoid
    "replay": [10_000, 100_000, 1_000_000, 10_000_000],
}


class Size(NamedTuple):
    """A value on one axis; all other settings are the paper's."""

    axis: str
    value: int

    @property
    def name(self) -> str:
        """The text that --only searches."""
        return f"{self.axis} {self.value:,}"


def measure(size: Size, options: Options) -> list[Row]:
    """Measure one point of an axis: updates per second, and the total peak memory of all processes."""
    if size.axis == "seeds":
        launch = Launch(csac_command(ALGORITHM, seeds=size.value), usable_cores()[:2])
        found = time_training([launch], options.window(20.0), seeds=size.value)
        speed, cost = found["steps_per_second"], giga_operations()
    else:
        changes: dict[str, Any] = {size.axis: size.value}
        found = call("benchmarks.updates:measure", algorithm=ALGORITHM, seconds=options.lasting(5.0), **changes)
        speed, cost = found["updates_per_second"], giga_operations(**changes)
    row = {"updates_per_second": speed, "peak_mib": found["peak_mib"], "giga_operations": cost}
    return [{"axis": size.axis, "value": size.value, **row}]


def giga_operations(width: int = 256, batch: int = 256, observation: int = 17, replay: int = 0) -> float:
    """Return the operations of one update, in 10⁹; the replay size does not change them."""
    return operations(update_products(ALGORITHM, (width, width), batch, observation)) / 1e9


def milliseconds(row: Row) -> float:
    """Return the time of one update."""
    return 1000 / row["updates_per_second"]


def render(rows: list[Row]) -> str:
    """Return a table for each axis; the second-last column is the growth of time and operations from row to row."""
    parts = []
    for (axis,), mine in grouped(rows, "axis").items():
        lines = []
        for before, row in zip([None, *mine], mine, strict=False):
            growth = ""
            if before and axis != "seeds":
                operations_grew = row["giga_operations"] / before["giga_operations"]
                growth = f"{milliseconds(row) / milliseconds(before):.2f} ({operations_grew:.2f})"
            speed = row["updates_per_second"]
            line = [f"{row['value']:,}", f"{speed:.0f}", f"{milliseconds(row):.2f}"]
            lines.append([*line, f"{row['giga_operations'] * speed:.0f}", growth, f"{row['peak_mib']:,.0f}"])
        head = [axis, "updates/s", "ms for one", "10⁹ operations/s", "time x (operations x)", "peak memory, MiB"]
        parts.append(table(head, lines))
    return "\n\n".join(parts)


def draw(rows: list[Row], path: Path) -> None:
    """Draw log-log plots of the time of one update against each axis, with a line in proportion to the operations."""
    from matplotlib.figure import Figure

    axes = grouped(rows, "axis")
    figure = Figure(figsize=(3.0 * len(axes), 3.2), layout="constrained")
    panels = figure.subplots(1, len(axes), sharey=True, squeeze=False)[0]
    for panel, ((axis,), mine) in zip(panels, axes.items(), strict=True):
        values, times = [row["value"] for row in mine], [milliseconds(row) for row in mine]
        panel.loglog(values, times, marker="o", color="#0072B2", label="measured")
        middle = min(mine, key=lambda row: abs(row["giga_operations"] - giga_operations()))
        scale = milliseconds(middle) / middle["giga_operations"]
        ideal = [scale * row["giga_operations"] for row in mine]
        panel.loglog(values, ideal, linestyle="--", color="#777777", label="in proportion to its operations")
        panel.set_xlabel({"seeds": "seeds, all together", "observation": "observation size"}.get(axis, axis))
        panel.grid(True, which="both", alpha=0.25)
    panels[0].set_ylabel("ms for one update")
    panels[0].legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=120)


SIZES = [Size(axis, value) for axis, values in AXES.items() for value in values]
PARTS = [Part("growth", "benchmarks/limit.md", "a table for each axis", SIZES, measure, render, draw=draw)]
