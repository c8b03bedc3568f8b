"""What csac's candidate and its peers have learnt in equal time: what PROTOCOL.md asks for in stage 4.

    python results/strong/equal_time.py
    python results/strong/equal_time.py --into PAGE.md#NAME --curve PICTURE.png

The runs are those of `python -m benchmarks.equal_time`, in equal-time/; those of csac's arms are of stage 1, in
results/studies. The return at equal time of a run is the mean of its evaluations in the last fifth: a peer's of the
time T, the candidate's of the 100,000 steps of which T is the time. That of SAC on the candidate's critics, which is
secondary, is of the steps that it makes in T, but of no more than the 100,000 that it was run for.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import itertools
import runpy
import statistics
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from csac.record.plots import RETURN, draw_legend, grouped, head, looks_of, picture, save
from csac.record.rendering import Cell, Row, Table, markdown, number, numeric
from csac.record.statistics import (
    evaluation_matrix,
    improvement_interval,
    probability_of_improvement,
)
from csac.studies.arms import Arm, gather
from csac.studies.results import Results, Source
from csac.studies.run_report import write_between
from csac.studies.study import Study, read_study
from csac.types import InputError

HERE = Path(__file__).parent
EVIDENCE = SimpleNamespace(**runpy.run_path(str(HERE.parent / "reference" / "evidence.py")))
CANDIDATE = "CSAC, candidate"  # of confirm.toml, and of plan.csv
SECONDARY = "SAC, candidate"
OWN = (CANDIDATE, SECONDARY)
DRAWN = {CANDIDATE: "CSAC, preset strong", SECONDARY: "SAC, preset strong"}  # which is what the candidate has become
STEPS = 100_000  # of the candidate, which take the time T; no run of csac's arms is longer
LAST_SHARE = 0.2  # of T, or of the steps of csac's arms: the evaluations there are the return at equal time
# By the folders of benchmarks/equal_time.py. The first is the SAC automatic of this stage: what scores are shares of.
PEERS = {
    "sb3-sac": "SB3 SAC",
    "sbx-sac": "SBX SAC",
    "sbx-tqc": "SBX TQC",
    "sbx-crossq": "SBX CrossQ",
    "sbx-simba": "SBX SimBa",
}
EPISODES = 10
TOLD_SHARES = (0.2, 0.4, 0.6, 0.8, 1.0)  # of T, in the table of returns by time


class Plan(NamedTuple):
    """What plan.csv says of one contender on one task."""

    limit: float
    """T in seconds."""
    rate: float
    """Environment steps per second."""
    steps: dict[float, int]
    """Those that are over at each share of T."""


class Reached(NamedTuple):
    """What one run has reached."""

    value: float
    """The mean of its evaluations in the last fifth; NaN where training failed."""
    returns: dict[float, float]
    """The evaluation at each share of T; of csac's arms it is the last one by then."""


Plans = dict[tuple[str, str], Plan]  # by contender and task
Found = dict[str, dict[str, dict[int, Reached]]]  # by task, method and seed


# What runs have reached.


def read_plan(path: Path) -> Plans:
    """Return how far each contender comes in T, by its name in plan.csv. Raises InputError where there is no plan."""
    plans: Plans = {}
    for row in _table(path, ("limit", "rate", "share", "steps"), "python -m benchmarks.equal_time speeds"):
        new = Plan(float(row["limit"]), float(row["rate"]), {})
        plans.setdefault((row["contender"], row["task"]), new).steps[float(row["share"])] = int(row["steps"])
    return plans


def read_peer(path: Path, plan: Plan) -> Reached:
    """Return what the file of one run tells. Raises InputError where it is not one, or of another plan."""
    rows = _table(path, ("step", "return"), "python -m benchmarks.equal_time run")
    if sorted(int(row["step"]) for row in rows) != sorted([*plan.steps.values()] * EPISODES):
        raise InputError(f"{path} does not hold the evaluations of plan.csv: remove it")
    returns = {
        share: statistics.fmean(float(row["return"]) for row in rows if int(row["step"]) == steps)
        for share, steps in plan.steps.items()
    }
    last = [value for share, value in returns.items() if share > 1 - LAST_SHARE]
    return Reached(statistics.fmean(last), returns)


