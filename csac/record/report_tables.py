"""Build text tables (see `rendering`) of results, comparisons, recoveries, and cases per 1,000 rollouts."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from csac.record.rendering import EMPTY, SMALL, Cell, Row, Table, number, numeric, short
from csac.record.statistics import (
    FEWEST_FOR_BOOTSTRAP,
    FEWEST_FOR_INTERVAL,
    REGAINED,
    Recovery,
    bootstrap_interval,
    evaluation_matrix,
    interquartile_mean,
    is_case,
    last_evaluations,
    maximum_average_return,
    probability_of_improvement,
)
from csac.record.summaries import OverSeeds, case_names, cases, last_rows, over_seeds
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from csac.record.summaries import RecoverySummary

ROLLOUTS = 1_000  # cases are given per this many rollouts, as in the paper
MOST_COLUMNS = 5  # of seeds in that table; with more seeds, only mean and deviation


def results_table(rows: np.ndarray, failed: Collection[int] = (), episodes: Mapping[int, int] | None = None) -> Table:
    """Return one row per seed of a run; below them mean, standard deviation and interval over those that did not fail.

    In the summary, "best" is the point with the highest mean over seeds, and "last" the last point that all seeds have.
    `episodes` are each seed's numbers of training episodes. A single seed has no summary; one without a return, no row.
    """
    means, (steps, labels, returns) = last_evaluations(rows), evaluation_matrix(rows)
    lines = {seed: line for seed, line in zip(labels.tolist(), returns, strict=True) if seed in means}
    largest = max((float(np.nanmax(np.abs(line))) for line in lines.values()), default=0.0)

    def cells(*values: float) -> list[Cell]:
        return [numeric(value, number(value, largest)) for value in values]

    body = []
    for seed, line in lines.items():
        last, best = float(line[~np.isnan(line)][-1]), int(np.nanargmax(line))
        numbers = [_whole(seed), *cells(last, means[seed], float(line[best])), _whole(int(steps[best]))]
        kind = "failed" if seed in failed else "plain"
        body.append(Row((*numbers, _whole((episodes or {}).get(seed, 0))), kind))
    sound = [seed for seed in lines if seed not in failed]
    sound_returns = np.array([lines[seed] for seed in sound]).reshape(len(sound), len(steps))
    common = ~np.isnan(sound_returns).any(axis=0)
    if len(sound) > 1 and common.any():
        steps, sound_returns = steps[common], sound_returns[:, common]
        best = int(sound_returns.mean(axis=0).argmax())
        over = list(map(over_seeds, (sound_returns[:, -1], [means[seed] for seed in sound], sound_returns[:, best])))
        body.append(_summary("mean", *cells(*(one.mean for one in over)), _whole(int(steps[best])), EMPTY))
        body.append(_summary("± std", *cells(*(one.std for one in over)), EMPTY, EMPTY))
        body += interval_rows(over, largest, blank=2)
    headings = ("seed", "last return", "last three", "best", "at step", "episodes")
    return Table(headings, tuple(body), note=few_seeds(len(sound)))


def comparison_table(runs: Sequence[tuple[str, np.ndarray, int]]) -> Table:
    """Return one row per run, given as `(label, rows, number of failed seeds)`.

    It has the last evaluations, their interval and the maximum average return. The ratio to the first run is given for
    positive returns only: for costs, a worse run would have a larger ratio. Interquartile means are shown if any run
    has enough seeds for their interval.
    """
    scores = [np.array(list(last_evaluations(rows).values())) for _, rows, _ in runs]
    shares = [_success(rows) for _, rows, _ in runs]
    has_middles = any(len(seed_means) >= FEWEST_FOR_BOOTSTRAP for seed_means in scores)
    first, body = over_seeds(scores[0]).mean, []
    for (label, rows, failed), seed_means, share in zip(runs, scores, shares, strict=True):
        over = over_seeds(seed_means)
        ratio = over.mean / first if first > 0 and len(runs) > 1 else math.nan
        count = Cell(str(over.seeds) + f" ({failed} failed)" * bool(failed), over.seeds)
        cells = [Cell(label), count, _whole(int(rows["step"].max(initial=0))), plus_minus(over), interval(over)]
        cells += [numeric(ratio, f"{ratio:.2f}"), _maximum(rows)]
        cells += [middle(seed_means), EMPTY if seed_means is scores[0] else above(seed_means, scores[0])] * has_middles
        cells += [plus_minus(share, ".0%") if share else EMPTY] * any(shares)
        body.append(Row(tuple(cells)))
    headings = ["run", "seeds", "steps", "last three evaluations, mean ± std over seeds", "95 % t-interval"]
    headings += ["to the first", "maximum average return"]
    headings += ["IQM, 95 % bootstrap interval", "above the first, probability"] * has_middles
    return Table((*headings, *["success, last three evaluations"] * any(shares)), tuple(body))


def recovery_table(runs: Sequence[RecoverySummary]) -> Table:
    """Return what a perturbation cost each seed and, below each run's seeds, their mean and standard deviation.

    If a seed never recovered, the mean number of steps is replaced by how many seeds did. The label of a single run is
    the title; several runs have a column of labels.
    """
    headings = ("seed", "before", "drop", "relative", f"steps to {REGAINED:.0%}".replace("%", " %"))
    headings += ("area lost", "final", "drawdown")
    rows: list[Row] = []
    for run in runs:
        label = [Cell(run.label)] if len(runs) > 1 else []
        returns = [value for one in run.seeds.values() for value in (one.before, one.drop, one.final)]
        largest = float(np.nanmax(np.abs(returns), initial=0.0))  # sets the format of numbers
        for seed, one in run.seeds.items():
            cells = (*label, _whole(seed), *_recovery_cells(one, largest))
            rows.append(Row(cells, "failed" if seed in run.failed else "plain"))
        if run.known > 1:
            for name, get in (("mean", lambda one: one.mean), ("± std", lambda one: one.std)):
                cells = _recovery_cells(Recovery(*(get(run.metrics[field]) for field in Recovery._fields)), largest)
                if name == "mean" and run.regained < run.known:
                    cells[3] = Cell(f"{run.regained} of {run.known}", math.inf)
                rows.append(Row((*label, Cell(name, math.nan), *cells), "summary"))
    title = runs[0].label if len(runs) == 1 else ""
    return Table((*["run"] * (len(runs) > 1), *headings), tuple(rows), title)


def case_table(rows: np.ndarray) -> Table | None:
    """Return the paper's case table of one run: how often success and each event occurred per 1,000 rollouts, by seed.

    A rollout that does not report a case counts as one without it. A number, such as waypoints reached, is shown as
    its mean over the rollouts that report it. With several seeds, the last column is their mean ± std.
    None if the task reports nothing. `rows` [episode] are those of evaluations.csv.
    """
    seeds = np.unique(rows["seed"]).tolist()
    runs = [(f"seed {seed}", rows[rows["seed"] == seed]) for seed in seeds if len(seeds) <= MOST_COLUMNS]
    runs += [("mean ± std", rows)] * (len(seeds) > 1)
    table = case_comparison_table(runs)
    return table and table._replace(rows=table.rows[1:])


def case_comparison_table(runs: Sequence[tuple[str, np.ndarray]]) -> Table | None:
    """Return the case table of several runs, given as `(label, rows)`: a column for each, mean ± std over its seeds.

    The first row is the return of these episodes.
    """
    names = case_names([rows for _, rows in runs])
    if not names:
        return None
    by_run = [cases(rows, names) for _, rows in runs]
    body = [
        Row((Cell(name if is_rate else f"{name} (mean)"), *(_rate(found.get(name), is_rate) for found in by_run)))
        for name, is_rate in names.items()
    ]
    headings = (_rollouts([rows for _, rows in runs]), *(label for label, _ in runs))
    returns = Row((Cell("return (mean)"), *(_mean_return(rows) for _, rows in runs)))
    return Table(headings, (returns, *body))


def plus_minus(over: OverSeeds, form: str = "") -> Cell:
    """Return `mean ± std`, or the mean of one seed. By default integers from 20 on, unless the deviation is below 1."""
    form = form or _form(over.mean, over.std)
    spread = "" if math.isnan(over.std) else f" ± {over.std:{form}}"
    return numeric(over.mean, f"{over.mean:{form}}{spread}")


def interval(over: OverSeeds) -> Cell:
    """Return the interval of a mean, or a note that there are too few seeds for one."""
    if over.seeds < FEWEST_FOR_INTERVAL:
        return Cell(no_interval(over.seeds), math.nan)
    form = _form(over.mean, over.high - over.low)
    return Cell(f"{over.low:{form}} to {over.high:{form}}", over.mean)


def interval_rows(over: Sequence[OverSeeds], largest: float, blank: int) -> list[Row]:
    """Return a row of the intervals' half-widths and `blank` empty cells, or no row if there are too few seeds."""
    if over[0].seeds < FEWEST_FOR_INTERVAL:
        return []
    reach = [numeric(one.high - one.mean, number(one.high - one.mean, largest)) for one in over]
    return [_summary("± 95 %", *reach, *[EMPTY] * blank)]


