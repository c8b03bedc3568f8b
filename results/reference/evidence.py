"""The numbers that PROTOCOL.md asks for, from the files in `cells/`, and the arms that it chooses by them.

    python results/reference/evidence.py tables results/reference/screen.toml results/reference/confirm.toml
    python results/reference/evidence.py tables results/reference/tenth.toml --seeds 3 4 --into PAGE.md#NAME
    python results/reference/evidence.py tables results/strong/confirm.toml --methods "SAC, automatic" "CSAC, candidate"
    python results/reference/evidence.py tables results/strong/longer.toml --tasks Walker2d-v4
    python results/reference/evidence.py write chosen       (or options)
    python results/reference/evidence.py null --tasks 3

The first method of a study is the scale of its scores: here SAC 0.2.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csac.record.atomic import write_atomically
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
from csac.studies.cells import complete
from csac.studies.options import narrowed
from csac.studies.results import Results, Source
from csac.studies.run_report import write_between
from csac.studies.study import Method, Study, read_study
from csac.tasks.perturbations import perturbations_of
from csac.types import InputError

HERE = Path(__file__).parent
CELLS = HERE.parent / "studies"  # one store for all studies, which share cells
LAST_SHARE = 0.2  # of a run's steps: its evaluations there are its final return
EARLY = 100_000  # steps at which others publish their returns
CLOSE = 0.01  # screen scores that are no further apart are equal
MARK = "# From here on written by evidence.py: PROTOCOL.md says when.\n"

# What SAC and CSAC share beside the entropy's weight, which each of them writes in its own way.
SHARED = sorted((complete("sac", {}).keys() & complete("csac", {}).keys()) - {"entropy_weight", "target_entropy"})

WEIGHTS = (0.05, 5.0)
PERIODIC = Method(
    "CSAC, periodic 1000",
    "csac",
    None,
    {"reference_policy": "periodic", "reference_period": 1000, "relative_entropy_estimator": "closed_form"},
)
OPTIONS: dict[str, dict[str, Any]] = {
    "entropy weight automatic": {"entropy_weight": "auto"},
    "log-densities bounded": {"target_log_prob_bound": 5.0},
    "implicit, log-densities bounded": {"relative_entropy_form": "implicit", "target_log_prob_bound": 5.0},
    "in the actor only": {"relative_entropy_form": "actor_only"},
}
LEARNT = "relative-entropy weight automatic"
TARGET: dict[str, Any] = {"relative_entropy_weight": "auto", "target_relative_entropy": 0.01}

# Which stage is looked at, how many of its best are taken, and into which files their arms go.
STAGES = {
    "chosen": ("screen", 2, ("confirm", "ant", "recovery")),
    "options": ("screen", 1, ("options",)),
}


class Measured(NamedTuple):
    """What the seeds of one method on one task have reached; a seed that failed has 0, and an infinite loss."""

    seeds: tuple[int, ...]
    final: np.ndarray  # [seed]
    early: np.ndarray  # [seed] at 100,000 steps; NaN where nothing was evaluated there
    drawdown: np.ndarray  # [seed]
    area_lost: np.ndarray  # [seed] as a share of the return before the perturbation, in steps; NaN without one
    dispersion: float  # NaN where a seed failed: those that are left say nothing of how far apart all of them lie


# What runs have reached.


def final_returns(rows: np.ndarray, steps: int) -> dict[int, float]:
    """Return each seed's mean evaluation at steps > 0.8 x steps, given the rows of evaluations.csv."""
    at, seeds, returns = evaluation_matrix(rows)
    last = returns[:, at > (1 - LAST_SHARE) * steps]
    return {int(seed): float(line.mean()) for seed, line in zip(seeds, last, strict=True)}