def _table(path: Path, columns: tuple[str, ...], written_by: str) -> list[dict[str, str]]:
    """Return the rows of a CSV. Raises InputError where it is missing or has not got these columns of numbers."""
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        for row, column in itertools.product(rows, columns):
            float(row[column])
    except (OSError, KeyError, TypeError, ValueError):
        raise InputError(f"{path} is missing or damaged: {written_by} writes it") from None
    return rows


def of_own(arm: Arm, plan: Plan) -> dict[int, Reached]:
    """Return what each seed of an arm of csac has reached in the steps that T has room for, of those that it ran."""
    reached = {seed: Reached(np.nan, dict.fromkeys(plan.steps, np.nan)) for seed in arm.failures}
    if len(arm.rows):
        at, seeds, returns = evaluation_matrix(arm.rows)
        within = min(STEPS, max(plan.steps.values()))
        values = EVIDENCE.final_returns(arm.rows[arm.rows["step"] <= within], within)
        for seed, line in zip(seeds.tolist(), returns, strict=True):
            by_then = {share: line[at <= steps] for share, steps in plan.steps.items()}
            last = {share: float(some[-1]) if len(some) else np.nan for share, some in by_then.items()}
            reached[seed] = Reached(values[seed], last)
    return reached


def gathered(study: Study, results: Source, folder: Path, plans: Plans) -> Found:
    """Return what every peer, and after them csac's arms, have reached on each task, as far as they have run."""
    seeds = range(study.first_seed, study.first_seed + study.seeds)
    arms = gather(study.narrowed(algorithms=list(OWN)), results)
    found: Found = {}
    for task in study.tasks:
        files = {(peer, seed): folder / task / peer / f"seed-{seed}.csv" for peer in PEERS for seed in seeds}
        found[task] = {
            label: {s: read_peer(files[peer, s], plans[peer, task]) for s in seeds if files[peer, s].exists()}
            for peer, label in PEERS.items()
        }
        found[task] |= {arm.label: of_own(arm, plans[arm.label, task]) for arm in arms if arm.task == task}
    return found


def measured(found: Found) -> dict[str, dict[str, EVIDENCE.Measured]]:
    """Return the returns of each method on the seeds that all of them have on the task; a failed one has 0."""
    made = {}
    for task, methods in found.items():
        seeds = tuple(sorted(set.intersection(*(set(runs) for runs in methods.values()))))
        unknown = np.full(len(seeds), np.nan)
        if seeds:
            finals = {label: np.nan_to_num([runs[seed].value for seed in seeds]) for label, runs in methods.items()}
            made[task] = {
                label: EVIDENCE.Measured(seeds, final, unknown, unknown, unknown, np.nan)
                for label, final in finals.items()
            }
    return made


# Tables.


def speed_table(study: Study, plans: Plans) -> Table:
    """Return how far each contender comes in T."""
    rows = []
    for task, (name, label) in itertools.product(study.tasks, (*PEERS.items(), *zip(OWN, OWN, strict=True))):
        plan = plans[name, task]
        steps = max(plan.steps.values())
        cells = (
            Cell(task),
            Cell(label),
            numeric(plan.rate, f"{plan.rate:.1f}"),
            numeric(plan.limit, f"{plan.limit:.0f}"),
            numeric(steps, f"{steps:,}"),
        )
        rows.append(Row(cells))
    return Table(("task", "method", "steps per second", "T, s", "steps in T"), tuple(rows), "How fast each is")


