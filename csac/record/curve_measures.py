"""What one seed's learning curve tells: its area, when it reached a return, how far it fell, how it recovered.

A curve is `steps` [t] in order and `returns` [t], each the mean over one evaluation's episodes; docs/statistics.md
defines each measure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csac.record.statistics import evaluation_matrix

REGAINED = 0.9  # of the return before a perturbation: the policy is back


def area_under_curve(steps: np.ndarray, returns: np.ndarray) -> float:
    """Mean height of a curve between its first and its last evaluation, by trapezoids, in units of the return.

    Fast learning and a high end both raise it. NaNs are left out; NaN below two evaluations.
    """
    known = ~np.isnan(returns)
    steps, returns = steps[known], returns[known]
    if len(steps) < 2:
        return np.nan
    return float(np.trapezoid(returns, steps) / (steps[-1] - steps[0]))


def steps_to_reach(steps: np.ndarray, returns: np.ndarray, threshold: float) -> float:
    """Environment steps at the first evaluation at `threshold` or above; infinite where none is: "not reached".

    An infinite number says that it took longer than the curve is, and no more: take medians over seeds, not means.
    """
    reached = returns >= threshold  # never where it is NaN
    return float(steps[int(reached.argmax())]) if reached.any() else np.inf


def drawdown(returns: np.ndarray) -> float:
    """Largest fall from the highest return so far to a later one; 0 of a curve that never falls, NaN of none."""
    known = returns[~np.isnan(returns)]
    return float((np.maximum.accumulate(known) - known).max()) if len(known) else np.nan


def dispersion_within(returns: np.ndarray) -> float:
    """Interquartile range of the changes from one evaluation to the next: how restless learning is.

    The differences remove the trend. NaN below three evaluations. After Chan et al. 2020, "Measuring the Reliability of
    Reinforcement Learning Algorithms" (dispersion across time), over the whole curve in place of a sliding window.
    """
    changes = np.diff(returns[~np.isnan(returns)])
    if len(changes) < 2:
        return np.nan
    low, high = np.quantile(changes, [0.25, 0.75])
    return float(high - low)


class Recovery(NamedTuple):
    """What a perturbation did to the returns of one seed, and how they came back. NaN where nothing can be told."""

    before: float
    """Mean return of the last three evaluations up to and including the perturbation's step."""
    drop: float
    """`before` minus the lowest return after it, 0 where none is lower."""
    relative_drop: float
    """The drop as a share of |before|."""
    steps_to_regain: float
    """Environment steps from the perturbation to 90 % of `before`: 0 if no evaluation fell below, infinite if never."""
    area_lost: float
    """Integral of max(0, before - return) over the steps after the perturbation, in return times steps."""
    final: float
    """Mean return of the last three evaluations after the perturbation, or of all where none is after it."""
    worst_drawdown: float
    """The largest fall from the highest return so far, over the whole curve, before the perturbation and after it."""


def recovery(rows: np.ndarray, step: int, until: int | None = None, since: int = -1) -> dict[int, Recovery]:
    """Return each seed's `Recovery` from a perturbation after `step`, of the rows of evaluations.csv until `until`.

    What came until `since`, where the perturbation before it was, is no return before this one; an evaluation at `step`
    itself still is. Of a negative return before, -100, 90 % are -110: `before` less a tenth of its size. The steps to
    regain that end at the first evaluation that reaches it after the first one that did not. The area is the
    trapezoids' between evaluations, beginning with no loss at `step`. Last evaluations are fewer than three where there
    are no more; those of a seed that are NaN or missing are left out.
    """
    steps, seeds, returns = evaluation_matrix(rows)
    wanted = steps <= (steps.max(initial=0) if until is None else until)
    there = ~np.isnan(returns) & wanted
    return {
        int(seed): _recovery(steps[known], line[known], step, since)
        for seed, line, known in zip(seeds, returns, there, strict=True)
        if known.any()
    }


def _recovery(steps: np.ndarray, returns: np.ndarray, step: int, since: int) -> Recovery:
    is_before, is_after = (since < steps) & (steps <= step), steps > step
    before = returns[is_before][-3:].mean() if is_before.any() else np.nan
    final = (returns[is_after] if is_after.any() else returns)[-3:].mean()
    worst = drawdown(returns)
    if np.isnan(before) or not is_after.any():
        return Recovery(*map(float, (before, np.nan, np.nan, np.nan, np.nan, final, worst)))
    steps, after = steps[is_after], returns[is_after]
    drop = max(before - after.min(), 0.0)
    shortfall = np.maximum(before - after, 0.0)
    area = np.trapezoid([0.0, *shortfall], [step, *steps])
    time = _time_to_regain(steps - step, after, (REGAINED if before >= 0 else 2 - REGAINED) * before)
    relative = drop / abs(before) if before else np.nan
    return Recovery(*map(float, (before, drop, relative, time, area, final, worst)))


def _time_to_regain(times: np.ndarray, returns: np.ndarray, threshold: float) -> float:
    """Return the time of the first return at the threshold or above after the first below it."""
    below = returns < threshold
    if not below.any():
        return 0.0
    fallen = int(below.argmax())
    back = ~below[fallen:]
    return float(times[fallen + int(back.argmax())]) if back.any() else np.inf
