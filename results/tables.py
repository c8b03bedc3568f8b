"""The Markdown tables of the pages in results/, from evaluations with the columns seed, step and return."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import stats

from csac.record import report_tables
from csac.record.rendering import Cell, Row, markdown, number
from csac.record.report_tables import comparison_table
from csac.record.statistics import (
    FEWEST_FOR_BOOTSTRAP,
    Recovery,
    bootstrap_interval,
    drawdown,
    evaluation_matrix,
    interquartile_mean,
    probability_of_improvement,
    recovery,
    steps_to_reach,
)
from csac.record.summaries import recoveries

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

WORDS = {"method", "so", "against (bold: counterpart)"}  # headings of left-aligned columns besides the first
LAST_SHARE = 0.2  # of a run's steps; the mean of the evaluations there is the final return
EARLY = 100_000  # steps, a common length in publications
COUNTERPARTS = {"CSAC, candidate": "SAC, candidate"}  # for other forms of CSAC: SAC, 0.2

Interval = tuple[float, float] | None
Finals = dict[str, dict[str, np.ndarray]]  # final returns [seed], by task and arm


class Measured(NamedTuple):
    """The results of the seeds of one arm on one task."""

    final: np.ndarray  # [seed]
    early: np.ndarray  # [seed] at 100,000 steps
    drawdown: np.ndarray  # [seed]
    loss: np.ndarray  # [seed] area lost as a share of the return before a change; the drawdown if nothing changes
    dispersion: float


# Text.


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> str:
    """Return a Markdown table with numbers aligned to the right."""
    rules = ["---" if index == 0 or heading in WORDS else "---:" for index, heading in enumerate(headings)]
    lines = [f"| {' | '.join(cells)} |" for cells in (headings, rules, *rows)]
    return "\n".join([f"**{title}**", "", *lines] if title else lines)


def plus_minus(values: np.ndarray) -> str:
    """Return the mean and the standard deviation of the seeds."""
    mean = values.mean()
    return f"{number(mean)} ± {number(values.std(ddof=1), mean)}"


def with_interval(value: float, interval: Interval, form: str = ".3f") -> str:
    """Format a value, with its interval in brackets if there is one."""
    return f"{value:{form}}" + (f" ({interval[0]:{form}} to {interval[1]:{form}})" if interval else "")


def verdict(interval: Interval) -> str:
    """Return the verdict for the interval of a probability of improvement; below five seeds there is no interval."""
    if interval is None:
        return "no verdict"
    return "better" if interval[0] > 0.5 else "worse" if interval[1] < 0.5 else "no significant difference"


def comma(values: Sequence[object]) -> str:
    """Return the values separated by commas."""
    return ", ".join(map(str, values))


# Returns, and recoveries from a change.


def returns_table(runs: Mapping[str, np.ndarray]) -> str:
    """Return a table of the last three evaluations of each arm, compared with the first arm's."""
    full = comparison_table([(label, rows, 0) for label, rows in runs.items()]).without_empty_columns()
    if any(np.isnan(rows["success"]).any() for rows in runs.values()):
        return markdown(full)
    lines = [Row((*row.cells, _success(rows))) for row, rows in zip(full.rows, runs.values(), strict=True)]
    return markdown(full._replace(headings=(*full.headings, "success, last three evaluations"), rows=tuple(lines)))


def _success(rows: np.ndarray) -> Cell:
    last = rows[np.isin(rows["step"], np.unique(rows["step"])[-3:])]
    shares = np.array([last["success"][last["seed"] == seed].mean() for seed in np.unique(last["seed"])])
    return Cell(f"{shares.mean():.0%} ± {shares.std(ddof=1):.0%}", float(shares.mean()))


