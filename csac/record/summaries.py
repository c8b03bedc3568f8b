"""What runs have reached, as plain values: results, comparisons, cases and recoveries. Each is computed here alone.

`summary_tables` turns them into text for the terminal, Markdown and HTML. Rows are those of evaluations.csv; a seed in
`failed` is shown and left out of what is over seeds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from csac.record.curve_measures import Recovery, recovery
from csac.record.statistics import (
    FEWEST_FOR_INTERVAL,
    evaluation_matrix,
    improvement_interval,
    interquartile_mean,
    is_case,
    last_evaluations,
    maximum_average_return,
    mean_and_interval,
    mean_over_episodes,
    probability_of_improvement,
    stratified_bootstrap_interval,
)
from csac.record.tables import COLUMNS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence


class OverSeeds(NamedTuple):
    """A number over seeds. NaN where there are too few: `std` of one seed, the 95 % t-interval of two."""

    seeds: int
    mean: float
    std: float
    low: float
    high: float


class SeedResult(NamedTuple):
    """What one seed has reached: returns are means over the episodes of an evaluation."""

    seed: int
    has_failed: bool
    last: float
    last_three: float
    best: float
    best_step: int
    episodes: int
    """Training episodes that have ended."""


class RunResults(NamedTuple):
    """What a run has reached. Its best is the best evaluation of all seeds together: the maximum average return."""

    seeds: tuple[SeedResult, ...]
    last: OverSeeds
    last_three: OverSeeds
    best: OverSeeds
    best_step: int | None


class RunSummary(NamedTuple):
    """One run among several."""

    label: str
    steps: int
    failed: int
    last: OverSeeds
    """Of each seed's mean over its last evaluations, `points` of them."""
    best: float
    best_step: int | None
    """The maximum average return and where it was; NaN and None where no evaluation holds every seed."""
    middle: float
    middle_interval: tuple[float, float] | None
    """Interquartile mean over seeds of what `last` is the mean of; its bootstrap interval from five seeds up."""
    above_first: float
    above_first_interval: tuple[float, float] | None
    """Probability that a seed's last evaluations are above those of one of the first run; NaN of the first itself."""
    success: OverSeeds | None
    """Share of successful episodes in the last evaluations, None where the task says nothing of success."""
    points: int


class RecoverySummary(NamedTuple):
    """What a perturbation cost the seeds of a run."""

    label: str
    seeds: dict[int, Recovery]
    failed: frozenset[int]
    metrics: dict[str, OverSeeds]
    """By the fields of `Recovery`, over the seeds where it is known. No mean of steps where a seed never came back."""
    regained: int
    known: int
    """Of how many seeds the recovery is known, and how many of them came back."""


class CaseSummary(NamedTuple):
    """How often something happened, as a share of the episodes; or, of what is a number, its mean per episode."""

    name: str
    is_case: bool
    by_seed: dict[int, float]
    over_seeds: OverSeeds


def over_seeds(values: Iterable[float]) -> OverSeeds:
    """Return mean, standard deviation and 95 % t-interval of one value for each seed, NaNs left out."""
    known = np.array([value for value in values if not np.isnan(value)], dtype=np.float64)
    if not len(known):
        return OverSeeds(0, np.nan, np.nan, np.nan, np.nan)
    mean, low, high = map(float, mean_and_interval(known))
    if len(known) < FEWEST_FOR_INTERVAL:
        low = high = np.nan
    return OverSeeds(len(known), mean, float(known.std(ddof=1)) if len(known) > 1 else np.nan, low, high)


def run_results(
    rows: np.ndarray, failed: Collection[int] = (), episodes: Mapping[int, int] | None = None
) -> RunResults:
    """Return what each seed of a run has reached, and the seeds that did not fail together.

    `episodes` are the training episodes of each seed. A seed without a return is left out.
    """
    steps, labels, returns = evaluation_matrix(rows)
    last_three = last_evaluations(rows, points=3)
    lines = {seed: line for seed, line in zip(labels.tolist(), returns, strict=True) if seed in last_three}
    seeds = tuple(
        SeedResult(
            seed,
            seed in failed,
            float(line[~np.isnan(line)][-1]),
            last_three[seed],
            float(np.nanmax(line)),
            int(steps[np.nanargmax(line)]),
            (episodes or {}).get(seed, 0),
        )
        for seed, line in lines.items()
    )
    sound = [seed for seed in lines if seed not in failed]
    together = np.array([lines[seed] for seed in sound]).reshape(len(sound), len(steps))
    common = ~np.isnan(together).any(axis=0)
    if not sound or not common.any():
        nothing = over_seeds([])
        return RunResults(seeds, nothing, nothing, nothing, None)
    steps, together = steps[common], together[:, common]
    best = int(together.mean(axis=0).argmax())
    three = over_seeds(last_three[seed] for seed in sound)
    return RunResults(seeds, over_seeds(together[:, -1]), three, over_seeds(together[:, best]), int(steps[best]))


