"""Summarise runs over seeds, their recoveries and cases, as plain values: `report_tables` turns them into text.

Rows are those of evaluations.csv; seeds in `failed` are listed but left out of statistics over seeds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from csac.record.statistics import (
    FEWEST_FOR_INTERVAL,
    Recovery,
    is_case,
    mean_and_interval,
    mean_over_episodes,
    recovery,
)
from csac.record.tables import COLUMNS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence


class OverSeeds(NamedTuple):
    """Statistics over seeds. NaN where there are too few: `std` of one seed, the 95 % t-interval of two."""

    seeds: int
    mean: float
    std: float
    low: float
    high: float


class RecoverySummary(NamedTuple):
    """What a perturbation cost the seeds of a run."""

    label: str
    seeds: dict[int, Recovery]
    failed: frozenset[int]
    metrics: dict[str, OverSeeds]
    """For each field of `Recovery`, over the seeds where it is known; no mean of steps if a seed never recovered."""
    regained: int
    known: int
    """Number of seeds whose recovery is known; `regained` of them recovered."""


def over_seeds(values: Iterable[float]) -> OverSeeds:
    """Return the mean, standard deviation and 95 % t-interval of one value per seed, NaNs left out."""
    known = np.array([value for value in values if not np.isnan(value)], dtype=np.float64)
    if not len(known):
        return OverSeeds(0, np.nan, np.nan, np.nan, np.nan)
    mean, low, high = map(float, mean_and_interval(known))
    if len(known) < FEWEST_FOR_INTERVAL:
        low = high = np.nan
    return OverSeeds(len(known), mean, float(known.std(ddof=1)) if len(known) > 1 else np.nan, low, high)


def recoveries(
    label: str,
    rows: np.ndarray,
    step: int,
    until: int | None = None,
    since: int = -1,
    failed: Collection[int] = (),
) -> RecoverySummary:
    """Return the cost of a perturbation after `step`, by seed and over seeds; `until` and `since` as in `recovery`."""
    seeds = recovery(rows, step, until, since)
    sound = [one for seed, one in seeds.items() if seed not in failed and not np.isnan(one.drop)]
    columns = dict(zip(Recovery._fields, np.array(sound).reshape(len(sound), len(Recovery._fields)).T, strict=True))
    regained = sum(np.isfinite(one.steps_to_regain) for one in sound)
    if regained < len(sound):
        columns["steps_to_regain"] = np.zeros(0)  # a mean of only those that recovered would flatter
    metrics = {name: over_seeds(column) for name, column in columns.items()}
    return RecoverySummary(label, seeds, frozenset(failed) & seeds.keys(), metrics, int(regained), len(sound))


def perturbation_recoveries(
    rows: np.ndarray, perturbed: Sequence[tuple[int, str]], failed: Collection[int] = ()
) -> list[RecoverySummary]:
    """Return what each perturbation `(step, what changed)` of one run cost until the next one, labelled with both.

    Perturbations with no evaluation before or none after them are left out.
    """
    found, steps = [], [step for step, _ in perturbed]
    for (step, text), since, until in zip(perturbed, [-1, *steps], [*steps[1:], None], strict=False):
        end = f", until {until:,}" if until and until < rows["step"].max(initial=0) else ""
        summary = recoveries(f"{text} after step {step:,}{end}", rows, step, until, since, failed)
        if any(np.isfinite(one.drop) for one in summary.seeds.values()):
            found.append(summary)
    return found


def case_names(runs: Sequence[np.ndarray]) -> dict[str, bool]:
    """Return the names of success and of the events in these rows, and whether each is a case in all of them.

    An event that no episode reports is included, as a number that is not known; success is not.
    """
    names = dict.fromkeys(name for rows in runs for name in events_in(rows))
    values = {name: np.concatenate([rows[name] for rows in runs if name in events_in(rows)]) for name in names}
    return {name: is_case(column) for name, column in values.items() if name != "success" or not np.isnan(column).all()}


def cases(rows: np.ndarray, names: Mapping[str, bool]) -> dict[str, OverSeeds]:
    """Return how often success and each event occurred in all episodes of `rows`, over seeds: a share of the episodes.

    `names` comes from `case_names`; a number that is no case has its mean per episode instead.
    """
    seeds, known = np.unique(rows["seed"]).tolist(), events_in(rows)
    return {
        name: over_seeds(mean_over_episodes(rows[name][rows["seed"] == seed], is_case) for seed in seeds)
        for name, is_case in names.items()
        if name in known
    }


def last_rows(rows: np.ndarray, points: int = 1) -> np.ndarray:
    """Return the rows of each seed's last `points` evaluations."""
    wanted = np.zeros(len(rows), dtype=bool)
    for seed in np.unique(rows["seed"]):
        own = rows["seed"] == seed
        wanted |= own & np.isin(rows["step"], np.unique(rows["step"][own])[-points:])
    return rows[wanted]


def events_in(rows: np.ndarray) -> list[str]:
    """Return the columns that describe what happened in an episode."""
    return [name for name in rows.dtype.names or () if name == "success" or name not in COLUMNS["evaluations"]]
