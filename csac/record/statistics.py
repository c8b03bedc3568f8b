"""Statistics over episodes, seeds and tasks, and of one learning curve, as defined in docs/statistics.md.

A curve is `steps` [t] in increasing order and `returns` [t], each the mean over one evaluation's episodes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

FEWEST_FOR_INTERVAL = 3  # seeds: with two, the t-interval is nine standard deviations to either side
FEWEST_FOR_BOOTSTRAP = 5  # seeds: fewer have too few distinct resamples to say anything
REGAINED = 0.9  # share of the return before a perturbation at which a policy has recovered


class Interval(NamedTuple):
    """A mean and the bounds of its confidence interval, NaN where there are too few values."""

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def evaluation_matrix(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `(steps [t], seeds [s], returns [s, t])`, each return the mean over that evaluation's episodes.

    A return is NaN where a seed was not evaluated at a step. `rows` are those of evaluations.csv.
    """
    steps, step_index = np.unique(rows["step"], return_inverse=True)
    seeds, seed_index = np.unique(rows["seed"], return_inverse=True)
    shape = (len(seeds), len(steps))
    cell = seed_index * len(steps) + step_index
    total = np.bincount(cell, weights=rows["return"], minlength=shape[0] * shape[1]).reshape(shape)
    episodes = np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape)
    return steps, seeds, _divide(total, episodes)


def is_case(values: np.ndarray) -> bool:
    """Return whether `values` [episode], NaN where an episode reported nothing, are all 0 or 1.

    Such values describe something that happens or does not, such as a crash. Tables do not distinguish bools from
    numbers, so this is the only definition; to compare several runs, apply it to all their values together.
    """
    known = values[~np.isnan(values)]
    return bool(len(known) and np.isin(known, (0.0, 1.0)).all())


def mean_over_episodes(values: np.ndarray, is_case: bool) -> float:
    """Return the mean over `values` [episode], NaN where an episode reported nothing.

    In a case, such a NaN counts as 0: many tasks report a success or a crash only when there is one. For other numbers
    it is unknown, and left out. The mean is NaN if no value is known.
    """
    values = np.where(np.isnan(values), 0.0, values) if is_case else values[~np.isnan(values)]
    return float(values.mean()) if len(values) else np.nan


def mean_and_interval(values: np.ndarray) -> Interval:
    """Return the mean over seeds and its 95 % t-interval, `mean ± t(n - 1) · s / √n`, for `values` [seed, ...].

    NaNs are left out. A single value has a mean but no interval.
    """
    from scipy import special  # slow to import, and not always needed

    values = np.asarray(values, dtype=np.float64)
    present = ~np.isnan(values)
    count = present.sum(axis=0)
    mean = _divide(np.where(present, values, 0.0).sum(axis=0), count)
    squares = (np.where(present, values - mean, 0.0) ** 2).sum(axis=0)
    freedom = np.maximum(count - 1, 0)
    quantile = special.stdtrit(np.maximum(freedom, 1), 0.975)
    reach = quantile * np.sqrt(_divide(_divide(squares, freedom), count))
    return Interval(mean, mean - reach, mean + reach)


def interquartile_mean(values: np.ndarray) -> float:
    """Return the mean of the middle half of all values, NaNs left out; NaN if no value is left."""
    values = np.asarray(values, dtype=np.float64)
    ordered = np.sort(values[~np.isnan(values)])
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean()) if len(ordered) else np.nan


def bootstrap_interval(
    statistic: Callable[..., Any], *samples: np.ndarray, repetitions: int = 2000
) -> tuple[float, float] | None:
    """Return the 95 % percentile interval of `statistic(*samples)`: a stratified bootstrap over seeds.

    The seeds of each sample [seed, ...] are resampled separately, for each task separately. The other axis is the task:
    average over several evaluations of a seed first. Seeds with any NaN are left out entirely; below five seeds there
    is no interval. Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice".
    """
    arrays = [np.asarray(sample, dtype=np.float64) for sample in samples]
    arrays = [array[~np.isnan(array).any(axis=tuple(range(1, array.ndim)))] for array in arrays]
    if min(map(len, arrays)) < FEWEST_FOR_BOOTSTRAP:
        return None
    generator = np.random.default_rng(0)

    def resampled(array: np.ndarray) -> np.ndarray:
        return np.take_along_axis(array, generator.integers(len(array), size=array.shape), axis=0)

    values = [statistic(*map(resampled, arrays)) for _ in range(repetitions)]
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)


