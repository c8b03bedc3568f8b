"""The numbers that PROTOCOL.md asks for, of the studies beside it, from the files in `cells/`.

    python results/reference/evidence.py results/reference/screen.toml results/reference/confirm.toml

The first method of a study is SAC 0.2: what the others are compared with, and the scale of the scores.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from csac.record.curve_measures import drawdown, recovery
from csac.record.rendering import Cell, Row, Table, markdown, number, numeric
from csac.record.statistics import (
    dispersion_across,
    evaluation_matrix,
    improvement_interval,
    interquartile_mean,
    probability_of_improvement,
    stratified_bootstrap_interval,
)
from csac.studies.arms import Arm, gather
from csac.studies.results import Results
from csac.studies.study import Study, read_study
from csac.tasks.perturbations import perturbations_of

LAST_SHARE = 0.2  # of a run's steps: its evaluations there are its final return


class Measured(NamedTuple):
    """What the seeds of one method on one task have reached; a seed that failed has 0, and an infinite loss."""

    final: np.ndarray  # [seed]
    drawdown: np.ndarray  # [seed]
    area_lost: np.ndarray  # [seed] as a share of the return before the perturbation, in steps; NaN without one
    dispersion: float


def final_returns(rows: np.ndarray, steps: int) -> dict[int, float]:
    """Return each seed's mean evaluation at steps > 0.8 x steps, given the rows of evaluations.csv."""
    at, seeds, returns = evaluation_matrix(rows)
    last = returns[:, at > (1 - LAST_SHARE) * steps]
    return {int(seed): float(line.mean()) for seed, line in zip(seeds, last, strict=True)}


def measure(arm: Arm, steps: int, seeds: list[int]) -> Measured:
    """Return what an arm's seeds have reached."""
    rows = arm.rows
    rows = rows[np.isin(rows["seed"], seeds)]
    _, labels, returns = evaluation_matrix(rows)
    curves = dict(zip(labels.tolist(), returns, strict=True))
    final, perturbed = final_returns(rows, steps), perturbations_of(arm.condition)
    recovered = recovery(rows, perturbed[0].step) if perturbed else {}

    def of(values: dict[int, float], failed: float) -> np.ndarray:
        return np.array([failed if seed in arm.failures else values.get(seed, np.nan) for seed in seeds])

    return Measured(
        of(final, 0.0),
        of({seed: drawdown(curve) for seed, curve in curves.items()}, np.inf),
        of({seed: one.area_lost / abs(one.before) for seed, one in recovered.items()}, np.inf),
        dispersion_across(returns),
    )


def measured(study: Study, arms: list[Arm]) -> dict[str, dict[str, Measured]]:
    """Return, task by task, what each method has reached on the seeds that all of them have there."""
    found: dict[str, dict[str, Measured]] = {}
    for task in study.tasks:
        here = [arm for arm in arms if arm.task == task]
        over = [{manifest.seeds[0] for manifest in arm.manifests} | set(arm.failures) for arm in here]
        seeds = sorted(set.intersection(*over))
        if seeds:
            found[task] = {arm.label: measure(arm, study.steps_for(task), seeds) for arm in here}
    return found


def scores(found: dict[str, dict[str, Measured]], value: Callable[[Measured], np.ndarray]) -> dict[str, np.ndarray]:
    """Return each method's values [seed, task]; NaN where a task has fewer seeds."""
    longest = max(len(next(iter(arms.values())).final) for arms in found.values())
    columns: dict[str, list[np.ndarray]] = {}
    for arms in found.values():
        for label, one in arms.items():
            values = value(one)
            columns.setdefault(label, []).append(np.pad(values, (0, longest - len(values)), constant_values=np.nan))
    return {label: np.stack(parts, axis=1) for label, parts in columns.items()}