def compare(
    runs: Sequence[tuple[str, np.ndarray]], failed: Mapping[str, Collection[int]] | None = None, points: int = 3
) -> tuple[RunSummary, ...]:
    """Return a summary of each run, given as `(label, rows)`, the others set against the first.

    `failed` are the seeds that failed, by the label of their run. Two runs of one label are two rows.
    """
    summaries, first = [], np.zeros(0)
    for index, (label, rows) in enumerate(runs):
        lost = set((failed or {}).get(label, ()))
        sound = rows[~np.isin(rows["seed"], list(lost))]
        last = np.array(list(last_evaluations(sound, points).values()))
        first = first if index else last
        best, best_step = _best(sound)
        summaries.append(
            RunSummary(
                label,
                int(rows["step"].max(initial=0)),
                len(lost),
                over_seeds(last),
                best,
                best_step,
                interquartile_mean(last),
                stratified_bootstrap_interval(last, interquartile_mean),
                probability_of_improvement(last, first) if index and len(last) and len(first) else np.nan,
                improvement_interval(last, first) if index else None,
                _success(sound, points),
                points,
            )
        )
    return tuple(summaries)


def recoveries(
    label: str,
    rows: np.ndarray,
    step: int,
    until: int | None = None,
    since: int = -1,
    failed: Collection[int] = (),
) -> RecoverySummary:
    """Return what a perturbation after `step` cost each seed and all together; `until` and `since` as in `recovery`."""
    seeds = recovery(rows, step, until, since)
    sound = [one for seed, one in seeds.items() if seed not in failed and not np.isnan(one.drop)]
    columns = dict(zip(Recovery._fields, np.array(sound).reshape(len(sound), len(Recovery._fields)).T, strict=True))
    regained = sum(np.isfinite(one.steps_to_regain) for one in sound)
    if regained < len(sound):
        columns["steps_to_regain"] = np.zeros(0)  # a mean of those that came back would flatter
    metrics = {name: over_seeds(column) for name, column in columns.items()}
    return RecoverySummary(label, seeds, frozenset(failed) & seeds.keys(), metrics, int(regained), len(sound))


def perturbation_recoveries(
    rows: np.ndarray, perturbed: Sequence[tuple[int, str]], failed: Collection[int] = ()
) -> list[RecoverySummary]:
    """Return what each of the `(step, what changed)` of one run cost it, each as far as the next, labelled with both.

    Left out are those with no evaluation before them or none after.
    """
    found = []
    for index, (step, text) in enumerate(perturbed):
        until = perturbed[index + 1][0] if index + 1 < len(perturbed) else None
        end = f", until {until:,}" if until and until < rows["step"].max(initial=0) else ""
        since = perturbed[index - 1][0] if index else -1
        summary = recoveries(f"{text} after step {step:,}{end}", rows, step, until, since, failed)
        if any(np.isfinite(one.drop) for one in summary.seeds.values()):
            found.append(summary)
    return found


def case_names(runs: Sequence[np.ndarray]) -> dict[str, bool]:
    """Return what these rows tell of beside returns, success and events, and whether each is a case in all of them.

    An event that no episode tells of is there, as a number that is not known; success is not.
    """
    names = dict.fromkeys(name for rows in runs for name in rows.dtype.names or () if name in _events(rows))
    values = {name: np.concatenate([rows[name] for rows in runs if name in _events(rows)]) for name in names}
    return {name: is_case(column) for name, column in values.items() if name != "success" or not np.isnan(column).all()}


def cases(rows: np.ndarray, names: Mapping[str, bool] | None = None) -> list[CaseSummary]:
    """Return how often success and each event came in `rows`, all of their episodes, seed by seed.

    `names` are those of `case_names`, given where several runs are to be treated alike.
    """
    found = []
    for name, happens in (case_names([rows]) if names is None else names).items():
        if name not in _events(rows):
            continue
        seeds = np.unique(rows["seed"]).tolist()
        by_seed = {seed: mean_over_episodes(rows[name][rows["seed"] == seed], happens) for seed in seeds}
        found.append(CaseSummary(name, happens, by_seed, over_seeds(by_seed.values())))
    return found


def last_rows(rows: np.ndarray, points: int = 1) -> np.ndarray:
    """Return the rows of each seed's own last evaluations, `points` of them."""
    wanted = np.zeros(len(rows), dtype=bool)
    for seed in np.unique(rows["seed"]):
        own = rows["seed"] == seed
        wanted |= own & np.isin(rows["step"], np.unique(rows["step"][own])[-points:])
    return rows[wanted]


def _best(rows: np.ndarray) -> tuple[float, int | None]:
    returns = evaluation_matrix(rows)[2]
    if not returns.size or np.isnan(returns).any(axis=0).all():
        return np.nan, None
    return maximum_average_return(rows)


def _success(rows: np.ndarray, points: int) -> OverSeeds | None:
    found = [case for case in cases(last_rows(rows, points), {"success": True}) if is_case(rows["success"])]
    return found[0].over_seeds if found else None


def _events(rows: np.ndarray) -> set[str]:
    """The columns that tell of what happened in an episode."""
    return {name for name in rows.dtype.names or () if name == "success" or name not in COLUMNS["evaluations"]}