def probability_of_improvement(scores: np.ndarray, others: np.ndarray) -> float:
    """Return the probability that a seed of `scores` [seed, task] is above one of `others`, averaged over tasks.

    An equal pair counts half; NaNs are left out; NaN if a task has no pair. One task may be given as [seed].
    This is P(X > Y) of Agarwal et al. 2021.
    """
    scores = np.asarray(scores, dtype=np.float64)[:, None]  # [seed, other seed, ...]
    others = np.asarray(others, dtype=np.float64)[None, :]
    above = np.where(np.isnan(scores) | np.isnan(others), np.nan, (scores > others) + 0.5 * (scores == others))
    pairs = (~np.isnan(above)).sum(axis=(0, 1))
    return float(np.mean(_divide(np.nansum(above, axis=(0, 1)), pairs)))


def maximum_average_return(rows: np.ndarray) -> tuple[float, int]:
    """Return `(value, step)`: the highest mean over seeds among the evaluation points that have every seed.

    The first such point wins a tie. Raises InputError if no point has every seed.
    """
    steps, _, returns = evaluation_matrix(rows)
    average = returns.mean(axis=0) if returns.size else np.full(len(steps), np.nan)
    if np.isnan(average).all():
        raise InputError("no evaluation point holds every seed yet; train for longer")
    best = int(np.nanargmax(average))
    return float(average[best]), int(steps[best])


def last_evaluations(rows: np.ndarray, points: int = 3) -> dict[int, float]:
    """Return each seed's mean return over its last evaluation points, `points` of them or all if there are fewer."""
    _, seeds, returns = evaluation_matrix(rows)
    last = (line[~np.isnan(line)][-points:] for line in returns)
    return {int(seed): float(line.mean()) for seed, line in zip(seeds, last, strict=True) if line.size}


def best_return(rows: np.ndarray) -> float:
    """Return the highest of a seed's evaluations, each the mean over its episodes; minus infinity if there is none."""
    return float(np.nanmax(evaluation_matrix(rows)[2], initial=-np.inf))


def steps_to_reach(steps: np.ndarray, returns: np.ndarray, threshold: float) -> float:
    """Return the environment steps at the first evaluation at `threshold` or above; infinity if it is not reached.

    Infinity means only that it took longer than the curve: take medians over seeds, not means.
    """
    reached = returns >= threshold  # False for NaN
    return float(steps[int(reached.argmax())]) if reached.any() else np.inf


def drawdown(returns: np.ndarray) -> float:
    """Return the largest fall from the highest return so far to a later one; 0 if none falls, NaN if there is none."""
    known = returns[~np.isnan(returns)]
    return float((np.maximum.accumulate(known) - known).max()) if len(known) else np.nan


class Recovery(NamedTuple):
    """What a perturbation did to the returns of one seed, and how they recovered. NaN where that is not known."""

    before: float
    """Mean return of the last three evaluations up to and including the perturbation's step."""
    drop: float
    """`before` minus the lowest return after the perturbation, 0 if none is lower."""
    relative_drop: float
    """The drop as a share of |before|."""
    steps_to_regain: float
    """Environment steps from the perturbation to 90 % of `before`: 0 if none fell below, infinite if never."""
    area_lost: float
    """Integral of max(0, before - return) over the steps after the perturbation, in return times steps."""
    final: float
    """Mean return of the last three evaluations after the perturbation, or of the curve if none is after it."""
    worst_drawdown: float
    """Largest fall from the highest return so far, from the beginning of the curve on."""


def recovery(rows: np.ndarray, step: int, until: int | None = None, since: int = -1) -> dict[int, Recovery]:
    """Return each seed's `Recovery` from a perturbation after `step`, for rows of evaluations.csv up to step `until`.

    Evaluations up to `since`, the step of the previous perturbation, do not count as before this one; an evaluation at
    `step` itself does. If `before` is negative, such as -100, its 90 % are -110: `before` minus a tenth of its size.
    `steps_to_regain` ends at the first evaluation that reaches this threshold after the first one below it. The area is
    computed by the trapezoidal rule between evaluations, from no loss at `step`. Means over the last three evaluations
    are over fewer if there are no more; a seed's NaN or missing evaluations are left out.
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
    threshold = (REGAINED if before >= 0 else 2 - REGAINED) * before
    below = after < threshold
    fallen = int(below.argmax())
    time = steps_to_reach(steps[fallen:] - step, after[fallen:], threshold) if below.any() else 0.0
    relative = drop / abs(before) if before else np.nan
    return Recovery(*map(float, (before, drop, relative, time, area, final, worst)))


def _divide(numerator: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the quotient, NaN where the count is zero; a scalar for scalars."""
    return np.where(count > 0, numerator / np.maximum(count, 1), np.nan)[()]