def measure(arm: Arm, steps: int, seeds: Sequence[int]) -> Measured:
    """Return what an arm's seeds have reached."""
    rows = arm.rows
    rows = rows[np.isin(rows["seed"], seeds)]
    at, labels, returns = evaluation_matrix(rows)
    curves = dict(zip(labels.tolist(), returns, strict=True))
    perturbed = perturbations_of(arm.condition)
    recovered = recovery(rows, perturbed[0].step) if perturbed else {}

    def of(values: dict[int, float], failed: float) -> np.ndarray:
        return np.array([failed if seed in arm.failures else values.get(seed, np.nan) for seed in seeds])

    return Measured(
        tuple(seeds),
        of(final_returns(rows, steps), 0.0),
        of({seed: float(curve[at == EARLY][0]) for seed, curve in curves.items() if EARLY in at}, 0.0),
        of({seed: drawdown(curve) for seed, curve in curves.items()}, np.inf),
        of({seed: one.area_lost / abs(one.before) for seed, one in recovered.items()}, np.inf),
        np.nan if arm.failures.keys() & set(seeds) else dispersion_across(returns),
    )


def measured(study: Study, arms: Sequence[Arm], only: Sequence[int] = ()) -> dict[str, dict[str, Measured]]:
    """Return, task by task, what each method has reached on the seeds that all of them have there, or `only` these."""
    found: dict[str, dict[str, Measured]] = {}
    for task in study.tasks:
        here = [arm for arm in arms if arm.task == task]
        over = [{manifest.seeds[0] for manifest in arm.manifests} | set(arm.failures) for arm in here]
        seeds = sorted(set.intersection(*over, *([set(only)] if only else [])))
        if seeds:
            found[task] = {arm.label: measure(arm, study.steps_for(task), seeds) for arm in here}
    return found


def common_seeds(study: Study, found: dict[str, dict[str, Measured]]) -> list[int]:
    """Return the seeds that every method has on every task: what is told over all tasks is told of them alone."""
    of_tasks = [set(one.seeds) for arms in found.values() for one in arms.values()]
    return sorted(set.intersection(*of_tasks)) if set(found) == set(study.tasks) else []


def scores(
    found: dict[str, dict[str, Measured]], value: Callable[[Measured], np.ndarray], seeds: Sequence[int]
) -> dict[str, np.ndarray]:
    """Return each method's values [seed, task] of these seeds."""
    columns: dict[str, list[np.ndarray]] = {}
    for arms in found.values():
        for label, one in arms.items():
            columns.setdefault(label, []).append(value(one)[np.isin(one.seeds, seeds)])
    return {label: np.stack(parts, axis=1) for label, parts in columns.items()}


def scaled(found: dict[str, dict[str, Measured]], seeds: Sequence[int]) -> dict[str, np.ndarray]:
    """Return each method's final returns [seed, task] as shares of the first method's mean on the task."""
    final = scores(found, lambda one: one.final, seeds)
    scale = next(iter(final.values())).mean(axis=0)
    return {label: values / scale for label, values in final.items()}


def score(values: np.ndarray) -> float:
    """Return the mean over tasks of the mean over seeds of `values` [seed, task]."""
    return float(values.mean(axis=0).mean())


# Who is compared with whom.


def has_relative_entropy(study: Study, method: Method) -> bool:
    """Whether a method is CSAC with a weight of the relative entropy that is not 0."""
    return method.hyperparameters_on(study.tasks[0]).get("relative_entropy_weight", 0.0) != 0.0


def counterpart(study: Study, method: Method) -> Method | None:
    """Return the first method that is the same but for the relative entropy, which it has not; None without one."""
    others = [other for other in study.methods if not has_relative_entropy(study, other)]
    return next((other for other in others if _beside_it(study, other) == _beside_it(study, method)), None)


def _beside_it(study: Study, method: Method) -> dict[str, Any]:
    """Return what a method is beside the relative entropy, the same for CSAC and SAC."""
    given = method.hyperparameters_on(study.tasks[0])
    is_automatic = given.get("temperature") == "automatic" or given["entropy_weight"] == "auto"
    entropy = "auto" if is_automatic else given["entropy_weight"]
    return {
        **{name: given[name] for name in SHARED},
        "entropy": entropy,
        "bound": given.get("target_log_prob_bound", 0.0),
    }


def verdict(interval: tuple[float, float] | None) -> str:
    """Say what the interval of a probability of improvement says; there is none below five seeds."""
    if interval is None:
        return "no verdict"
    return "better" if interval[0] > 0.5 else "worse" if interval[1] < 0.5 else "not told apart"


# Tables.


