"""Write reports that compare runs: one self-contained HTML file, or Markdown with its pictures beside it."""

from __future__ import annotations

import base64
import math
from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from csac.console.tables import duration
from csac.record import report_tables
from csac.record.files import write_atomically, writing
from csac.record.plots import encoded, figure_of, looks_of
from csac.record.rendering import EMPTY, Cell, Row, Table, markdown, number, numeric
from csac.record.statistics import drawdown, evaluation_matrix, is_case, last_evaluations
from csac.record.summaries import last_rows, over_seeds, recoveries
from csac.seeds import EVALUATION_SEED
from csac.studies import paper
from csac.studies.arms import by_place, differing, plain, seconds_per_step, settings, train_command
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

    from csac.studies.arms import Arm

MOST_CURVES = 7  # in one picture
POINTS = 3  # evaluations at the end of a run that count as its score


class Picture(NamedTuple):
    """A figure and its title."""

    title: str
    figure: Figure


class Commands(NamedTuple):
    """Command lines to show."""

    lines: tuple[str, ...]


class Heading(NamedTuple):
    """The heading of a section."""

    text: str


Part = str | Heading | Table | Picture | Commands


def report_of(arms: Sequence[Arm], commands: Sequence[str], analyses: Sequence[str]) -> list[Part]:
    """Return the parts of a report on these arms; `analyses` names its optional sections."""
    shown = [arm for arm in arms if len(arm.rows)]
    parts = list(overview(arms))
    for name, section in SECTIONS.items():
        if shown and name in analyses:
            parts += section(shown)
    if shown:
        parts += [*over_tasks(shown), *paper_claims(shown)]
    parts = [part.without_empty_columns() if isinstance(part, Table) else part for part in parts]
    return [*parts, *hyperparameters(arms), *provenance(arms, commands)]


