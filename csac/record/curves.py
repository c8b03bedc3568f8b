"""What a learning curve shows: lines and a band, as numbers. `plots` and reports draw the same ones.

Few seeds are shown as few: one or two as themselves, three and four with their range, more with an interval.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from csac.record.statistics import evaluation_matrix, mean_and_interval

if TYPE_CHECKING:
    from collections.abc import Sequence

FEWEST_FOR_BAND = 3  # seeds: two have no range that their lines do not show
FEWEST_FOR_INTERVAL_BAND = 5  # seeds: of three, a t-interval is so high that nothing else is seen

Spread = Literal["95 % t-interval", "± standard deviation"]
INTERVAL: Spread = "95 % t-interval"
DEVIATION: Spread = "± standard deviation"
Limits = tuple[float, float]
NEXT = " · "  # between two things that are to be known to read a picture
SHARE: Limits = (0.0, 1.0)  # of all episodes


class Curve(NamedTuple):
    """One run's evaluations: `returns` [seed, t] at `steps` [t], their `mean` [t], and a band from `low` to `high`."""

    label: str
    steps: np.ndarray
    seeds: np.ndarray
    returns: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    spread: Spread

    @property
    def has_band(self) -> bool:
        """Whether there are seeds enough for a band."""
        return len(self.seeds) >= FEWEST_FOR_BAND

    @property
    def shows_seeds(self) -> bool:
        """Whether each seed has a line of its own."""
        return 1 < len(self.seeds) < FEWEST_FOR_INTERVAL_BAND

    @property
    def band(self) -> str:
        """What the band is, nothing where there is none."""
        return "" if not self.has_band else "range" if self.shows_seeds else self.spread

    @property
    def legend(self) -> str:
        """Its label and how many seeds it has."""
        return f"{self.label} ({len(self.seeds)} seed{'s' * (len(self.seeds) > 1)})"


def curves_of(
    runs: Sequence[tuple[str, np.ndarray]], spread: Spread = INTERVAL, within: Limits | None = None
) -> list[Curve]:
    """Return the curve of each run, given as `(label, rows of evaluations.csv)`; one without returns has none.

    `spread` is what the band shows from five seeds on; it ends at the limits `within` which every value lies.
    """
    return [_curve(label, rows, spread, within) for label, rows in runs if not np.isnan(rows["return"]).all()]


def note(curves: Sequence[Curve]) -> str:
    """Say what lines and bands mean in a picture of these curves; nothing where there is one seed each."""
    if not any(len(curve.seeds) > 1 for curve in curves):
        return ""
    parts = ["line: mean over seeds"]
    if any(curve.shows_seeds for curve in curves):
        parts.append("thin: single seeds")
    bands = ["their range"] * any(curve.band == "range" for curve in curves)
    bands += dict.fromkeys(curve.band for curve in curves if curve.has_band and not curve.shows_seeds)
    if bands:
        parts.append("band: " + f", from {FEWEST_FOR_INTERVAL_BAND} seeds ".join(bands))
    return NEXT.join(parts)


def limits(curves: Sequence[Curve], within: Limits | None = None) -> Limits:
    """Return how far an axis goes: to show all seeds, and of the bands no more than a quarter beyond.

    Where all values lie `within` limits, it shows these.
    """
    if within:
        margin = 0.05 * (within[1] - within[0])
        return within[0] - margin, within[1] + margin
    lowest = min(float(np.nanmin(curve.returns)) for curve in curves)
    highest = max(float(np.nanmax(curve.returns)) for curve in curves)
    reach = 0.25 * (highest - lowest) or 1.0
    bands = [curve for curve in curves if curve.has_band]
    low = min((float(np.nanmin(curve.low)) for curve in bands), default=lowest)
    high = max((float(np.nanmax(curve.high)) for curve in bands), default=highest)
    margin = 0.2 * reach
    return max(min(low, lowest) - margin, lowest - reach), min(max(high, highest) + margin, highest + reach)


def last_step(curves: Sequence[Curve]) -> float:
    """Return how far the axis of steps goes: a little further than the last evaluation, so that its number fits."""
    return 1.015 * max((float(curve.steps.max()) for curve in curves), default=0.0) or 1.0


def _curve(label: str, rows: np.ndarray, spread: Spread, within: Limits | None) -> Curve:
    steps, seeds, returns = evaluation_matrix(rows)
    mean, low, high = mean_and_interval(returns)
    if len(seeds) < FEWEST_FOR_INTERVAL_BAND:
        low, high = np.fmin.reduce(returns), np.fmax.reduce(returns)
    elif spread == DEVIATION:
        deviation = _deviation(returns, mean)
        low, high = mean - deviation, mean + deviation
    if within:
        low, high = np.clip(low, *within), np.clip(high, *within)
    return Curve(label, steps, seeds, returns, mean, low, high, spread)


def _deviation(returns: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Standard deviation over the seeds that are there, NaN of one alone."""
    there = ~np.isnan(returns)
    freedom = there.sum(axis=0) - 1
    squares = np.where(there, returns - mean, 0.0) ** 2
    return np.where(freedom > 0, np.sqrt(squares.sum(axis=0) / np.maximum(freedom, 1)), np.nan)