def recovery_table(runs: Mapping[str, np.ndarray], step: int) -> str:
    """Return each seed's loss and recovery after a change at `step`, and a comparison of two arms of five seeds."""
    found = [recoveries(label, rows, step) for label, rows in runs.items()]
    lines = markdown(report_tables.recovery_table(found))
    told = [np.array(list(one.seeds.values())) for one in found]
    if len(told) != 2 or min(map(len, told)) < FEWEST_FOR_BOOTSTRAP:
        return lines
    first, second = (dict(zip(Recovery._fields, values.T, strict=True)) for values in told)
    claims = {
        "has the smaller drop": (-first["relative_drop"], -second["relative_drop"]),
        "is back at 90 % sooner": (-first["steps_to_regain"], -second["steps_to_regain"]),
        "has the higher return at the end": (first["final"], second["final"]),
    }
    rows = [[claim, *compared(*values, 10_000)] for claim, values in claims.items()]
    return lines + "\n\n" + table([" against ".join(runs), "probability", "so"], rows)


# By the rules of the protocols.


def boundary_tables(runs: Mapping[str, np.ndarray], boundary: float, steps: int) -> str:
    """Return when each seed first reached the boundary, and a comparison of two arms of five seeds.

    A seed that never reaches it is censored at its last step; two such seeds tie. Returns are means of the last tenth.
    """
    times, finals, falls, lines = [], [], [], []
    for label, rows in runs.items():
        at, seeds, values = evaluation_matrix(rows)
        times.append(np.array([steps_to_reach(at, line, boundary) for line in values]))
        finals.append(values[:, at > 0.9 * steps].mean(axis=1))
        falls.append(np.array([drawdown(line) for line in values]))
        told = ["not reached" if np.isinf(time) else f"{time:,.0f}" for time in times[-1]]
        each = [f"{seed}: {time}" for seed, time in zip(seeds, told, strict=True)]
        spread = plus_minus(finals[-1]) if len(seeds) > 1 else number(finals[-1][0])
        lines.append([label, comma(each), spread, number(falls[-1].mean())])
    headings = ["method", f"steps to {boundary:,.2f}, each seed", "return, last tenth", "drawdown, mean"]
    parts = [table(headings, lines)]
    if min(map(len, times)) >= FEWEST_FOR_BOOTSTRAP:
        parts.append(_boundary_comparison(list(runs), times, finals, falls, steps))
    return "\n\n".join(parts)


def _boundary_comparison(
    labels: Sequence[str],
    times: Sequence[np.ndarray],
    finals: Sequence[np.ndarray],
    falls: Sequence[np.ndarray],
    steps: int,
) -> str:
    """Compare the first arm with the second by the steps to the boundary, the return and the drawdown."""
    censored = [stats.CensoredData(uncensored=t[t <= steps], right=np.full(sum(t > steps), steps)) for t in times]
    difference = stats.ttest_ind(finals[0], finals[1], equal_var=False)
    bounds = difference.confidence_interval()
    mean = float(finals[0].mean() - finals[1].mean())
    lines = [
        ["is first at the boundary", *compared(-times[0], -times[1], 10_000)],
        ["has the higher return", *compared(finals[0], finals[1], 10_000)],
        ["has the smaller drawdown", *compared(-falls[0], -falls[1], 10_000)],
    ]
    told = table([f"{labels[0]} against {labels[1]}", "probability", "so"], lines)
    p_value = stats.logrank(censored[0], censored[1]).pvalue
    return f"{told}\n\nLog-rank test of the steps to the boundary: p = {p_value:.3f}. Difference of the returns: " + (
        f"{mean:,.0f} ({bounds.low:,.0f} to {bounds.high:,.0f}, 95 % Welch interval)."
    )


def measure(rows: np.ndarray, steps: int, changed_at: int | None = None) -> Measured:
    """Return the results of an arm; a seed's final return is the mean of its evaluations in the last fifth."""
    at, _, values = evaluation_matrix(rows)
    falls = np.array([drawdown(curve) for curve in values])
    areas = [one.area_lost / abs(one.before) for one in recovery(rows, changed_at).values()] if changed_at else falls
    return Measured(
        values[:, at > (1 - LAST_SHARE) * steps].mean(axis=1),
        values[:, at == EARLY].mean(axis=1) if EARLY in at else np.full(len(values), np.nan),
        falls,
        np.array(areas),
        dispersion_across(values),
    )