def task_table(task: str, arms: dict[str, Measured]) -> Table:
    """Return what each method has reached on one task."""
    rows = []
    for label, one in arms.items():
        known = one.final[~np.isnan(one.final)]
        std = f" ± {number(known.std(ddof=1), known.mean())}" if len(known) > 1 else ""
        early = one.early.mean()
        fall = one.drawdown.mean() if np.isfinite(one.drawdown).all() else np.nan  # one that failed has none
        cells = (
            Cell(label),
            Cell(str(len(known)), len(known)),
            Cell(f"{number(known.mean())}{std}", known.mean()),
            numeric(early, number(early)),
            numeric(fall, number(fall)),
            numeric(one.dispersion, number(one.dispersion)),
            Cell(number(known.min()), known.min()),
        )
        rows.append(Row(cells))
    early = f"at {EARLY:,} steps, mean"
    steadiness = ("drawdown, mean", "dispersion over seeds", "worst seed")
    return Table(("method", "seeds", "final return, mean ± std", early, *steadiness), tuple(rows), task)


def overall_table(study: Study, found: dict[str, dict[str, Measured]]) -> Table:
    """Return the scaled scores of the methods over all tasks."""
    rows, shares = [], scaled(found, common_seeds(study, found))
    for label, values in shares.items():
        interval = stratified_bootstrap_interval(values, interquartile_mean)
        cells = (
            Cell(label),
            Cell(f"{score(values):.3f}", score(values)),
            _with_interval(interquartile_mean(values), interval),
            Cell(f"{values.min():.3f}", float(values.min())),
        )
        rows.append(Row(cells))
    title = f"{study.title}: over {', '.join(found)}, as shares of {next(iter(shares))}"
    return Table(("method", "scaled mean", "scaled IQM", "worst seed"), tuple(rows), title)


def comparison_table(study: Study, found: dict[str, dict[str, Measured]]) -> Table:
    """Return how each method with relative entropy compares with each without, and these with the first of them.

    Over all tasks, and on each.
    """
    is_perturbed = any(study.conditions)
    seeds = common_seeds(study, found)
    final = scores(found, lambda one: one.final, seeds)
    loss = scores(found, lambda one: one.area_lost if is_perturbed else one.drawdown, seeds)
    rows = []
    without = [one for one in study.methods if not has_relative_entropy(study, one)]
    for method in study.methods:
        own = counterpart(study, method)
        for other in without[:1] if method in without else without:
            if method is other:
                continue
            pair = method.label, other.label
            cells = [
                Cell(method.label),
                Cell(f"**{other.label}**" if other is own else other.label),
                *_compared(*(final[label] for label in pair)),
                *_compared(*(-loss[label] for label in pair)),
                *(_compared(*(arms[label].final for label in pair))[0] for arms in found.values()),
            ]
            rows.append(Row(tuple(cells)))
    what = "less area lost" if is_perturbed else "smaller drawdown"
    tasks = [f"P(higher return), {task}" for task in found]
    headings = ("method", "against (bold: counterpart)", "P(higher return)", "so", f"P({what})", "so", *tasks)
    return Table(headings, tuple(rows), f"{study.title}: comparisons, seeds {', '.join(map(str, seeds)) or 'none'}")


def _compared(values: np.ndarray, others: np.ndarray) -> tuple[Cell, Cell]:
    interval = improvement_interval(values, others)
    return _with_interval(probability_of_improvement(values, others), interval), Cell(verdict(interval))


def _with_interval(value: float, interval: tuple[float, float] | None) -> Cell:
    return numeric(value, f"{value:.3f}" + (f" ({interval[0]:.3f} to {interval[1]:.3f})" if interval else ""))