def task_table(task: str, reached: dict[str, dict[int, Reached]], seeds: Sequence[int]) -> Table:
    """Return what each method has reached on one task, at equal time and on the way."""
    rows = []
    for label, runs in reached.items():
        values = np.nan_to_num([runs[seed].value for seed in seeds])
        std = f" ± {number(values.std(ddof=1), values.mean())}" if len(values) > 1 else ""
        by_then = [[runs[seed].returns.get(share, np.nan) for seed in seeds] for share in TOLD_SHARES]
        cells = (
            Cell(label),
            Cell(f"{number(values.mean())}{std}", values.mean()),
            Cell(number(values.min()), values.min()),
            *(numeric(value, number(value)) for value in map(statistics.fmean, by_then)),
        )
        rows.append(Row(cells))
    shares = (f"at {share:g} T" for share in TOLD_SHARES)
    headings = ("method", "return at equal time, mean ± std", "worst seed", *shares)
    return Table(headings, tuple(rows), f"{task}: seeds {_seeds(seeds)}")


def comparisons(
    found: dict[str, dict[str, EVIDENCE.Measured]], own: str, seeds: Sequence[int]
) -> tuple[Table, list[str]]:
    """Return how an arm of csac compares with each peer, over all tasks and on each, and the verdicts."""
    returns = EVIDENCE.scores(found, lambda one: one.final, seeds)
    rows, verdicts = [], []
    for peer in PEERS.values():
        interval = improvement_interval(returns[own], returns[peer])
        verdicts.append(EVIDENCE.verdict(interval))
        pairs = [(methods[own].final, methods[peer].final) for methods in found.values()]
        cells = [Cell(peer), _probability(returns[own], returns[peer]), Cell(verdicts[-1])]
        rows.append(Row((*cells, *(_probability(*pair) for pair in pairs))))
    headings = ("against", "P(higher return)", "so", *(f"P(higher return), {task}" for task in found))
    title = f"{own}{'' if own == CANDIDATE else ' (secondary)'}, against each peer: seeds {_seeds(seeds)}"
    return Table(headings, tuple(rows), title), verdicts


def _probability(values: np.ndarray, others: np.ndarray) -> Cell:
    value, interval = probability_of_improvement(values, others), improvement_interval(values, others)
    return numeric(value, f"{value:.3f}" + (f" ({interval[0]:.3f} to {interval[1]:.3f})" if interval else ""))


def aim(verdicts: Sequence[str]) -> str:
    """Say whether the candidate is better than every peer."""
    if "no verdict" in verdicts:
        return "open: too few seeds"
    return "reached" if set(verdicts) == {"better"} else "missed"


def notes(study: Study, found: Found, seeds: Sequence[int]) -> list[str]:
    """Return what did not run, what failed, and what is left out of the comparisons over all tasks."""
    planned = set(range(study.first_seed, study.first_seed + study.seeds))
    arms = {f"{label} on {task}": runs for task, methods in found.items() for label, runs in methods.items()}
    failed = {arm: [seed for seed, one in runs.items() if np.isnan(one.value)] for arm, runs in arms.items()}
    lists = [
        *((f"not run: {arm}", planned - set(runs)) for arm, runs in arms.items()),
        *((f"failed, and counted as 0: {arm}", which) for arm, which in failed.items()),
        ("left out, since not every method has them on every task", planned - set(seeds)),
    ]
    return [f"{what}: seeds {_seeds(which)}" for what, which in lists if which]


def shorter(study: Study, plans: Plans) -> list[str]:
    """Return which arm of csac was not run for all the steps that it makes in T."""
    made = {(task, own): max(plans[own, task].steps.values()) for task in study.tasks for own in OWN}
    return [
        f"{own} on {task}: {steps:,} steps in T, but it was run for {STEPS:,}, which is what is told of it"
        for (task, own), steps in made.items()
        if steps > STEPS
    ]


def surroundings(folder: Path) -> list[str]:
    """Return what the speeds depend on: the machine, as far as it was noted, and what else ran on it."""
    machine, path = folder / "machine.txt", folder / "speeds.csv"
    lines = machine.read_text(encoding="utf-8").splitlines() if machine.exists() else []
    if path.exists():
        loads = [float(row["load"]) for row in _table(path, ("load",), "python -m benchmarks.equal_time speeds")]
        lines.append(
            f"while speeds were measured, other programs kept {statistics.fmean(loads):.2f} cores busy on average, "
            f"{max(loads):.2f} at most"
        )
    return lines


