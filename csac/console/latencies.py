"""What is told of the time that artefacts take for an action."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from csac.console.tables import Fitted
from csac.record.rendering import EMPTY, Cell, Row, Table

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from csac.evaluation.latency import Latency

PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}


def latency_table(measured: Mapping[str, Sequence[Latency]]) -> Fitted:
    """Return the microseconds of single calls, a row for each artefact and way to call it."""
    headings = ("μs for one action", "calls", *PERCENTILES, "late: p99", "late: max")
    rows = [
        Row((Cell(f"{name}, {way_of(latency)}"), *map(_cell, [f"{len(latency.durations):,}", *latency_cells(latency)])))
        for name, several in measured.items()
        for latency in several
    ]
    return Fitted(Table(headings, tuple(rows), note="late: how long after its time a call began"))


def way_of(latency: Latency) -> str:
    """Return how calls followed each other."""
    return "flat out" if latency.rate is None else f"at {latency.rate:g} Hz"


def latency_cells(latency: Latency) -> list[str]:
    """Return the percentiles of the durations, and the two of the lateness, in microseconds."""
    late = ["", ""] if latency.lateness is None else _microseconds(latency.lateness, (99.0, 100.0))
    return _microseconds(latency.durations, PERCENTILES.values()) + late


def _cell(text: str) -> Cell:
    return Cell(text, float(text.replace(",", ""))) if text else EMPTY


def _microseconds(nanoseconds: np.ndarray, percentiles: Iterable[float]) -> list[str]:
    values = np.percentile(nanoseconds, list(percentiles), method="higher") / 1e3
    return [f"{value:.1f}" if value < 1000 else f"{value:,.0f}" for value in values]