def scaled(found: dict[str, dict[str, Measured]]) -> dict[str, np.ndarray]:
    """Return each method's final returns [seed, task] as shares of the first method's mean on the task."""
    final = scores(found, lambda one: one.final)
    scale = np.nanmean(next(iter(final.values())), axis=0)
    return {label: values / scale[None, :] for label, values in final.items()}


def task_table(task: str, arms: dict[str, Measured]) -> Table:
    """Return what each method has reached on one task."""
    rows = []
    for label, one in arms.items():
        known, falls = one.final[~np.isnan(one.final)], one.drawdown[np.isfinite(one.drawdown)]
        std = f" ± {number(known.std(ddof=1), known.mean())}" if len(known) > 1 else ""
        fall = falls.mean() if len(falls) else np.nan
        cells = (
            Cell(label),
            Cell(str(len(known)), len(known)),
            Cell(f"{number(known.mean())}{std}", known.mean()),
            numeric(fall, number(fall)),
            numeric(one.dispersion, number(one.dispersion)),
            Cell(number(known.min()), known.min()),
        )
        rows.append(Row(cells))
    headings = ("method", "seeds", "final return, mean ± std", "drawdown, mean", "dispersion over seeds", "worst seed")
    return Table(headings, tuple(rows), task)


def overall_table(study: Study, found: dict[str, dict[str, Measured]]) -> Table:
    """Return the scaled scores of the methods over all tasks, and how they compare with the two forms of SAC."""
    final = scaled(found)
    baselines = [method.label for method in study.methods if method.algorithm == "sac"]
    loss = scores(found, lambda one: one.area_lost if any(study.conditions) else one.drawdown)
    rows = []
    for label, values in final.items():
        cells = [
            Cell(label),
            Cell(f"{np.nanmean(values):.3f}", float(np.nanmean(values))),
            _with_interval(interquartile_mean(values), stratified_bootstrap_interval(values, interquartile_mean)),
            Cell(f"{np.nanmin(values):.3f}", float(np.nanmin(values))),
        ]
        for other in baselines:
            cells += [
                _improvement(label, other, values, final[other]),
                _improvement(label, other, -loss[label], -loss[other]),
            ]
        rows.append(Row(tuple(cells)))
    what = "less area lost" if any(study.conditions) else "smaller drawdown"
    against = [f"{text} than {other}" for other in baselines for text in ("P(higher return", f"P({what}")]
    headings = ("method", "scaled mean", "scaled IQM", "worst seed", *(f"{text})" for text in against))
    return Table(headings, tuple(rows), f"{study.title}: over {', '.join(found)}")


def _improvement(label: str, other: str, values: np.ndarray, others: np.ndarray) -> Cell:
    if label == other:
        return Cell("", np.nan)
    return _with_interval(probability_of_improvement(values, others), improvement_interval(values, others))


def _with_interval(value: float, interval: tuple[float, float] | None) -> Cell:
    return numeric(value, f"{value:.2f}" + (f" ({interval[0]:.2f} to {interval[1]:.2f})" if interval else ""))


def main() -> None:
    """Print the tables of each study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="+", type=Path, metavar="STUDY.toml")
    parser.add_argument("--results", type=Path, default=Path(__file__).parent, help="where cells/ lies")
    arguments = parser.parse_args()
    for path in arguments.studies:
        study = read_study(path)
        arms = gather(study, Results(arguments.results))
        found = measured(study, arms)
        print(f"## {study.title}\n")
        missing = [f"{arm.label} on {arm.task}: seed {seed}" for arm in arms for seed in arm.missing]
        failed = [f"{arm.label} on {arm.task}: seed {seed}" for arm in arms for seed in arm.failures]
        print("\n".join([*(f"- not run: {one}" for one in missing), *(f"- failed: {one}" for one in failed)]) + "\n")
        if found:
            print("\n\n".join(markdown(task_table(task, arms)) for task, arms in found.items()))
            print("\n" + markdown(overall_table(study, found)) + "\n")


if __name__ == "__main__":
    main()