def known_plans(study: Study, folder: Path) -> Plans:
    """Return how far everyone comes in T. Raises InputError where that is not known of one on a task of the study."""
    plans = read_plan(folder / "plan.csv")
    for task, name in itertools.product(study.tasks, (*OWN, *PEERS)):
        if (name, task) not in plans:
            raise InputError(f"{name} on {task} was not measured: python -m benchmarks.equal_time speeds")
    return plans


def told(study: Study, results: Source, folder: Path) -> str:
    """Return all that is known of stage 4, in Markdown. Raises InputError where T is not known."""
    plans = known_plans(study, folder)
    study = dataclasses.replace(study, title="Equal time")
    found = gathered(study, results, folder, plans)
    over = measured(found)
    seeds = EVIDENCE.common_seeds(study, over)
    listed = [*notes(study, found, seeds), *shorter(study, plans), *surroundings(folder)]
    parts = [f"## {study.title}", _list(listed)]
    tables = [speed_table(study, plans)]
    tables += [task_table(task, found[task], next(iter(one.values())).seeds) for task, one in over.items()]
    if seeds:
        comparison, verdicts = comparisons(over, CANDIDATE, seeds)
        tables += [EVIDENCE.overall_table(study, over), comparison]
        parts += [*map(markdown, tables), f"Better than every one of the {len(PEERS)}: {aim(verdicts)}."]
        parts.append(markdown(comparisons(over, SECONDARY, seeds)[0]))
    else:
        parts += map(markdown, tables)
    return "\n\n".join(part for part in parts if part)


# The picture.


def draw(study: Study, results: Source, folder: Path, path: Path) -> None:
    """Draw what each method has reached by the wall clock, task by task. Raises InputError as `told` does."""
    plans = known_plans(study, folder)
    found = gathered(study, results, folder, plans)
    looks = looks_of([*DRAWN.values(), *PEERS.values()])
    with picture(3.5, columns=len(found)) as figure:
        for axes, (task, methods) in zip(figure.axes, found.items(), strict=True):
            limit = plans[CANDIDATE, task].limit
            for label, runs in methods.items():
                shares = sorted({share for run in runs.values() for share in run.returns})
                values = np.array([[run.returns[share] for share in shares] for run in runs.values()])
                if not len(values):
                    continue
                colour, style = looks[DRAWN.get(label, label)]
                times = np.multiply(shares, limit)
                axes.fill_between(times, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.1, linewidth=0)
                axes.plot(times, values.mean(axis=0), color=colour, linestyle=style, linewidth=2.2)
            axes.set(xlim=(0, limit), xlabel="seconds of training on two cores")
            axes.yaxis.set_major_formatter(grouped)
        figure.axes[0].set_ylabel(RETURN)
        draw_legend(figure, looks)
        head(figure, "What each has learnt by the wall clock", list(found), "line: mean over seeds · band: their range")
        save(figure, path, ("png",))


def _list(notes: Sequence[str]) -> str:
    return "\n".join(f"- {note}" for note in notes)


def _seeds(seeds: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(seeds)))


def main() -> None:
    """Print the tables, or write them into a page; draw the picture where it is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=HERE / "equal-time", help="where the runs' files are")
    parser.add_argument("--results", type=Path, default=EVIDENCE.CELLS, help="where cells/ of csac's arms lies")
    parser.add_argument("--into", metavar="PAGE.md#NAME", help="write between the marks NAME of a page")
    parser.add_argument("--curve", metavar="PICTURE.png", type=Path, help="draw the returns by the wall clock")
    arguments = parser.parse_args()
    try:
        source = Results(arguments.results, may_be_empty=True)
        study = read_study(HERE / "confirm.toml")
        text = told(study, source, arguments.folder)
        if arguments.curve:
            draw(study, source, arguments.folder, arguments.curve)
        if arguments.into:
            page, _, name = arguments.into.partition("#")
            write_between(Path(page), name, f"{text}\n")
        else:
            print(text)
    except InputError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
