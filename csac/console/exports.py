"""What is shown of artefacts: how exact and how good they are, and how long they take for an action."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from csac.console.tables import Fitted, number
from csac.record.rendering import EMPTY, Cell, Row, Table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from csac.deploy.latency import Latency

PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}


def export_lines(verification: Mapping[str, Any]) -> list[str]:
    """Return the lines that say how an artefact compares with its policy."""
    count, largest = verification["observations"], verification["largest_difference"]
    lines = [f"{count:,} observations: actions differ by at most {largest:.1e} of their range"]
    if returns := verification.get("returns"):
        through, without = (_mean(some) for some in (returns, verification["returns_of_the_run"]))
        lines.append(f"{returns['count']} episodes: mean return {through}; the run's policy {without}")
    return lines


def latency_table(measured: Mapping[str, Sequence[Latency]]) -> Fitted:
    """Return the microseconds of single calls, a row for each artefact and way to call it."""
    headings = ("μs for one action", "calls", *PERCENTILES, "late: p99", "late: max")
    rows = [
        Row((Cell(f"{name}, {_way(latency)}"), *map(_cell, [f"{len(latency.durations):,}", *latency_cells(latency)])))
        for name, several in measured.items()
        for latency in several
    ]
    return Fitted(Table(headings, tuple(rows), note="late: how long after its time a call began"))


def latency_cells(latency: Latency) -> list[str]:
    """Return the percentiles of the durations, and the two of the lateness, in microseconds."""
    late = ["", ""] if latency.lateness is None else _microseconds(latency.lateness, [99.0, 100.0])
    return _microseconds(latency.durations, [*PERCENTILES.values()]) + late


def _way(latency: Latency) -> str:
    return "flat out" if latency.rate is None else f"at {latency.rate:g} Hz"


def _mean(returns: Mapping[str, Any]) -> str:
    mean = returns["mean_return"]
    return f"{number(mean)} ± {number(returns['standard_deviation'] or 0.0, mean)}"


def _cell(text: str) -> Cell:
    return Cell(text, float(text.replace(",", ""))) if text else EMPTY


def _microseconds(nanoseconds: np.ndarray, percentiles: list[float]) -> list[str]:
    values = np.percentile(nanoseconds, percentiles, method="higher") / 1e3
    return [f"{value:.1f}" if value < 1000 else f"{value:,.0f}" for value in values]
