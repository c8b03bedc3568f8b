"""How steadily methods learn on one task: what a mean over seeds hides. docs/statistics.md defines each number."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from csac.record.curve_measures import area_under_curve, dispersion_within, drawdown
from csac.record.rendering import EMPTY, Cell, Row, Table
from csac.record.statistics import dispersion_across, evaluation_matrix, last_evaluations
from csac.record.summaries import over_seeds
from csac.record.summary_tables import plus_minus

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.studies.arms import Arm

HEADINGS = (
    "method",
    "worst seed",
    "drawdown",
    "dispersion across seeds",
    "dispersion within a run",
    "area under curve",
)


def stability_table(arms: Sequence[Arm], title: str) -> Table:
    """Return a row for each arm of a task; of what each seed has its own of, mean ± standard deviation over seeds."""
    return Table(HEADINGS, tuple(_row(arm) for arm in arms), title)


def _row(arm: Arm) -> Row:
    steps, _, returns = evaluation_matrix(arm.rows)
    return Row(
        (
            Cell(arm.label),
            _worst(last_evaluations(arm.rows)),
            plus_minus(over_seeds(map(drawdown, returns))),
            plus_minus(over_seeds([dispersion_across(returns)])),
            plus_minus(over_seeds(map(dispersion_within, returns))),
            plus_minus(over_seeds(area_under_curve(steps, line) for line in returns)),
        )
    )


def _worst(scores: dict[int, float]) -> Cell:
    known = {seed: score for seed, score in scores.items() if not math.isnan(score)}
    if not known:
        return EMPTY
    seed = min(known, key=lambda seed: known[seed])
    return Cell(f"{plus_minus(over_seeds([known[seed]])).text} (seed {seed})", known[seed])