def dispersion_across(returns: np.ndarray) -> float:
    """Interquartile range over seeds of `returns` [seed, t], averaged over the evaluations that include every seed.

    It measures how much the outcome depends on the seed; NaN below two seeds. After Chan et al. 2020, "Measuring the
    Reliability of Reinforcement Learning Algorithms" (dispersion across runs), without its smoothing.
    """
    together = returns[:, ~np.isnan(returns).any(axis=0)]
    if len(returns) < 2 or not together.size:
        return np.nan
    low, high = np.quantile(together, [0.25, 0.75], axis=0)
    return float((high - low).mean())


def study_tables(
    title: str, found: Mapping[str, Mapping[str, Measured]], seeds: Sequence[int], is_changed: bool = False
) -> list[str]:
    """Return a table of arms for each task, the scores over all tasks, and the comparisons."""
    finals = {task: {label: one.final for label, one in arms.items()} for task, arms in found.items()}
    losses = {task: {label: one.loss for label, one in arms.items()} for task, arms in found.items()}
    comparisons = _comparison_table(finals, losses, "less area lost" if is_changed else "smaller drawdown")
    titled = f"**{title}: comparisons, seeds {comma(seeds)}**\n\n{comparisons}"
    return [*(_task_table(task, arms) for task, arms in found.items()), overall_table(title, finals), titled]


def _task_table(task: str, arms: Mapping[str, Measured]) -> str:
    headings = ["method", "seeds", "final return, mean ± std", f"at {EARLY:,} steps, mean", "drawdown, mean"]
    lines = []
    for label, one in arms.items():
        numbers = one.early.mean(), one.drawdown.mean(), one.dispersion, one.final.min()
        lines.append([label, str(len(one.final)), plus_minus(one.final), *map(number, numbers)])
    return table([*headings, "dispersion over seeds", "worst seed"], lines, task)


def overall_table(title: str, finals: Finals) -> str:
    """Return a table of scores over all tasks: final returns as shares of the first arm's mean."""
    values = stacked(finals)
    first = next(iter(values))
    lines = []
    for label, own in values.items():
        shares = own / values[first].mean(axis=0)
        middle = with_interval(interquartile_mean(shares), bootstrap_interval(interquartile_mean, shares))
        lines.append([label, f"{shares.mean(axis=0).mean():.3f}", middle, f"{shares.min():.3f}"])
    title = f"{title}: over {comma(list(finals))}, as shares of {first}"
    return table(["method", "scaled mean", "scaled IQM", "worst seed"], lines, title)


def stacked(values: Finals) -> dict[str, np.ndarray]:
    """Return the values [seed, task] of each arm."""
    return {label: np.stack([arms[label] for arms in values.values()], axis=1) for label in next(iter(values.values()))}


def compared(values: np.ndarray, others: np.ndarray, repetitions: int = 2_000) -> tuple[str, str]:
    """Return the probability that `values` are higher than `others`, with its interval, and the verdict."""
    interval = bootstrap_interval(probability_of_improvement, values, others, repetitions=repetitions)
    return with_interval(probability_of_improvement(values, others), interval), verdict(interval)


def _comparison_table(finals: Finals, losses: Finals, less: str) -> str:
    """Compare forms of CSAC with each SAC, and SACs with the first SAC; without SAC, all arms with the first."""
    final, loss = stacked(finals), stacked(losses)
    forms_of_sac = [label for label in final if label.startswith("SAC")] or list(final)[:1]
    lines = []
    for label in final:
        for other in forms_of_sac[:1] if label in forms_of_sac else forms_of_sac:
            if label != other:
                is_counterpart = label not in forms_of_sac and COUNTERPARTS.get(label, "SAC, 0.2") == other
                cells = [label, f"**{other}**" if is_counterpart else other]
                cells += [*compared(final[label], final[other]), *compared(-loss[label], -loss[other])]
                lines.append([*cells, *(compared(arms[label], arms[other])[0] for arms in finals.values())])
    headings = ["method", "against (bold: counterpart)", "P(higher return)", "so", f"P({less})", "so"]
    return table([*headings, *(f"P(higher return), {task}" for task in finals)], lines)