def middle(scores: np.ndarray, form: str = "") -> Cell:
    """Return the interquartile mean of scores [seed, ...] with its bootstrap interval, in a format that suits it."""
    value = interquartile_mean(scores)
    return _with_interval(value, bootstrap_interval(interquartile_mean, scores), form or _form(value))


def above(scores: np.ndarray, first: np.ndarray) -> Cell:
    """Return the probability that a seed of `scores` [seed, ...] is above one of `first`, with its interval."""
    probability = probability_of_improvement(scores, first) if len(scores) and len(first) else math.nan
    return _with_interval(probability, bootstrap_interval(probability_of_improvement, scores, first), ".2f")


def few_seeds(count: int) -> str:
    """Return a table's note if there are too few seeds for an interval; empty for a single seed."""
    return no_interval(count) if 1 < count < FEWEST_FOR_INTERVAL else ""


def no_interval(seeds: int) -> str:
    """Return the text that replaces an interval if there are too few seeds for one."""
    return f"{seeds} seed{'s' * (seeds != 1)}: no interval"


def _summary(label: str, *cells: Cell) -> Row:
    return Row((Cell(label, math.nan), *cells), "summary")


def _whole(value: int) -> Cell:
    return Cell(f"{value:,}", value)


def _form(value: float, spread: float = math.nan) -> str:
    if abs(value) >= 20:
        return ",.2f" if 0 < spread < 1 else ",.0f"
    return ".3g" if 0 < abs(value) < SMALL else ".2f"


