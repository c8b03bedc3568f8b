"""What is told of the time that artefacts take for an action."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from rich import box
from rich.table import Table

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from csac.evaluation.latency import Latency

PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}


def latency_table(measured: Mapping[str, Sequence[Latency]]) -> Table:
    """Return the microseconds of single calls, a row for each artefact and way to call it."""
    table = Table(box=box.SIMPLE, pad_edge=False)
    for heading in ("μs for one action", "calls", "", *PERCENTILES, "begun late: p99", "max"):
        table.add_column(heading, justify="left" if heading in ("μs for one action", "calls") else "right")
    for name, several in measured.items():
        for latency in several:
            table.add_row(name, way_of(latency), f"{len(latency.durations):,}", *latency_cells(latency))
    return table


def way_of(latency: Latency) -> str:
    """Return how calls followed each other."""
    return "flat out" if latency.rate is None else f"at {latency.rate:g} Hz"


def latency_cells(latency: Latency) -> list[str]:
    """Return the percentiles of the durations, and the two of the lateness, in microseconds."""
    late = ["", ""] if latency.lateness is None else _microseconds(latency.lateness, (99.0, 100.0))
    return _microseconds(latency.durations, PERCENTILES.values()) + late


def _microseconds(nanoseconds: np.ndarray, percentiles: Iterable[float]) -> list[str]:
    values = np.percentile(nanoseconds, list(percentiles), method="higher") / 1e3
    return [f"{value:.1f}" if value < 1000 else f"{value:,.0f}" for value in values]