def told(study: Study, source: Source, only: Sequence[int] = (), has_more_tasks: bool = False) -> str:
    """Return what is known of a study: what did not run, what failed, which seeds are left out, and the tables.

    With `only` these seeds count, and all that has a scale is scaled by theirs. Where the study `has_more_tasks`, the
    heading says on which it is told. Raises InputError for no seed of its own.
    """
    of_study = range(study.first_seed, study.first_seed + study.seeds)
    kept = set(only or of_study) & set(of_study)
    if not kept:
        raise InputError(f"{study.name} has the seeds {of_study.start} to {of_study.stop - 1}")
    arms = gather(study, source)
    found = measured(study, arms, only)
    seeds = common_seeds(study, found)
    over = {task: set(next(iter(methods.values())).seeds) for task, methods in found.items()}
    notes = [
        *(f"not run: {arm.label} on {arm.task}: seed {seed}" for arm in arms for seed in arm.missing if seed in kept),
        *(f"failed: {arm.label} on {arm.task}: seed {seed}" for arm in arms for seed in arm.failures if seed in kept),
        *(
            f"left out of what is over all tasks: {task}, seed {seed}, which another task lacks"
            for task, own in over.items()
            for seed in sorted(own - set(seeds))
        ),
    ]
    tables = [task_table(task, methods) for task, methods in found.items()]
    if seeds:
        tables += [overall_table(study, found), comparison_table(study, found)]
    some = [f"seeds {', '.join(map(str, sorted(kept)))}"] if only else []
    some += [f"on {', '.join(study.tasks)}"] if has_more_tasks else []
    title = f"## {study.title}" + (f": {', '.join(some)} alone" if some else "")
    parts = [title, "\n".join(f"- {note}" for note in notes), *map(markdown, tables)]
    return "\n\n".join(part for part in parts if part)


# Choosing.


def ranked(values: dict[str, np.ndarray]) -> list[str]:
    """Return the labels, the best first, of scaled final returns [seed, task].

    Of those within 0.01 of the highest mean the one with the highest worst seed is the best; then the same without it.
    """
    left, order = dict(values), []
    while left:
        highest = max(map(score, left.values()))
        near = [label for label, own in left.items() if highest - score(own) <= CLOSE]
        order.append(max(near, key=lambda label: left[label].min()))
        del left[order[-1]]
    return order


def best(study: Study, source: Source) -> list[Method]:
    """Return the forms that can be chosen, the best first. Raises InputError where a cell has not run."""
    arms = gather(study, source)
    if waiting := next((arm for arm in arms if arm.missing), None):
        raise InputError(f"{waiting.label} on {waiting.task}, seed {waiting.missing[0]}, has not run: run it first")
    found = measured(study, arms)
    values = scaled(found, common_seeds(study, found))
    methods = {one.label: one for one in study.methods if one.preset is None and has_relative_entropy(study, one)}
    return [methods[label] for label in ranked({label: values[label] for label in methods})]


def options(form: Method) -> list[Method]:
    """Return a form, with less and more weight, and each option alone that it has not.

    Two references need `periodic` in the target, and a learnt weight a copy of 1,000 updates before: where the form has
    another reference, `periodic` 1000 is given them.
    """
    told = form.hyperparameters
    is_explicit = told.get("relative_entropy_form", "explicit") == "explicit"
    base = form if told["reference_policy"] == "periodic" and is_explicit else PERIODIC
    two = _changed(base, "two references", {"critic_reference": "earlier"})
    # Its target is meant for a copy of 1,000 updates before: within the lag of `previous` no policy moves as far.
    learnt = form if (told["reference_policy"], told.get("reference_period")) == ("periodic", 1000) else PERIODIC
    weights = [_changed(form, f"tau {tau:g}", {"relative_entropy_weight": tau}) for tau in WEIGHTS]
    new = {words: changes for words, changes in OPTIONS.items() if {**told, **changes} != told}
    changed = [_changed(form, words, changes) for words, changes in new.items()]
    return [form, *weights, *changed, _changed(learnt, LEARNT, TARGET), two]


def write(stage: str, folder: Path, source: Source) -> list[Path]:
    """Write the arms of a stage into its files below their mark, and return the files.

    Raises:
        InputError: the stage before it is not complete, or a file has no mark.
    """
    before, count, names = STAGES[stage]
    forms = best(read_study(folder / f"{before}.toml"), source)[:count]
    methods = options(*forms) if stage == "options" else forms
    return [_append(folder / f"{name}.toml", methods) for name in names]


def _changed(form: Method, words: str, changes: dict[str, Any]) -> Method:
    return dataclasses.replace(
        form, label=f"{form.label}, {words}", hyperparameters={**form.hyperparameters, **changes}
    )