def write(path: Path, title: str, parts: Sequence[Part]) -> None:
    """Write a report to `path`, an .html or .md file. Raises InputError for another kind, or if writing fails."""
    if path.suffix not in (".html", ".md"):
        name = path / "report.html" if path.is_dir() else path.with_suffix(".html")
        raise InputError(f"a report is an .html or an .md file: name it {name}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        content = _html(title, parts) if path.suffix == ".html" else _markdown(path, title, parts)
        write_atomically(path, content.encode())


def _html(title: str, parts: Sequence[Part]) -> str:
    loader = PackageLoader("csac.studies")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters["picture"] = lambda figure: base64.b64encode(encoded(figure, "svg")).decode()
    template = environment.get_template("report.html.jinja")
    return template.render(title=title, parts=[(type(part).__name__, part) for part in parts])


def _markdown(path: Path, title: str, parts: Sequence[Part]) -> str:
    texts = [f"# {title}"]
    for index, part in enumerate(parts):
        match part:
            case Heading(text):
                texts.append(f"## {text}")
            case Picture(name, figure):
                picture = path.with_name(f"{path.stem}-{index}.png")
                write_atomically(picture, encoded(figure))
                texts.append(f"![{name}]({picture.name})")
            case Commands(lines):
                texts.append("\n".join(["```sh", *lines, "```"]))
            case str():
                texts.append(part)
            case _:
                texts.append(markdown(part))
    return "\n\n".join(texts) + "\n"


def overview(arms: Sequence[Arm]) -> Iterator[Part]:
    """Yield a table of the runs, and notes on those that failed or are incomplete."""
    yield Heading("Runs")
    rows = []
    for arm in arms:
        states = Counter(run.state for run in arm.runs) + Counter(missing=len(arm.missing))
        seeds = ", ".join(map(str, sorted(run.seed for run in arm.runs)))
        steps = arm.config.steps if arm.runs else 0
        state = ", ".join(f"{count} {state}" for state, count in states.items())
        rows.append(Row((Cell(arm.label), Cell(arm.place), Cell(seeds), Cell(f"{steps:,}", steps), Cell(state))))
    yield Table(("method", "task", "seeds", "steps", "runs"), tuple(rows))
    for arm in arms:
        for seed, reason in arm.failures.items():
            yield f"Failed: {arm.label} on {arm.place}, seed {seed}: {reason}. It is in no number below."
        if arm.incomplete:
            incomplete = ", ".join(f"seed {seed} at step {step:,}" for seed, step in arm.incomplete.items())
            yield f"Incomplete, in no number below: {arm.label} on {arm.place}, {incomplete}."
        end, is_over = arm.rows["step"].max(initial=0), all(run.state in ("finished", "failed") for run in arm.runs)
        if not is_over and 0 < end < min(arm.config.steps, arm.until or arm.config.steps):
            yield f"Not finished: {arm.label} on {arm.place}, its numbers are of step {end:,} of {arm.config.steps:,}."


def curves(arms: Sequence[Arm]) -> Iterator[Part]:
    """Yield the learning curves, task by task."""
    yield Heading("Learning curves")
    looks = looks_of(arm.label for arm in arms)
    for place, group in by_place(arms).items():
        for start in range(0, len(group), MOST_CURVES):
            runs = [(arm.label, arm.rows) for arm in group[start : start + MOST_CURVES]]
            yield Picture(place, figure_of(runs, place, group[0].marks, looks=looks))


def returns(arms: Sequence[Arm]) -> Iterator[Part]:
    """Yield tables of scores with intervals, maximum average returns and the paper's, worst seeds and drawdowns."""
    yield Heading("Returns")
    for place, group in by_place(arms).items():
        runs = [(arm.label, arm.rows, len(arm.failures)) for arm in group]
        yield report_tables.comparison_table(runs)._replace(title=place)
        yield Table(
            ("method", "maximum average return", "the paper's", "worst seed", "largest drawdown"),
            tuple(map(_extremes, group)),
            note="mean ± standard deviation over seeds",
        )


def _extremes(arm: Arm) -> Row:
    published = paper.RETURNS.get(arm.task, {}).get(arm.published or "") if not arm.condition else None
    last = last_evaluations(arm.rows, POINTS)
    worst = min(last, key=lambda seed: last[seed])
    return Row(
        (
            Cell(arm.label),
            report_tables.plus_minus(over_seeds(arm.best()[0])),
            Cell(f"{published.mean:,.2f} ± {published.std:,.2f}", published.mean) if published else EMPTY,
            Cell(f"{number(last[worst])} (seed {worst})", last[worst]),
            report_tables.plus_minus(over_seeds(map(drawdown, evaluation_matrix(arm.rows)[2]))),
        )
    )


def efficiency(arms: Sequence[Arm]) -> Iterator[Part]:
    """Yield tables of the steps to the lowest of the maximum average returns."""
    yield Heading("Steps to the lower boundary of the maximum average returns")
    for place, group in by_place(arms).items():
        if len(group) < 2:
            continue
        boundary, rows = paper.lower_boundary(group), []
        for arm in group:
            steps = paper.interactions(arm, boundary)
            middle, reached = float(np.median(steps)), int(np.isfinite(steps).sum())
            published = paper.INTERACTIONS.get(arm.task, {}).get(arm.published or "", math.nan)
            cells = [Cell("not reached" if math.isinf(middle) else f"{middle:,.0f}", middle)]
            cells += [Cell(f"{reached} of {len(steps)}", reached), numeric(published, f"{published:,.0f}")]
            rows.append(Row((Cell(arm.label), *cells)))
        headings = ("method", "steps of the median seed", "seeds that get there", "the paper's")
        yield Table(headings, tuple(rows), f"{place}, return {number(boundary)}")


def robustness(arms: Sequence[Arm]) -> Iterator[Part]:
    """Yield tables of what each perturbation cost, measured up to the next one."""
    if any(arm.marks for arm in arms):
        yield Heading("Perturbations")
    for group in by_place(arm for arm in arms if arm.marks).values():
        steps = [step for step, _ in group[0].marks]
        for (step, text), since, until in zip(group[0].marks, [-1, *steps], [*steps[1:], None], strict=False):
            found = [recoveries(arm.label, arm.rows, step, until, since) for arm in group]
            yield report_tables.recovery_table(found)._replace(title=f"{group[0].task}, {text} after step {step:,}")


def cases(arms: Sequence[Arm]) -> Iterator[Part]:
    """Yield tables of how often success and events occurred in the last evaluations."""
    tables = []
    for place, group in by_place(arms).items():
        if table := report_tables.case_comparison_table([(arm.label, last_rows(arm.rows, POINTS)) for arm in group]):
            tables.append(table._replace(title=place))
    if tables:
        yield Heading("How episodes end, in the last three evaluations")
        yield from tables


def success(arms: Sequence[Arm]) -> Iterator[Part]:
    """Yield curves of the share of successful episodes."""
    with_success = [arm for arm in arms if is_case(arm.rows["success"])]
    looks = looks_of(arm.label for arm in arms)
    if with_success:
        yield Heading("Success")
    for place, group in by_place(with_success).items():
        runs = []
        for arm in group:
            rows = arm.rows.copy()
            rows["return"] = np.nan_to_num(rows["success"], nan=0.0)
            runs.append((arm.label, rows))
        figure = figure_of(runs, place, group[0].marks, "share of episodes with success", (-0.05, 1.05), looks)
        yield Picture(f"{place}, success", figure)


SECTIONS: Mapping[str, Callable[[Sequence[Arm]], Iterator[Part]]] = {
    "curves": curves,
    "returns": returns,
    "efficiency": efficiency,
    "robustness": robustness,
    "success": success,
    "cases": cases,
}


ANALYSES = ("curves", "returns", "robustness", "success", "cases")  # of runs outside a study


def over_tasks(arms: Sequence[Arm]) -> Iterator[Part]:
    """Yield a table of scores over all tasks, as shares of one method's means, if methods share tasks and seeds."""
    unchanged = [arm for arm in arms if not arm.condition]
    tasks = list(dict.fromkeys(arm.task for arm in unchanged))
    scores = {(arm.label, arm.task): last_evaluations(arm.rows, POINTS) for arm in unchanged}
    methods = {arm.label: arm.config.algorithm for arm in unchanged}
    methods = {label: name for label, name in methods.items() if all((label, task) in scores for task in tasks)}
    common = [set(scores[label, task]) for label in methods for task in tasks]
    seeds = sorted(set.intersection(*common)) if common else []
    if len(tasks) < 2 or len(methods) < 2 or not seeds:
        return
    first = next((label for label, name in methods.items() if name != "csac"), next(iter(methods)))
    values = {label: np.array([[scores[label, task][seed] for task in tasks] for seed in seeds]) for label in methods}
    reference = values[first].mean(axis=0)  # [task]
    if (reference <= 0).any():
        return
    rows = []
    for label, own in values.items():
        above = EMPTY if label == first else report_tables.above(own, values[first])
        middle = report_tables.middle(own / reference, ".2f")
        rows.append(Row((Cell(label), middle, above, Cell(str(own.size), own.size))))
    yield Heading("Over all tasks")
    note = f"{', '.join(tasks)}; seeds {', '.join(map(str, seeds))}; scores as shares of the mean of {first}"
    headings = ("method", "IQM (95 % bootstrap interval)", f"above {first}, probability (95 %)", "runs")
    yield Table(headings, tuple(rows), note)


def paper_claims(arms: Sequence[Arm]) -> Iterator[Part]:
    """Yield the verdicts on the paper's claims."""
    if not (found := paper.claims(arms)):
        return
    rows = []
    for claim in found:
        verdict, why = claim.verdict()
        texts = claim.arm.place, f"{claim.arm.label}: {claim.text} than {claim.other.label}", verdict, why
        rows.append(Row(tuple(map(Cell, texts))))
    yield Heading("The paper's claims")
    counts = Counter(row.cells[2].text for row in rows)
    summary = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    yield f"Of {len(rows)}: {summary}. Not corrected for their number."
    yield Table(("task", "claim", "verdict", "because"), tuple(rows))


def hyperparameters(arms: Sequence[Arm]) -> Iterator[Part]:
    """Yield the hyperparameters that differ between the methods, and those that are the same in all of them."""
    methods: dict[str, list[dict[str, str]]] = {}
    for arm in arms:
        if arm.runs:
            texts = {name: plain(value) for name, value in settings(arm.config).items()}
            methods.setdefault(arm.label, []).append(texts)
    if not methods:
        return
    every = [own for several in methods.values() for own in several]
    apart = differing(every)
    rows = [
        Row((Cell(name), *(Cell("; ".join(dict.fromkeys(own.get(name, "") for own in m))) for m in methods.values())))
        for name in apart
    ]
    yield Heading("Hyperparameters")
    if rows:
        yield Table(("what differs", *methods), tuple(rows))
    yield "The same in all: " + ", ".join(f"{name} {value}" for name, value in every[0].items() if name not in apart)


def provenance(arms: Sequence[Arm], commands: Sequence[str]) -> Iterator[Part]:
    """Yield the versions, machines and times of the runs, and the commands that reproduce them."""
    runs = [run for arm in arms for run in arm.runs]
    if runs:
        manifests = [run.manifest for run in runs]
        begun = [run.manifest.forked_from.step if run.manifest.forked_from else 0 for run in runs]
        paces = [(seconds_per_step(run), run.manifest.steps_done - at) for run, at in zip(runs, begun, strict=True)]
        times = [pace * steps for pace, steps in paces if pace]
        versions = {f"{name} {version}" for one in manifests for name, version in one.versions.items()}
        yield Heading("Where the numbers come from")
        commits = {one.commit or "unknown" for one in manifests}
        yield f"Versions: {', '.join(sorted(versions))}; commit {', '.join(sorted(commits))}."
        machines = {one.machine.gpu or one.machine.processor or "unknown" for one in manifests}
        time = f", {duration(sum(times))} in all" if times else ""
        yield f"Machines: {', '.join(sorted(machines))}{time}."
    yield Heading("Commands")
    yield Commands(tuple(commands))
    trained = [command for arm in arms if arm.runs for command in _commands_of(arm) if command]
    if trained:
        yield "Each method by itself:"
        yield Commands(tuple(dict.fromkeys(trained)))


def _commands_of(arm: Arm) -> list[str | None]:
    """Return the commands that train an arm's seeds; of what no such command names, the one typed, if any."""
    config, manifest = arm.config, arm.runs[0].manifest
    is_default = config.evaluation_seed == EVALUATION_SEED  # no option sets another
    if config.task_is_callable or config.demonstrations or manifest.forked_from or not is_default:
        return [manifest.command]
    seeds = np.sort([run.seed for run in arm.runs])
    consecutive = np.split(seeds, np.flatnonzero(np.diff(seeds) > 1) + 1)
    return [train_command(config, some.tolist()) for some in consecutive]