def _maximum(rows: np.ndarray) -> Cell:
    with suppress(InputError):  # no evaluation point has every seed
        best, step = maximum_average_return(rows)
        return Cell(f"{best:{_form(best)}} at {step:,}", best)
    return EMPTY


def _with_interval(value: float, bounds: tuple[float, float] | None, form: str) -> Cell:
    between = f" ({bounds[0]:{form}} to {bounds[1]:{form}})" if bounds else ""
    return numeric(value, f"{value:{form}}{between}")


def _success(rows: np.ndarray) -> OverSeeds | None:
    """Return the share of successful episodes in the last evaluations, None if the task does not report success."""
    return cases(last_rows(rows, points=3), {"success": True})["success"] if is_case(rows["success"]) else None


def _recovery_cells(one: Recovery, largest: float) -> list[Cell]:
    return [
        numeric(one.before, number(one.before, largest)),
        numeric(one.drop, number(one.drop, largest)),
        numeric(one.relative_drop, f"{one.relative_drop:.0%}"),
        numeric(one.steps_to_regain, "never" if math.isinf(one.steps_to_regain) else f"{one.steps_to_regain:,.0f}"),
        numeric(one.area_lost, f"{one.area_lost:,.3g}" if one.area_lost < 1000 else short(one.area_lost)),
        numeric(one.final, number(one.final, largest)),
        numeric(one.worst_drawdown, number(one.worst_drawdown, largest)),
    ]


def _rollouts(runs: Sequence[np.ndarray]) -> str:
    """Return the heading of a case table's numbers: per how many rollouts, and from how many if that differs."""
    per_seed = {int((rows["seed"] == seed).sum()) for rows in runs for seed in set(rows["seed"].tolist())}
    if per_seed == {ROLLOUTS}:
        return f"per {ROLLOUTS:,} rollouts"
    fewest, most = min(per_seed), max(per_seed)
    counts = f"{fewest:,}" if fewest == most else f"{fewest:,} to {most:,}"
    return f"per {ROLLOUTS:,} rollouts (from {counts} of each seed)"


def _mean_return(rows: np.ndarray) -> Cell:
    over = over_seeds(rows["return"][rows["seed"] == seed].mean() for seed in set(rows["seed"].tolist()))
    return plus_minus(over, ".3g" if 0 < abs(over.mean) < SMALL else ",.1f")


def _rate(over: OverSeeds | None, is_rate: bool) -> Cell:
    if over is None:
        return EMPTY
    form, scale = (",.1f", ROLLOUTS) if is_rate else (",.3f", 1)
    return plus_minus(over._replace(mean=scale * over.mean, std=scale * over.std), form)