def _append(path: Path, methods: Sequence[Method]) -> Path:
    """Write methods that a study has not got above its mark below it, in place of what is there."""
    head, mark, _ = path.read_text(encoding="utf-8").partition(MARK)
    if not mark:
        raise InputError(f"{path} has no line {MARK.strip()!r}")
    labels = {method["label"] for method in tomllib.loads(head)["methods"]}
    new = {method.label: _as_toml(method) for method in methods if method.label not in labels}
    write_atomically(path, "\n".join([head + mark, *new.values()]).encode())
    read_study(path)
    return path


def _as_toml(method: Method) -> str:
    lines = ["[[methods]]", f"label = {json.dumps(method.label)}", f"algorithm = {json.dumps(method.algorithm)}"]
    if method.preset:
        lines.append(f"preset = {json.dumps(method.preset)}")
    if method.hyperparameters:
        values = ", ".join(f"{name} = {json.dumps(value)}" for name, value in method.hyperparameters.items())
        lines.append(f"hyperparameters = {{ {values} }}")
    return "\n".join(lines) + "\n"


# The rule where nothing differs.


class FalseVerdicts(NamedTuple):
    """Shares of trials in which methods that do not differ were told apart."""

    apart: float
    better: float
    either_better: float
    """Of two forms that are compared with the same method, one or both."""


def false_verdicts(tasks: int, seeds: int, trials: int) -> FalseVerdicts:
    """Judge two forms and what they are compared with, all drawn from one normal distribution, again and again."""
    generator = np.random.default_rng(0)
    verdicts = []
    for _ in range(trials):
        first, second, other = generator.standard_normal((3, seeds, tasks))
        verdicts.append([verdict(improvement_interval(form, other)) for form in (first, second)])
    is_better, is_worse = np.array(verdicts) == "better", np.array(verdicts) == "worse"
    return FalseVerdicts(
        float((is_better | is_worse).mean()), float(is_better.mean()), float(is_better.any(axis=1).mean())
    )


def main() -> None:
    """Print tables, write the arms of a stage, or try the rule where nothing differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    tables = commands.add_parser("tables", help="print the tables of studies")
    tables.add_argument("studies", nargs="+", type=Path, metavar="STUDY.toml")
    tables.add_argument("--seeds", nargs="+", type=int, default=(), help="only these, where the study has them")
    tables.add_argument("--methods", nargs="+", help="only these: what is told is told on the seeds that they have")
    tables.add_argument("--tasks", nargs="+", help="only these: what is over all tasks is over these")
    tables.add_argument("--into", metavar="PAGE.md#NAME", help="write between the marks NAME of a page")
    writing = commands.add_parser("write", help="write the arms of a stage, by the results of those before it")
    writing.add_argument("stage", choices=STAGES)
    for command in (tables, writing):
        command.add_argument("--results", type=Path, default=CELLS, help="where cells/ lies")
    null = commands.add_parser("null", help="how often the rule tells apart what does not differ")
    for name, default in (("tasks", 3), ("seeds", 5), ("trials", 500)):
        null.add_argument(f"--{name}", type=int, default=default)
    arguments = parser.parse_args()
    try:
        if arguments.command == "tables":
            source = Results(arguments.results)
            studies = [read_study(path) for path in arguments.studies]
            text = "".join(
                told(study, source, arguments.seeds, has_more_tasks=bool(arguments.tasks)) + "\n\n"
                for study in narrowed(studies, arguments.tasks, arguments.methods, None)
            )[:-1]
            if arguments.into:
                page, _, name = arguments.into.partition("#")
                write_between(Path(page), name, text)
            else:
                print(text)
        elif arguments.command == "write":
            print("\n".join(f"written: {path}" for path in write(arguments.stage, HERE, Results(arguments.results))))
        else:
            shares = false_verdicts(arguments.tasks, arguments.seeds, arguments.trials)
            words = (f"{name.replace('_', ' ')} {share:.1%}" for name, share in shares._asdict().items())
            print(
                f"{arguments.trials:,} trials of {arguments.seeds} seeds on {arguments.tasks} tasks: {', '.join(words)}"
            )
    except InputError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
