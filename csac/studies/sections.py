"""The sections of a report, each of the arms that it is about: what `report` and `run_report` have in common."""

from __future__ import annotations

import hashlib
import math
import re
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from csac.console.tables import duration
from csac.record.curves import NEXT
from csac.record.plots import NO_LOOKS, Panel, looks_of
from csac.record.rendering import Cell, Row, Table, number, numeric, short
from csac.record.summaries import case_names, compare, recoveries
from csac.record.summaries import cases as cases_of
from csac.record.summary_tables import (
    ROLLOUTS,
    case_comparison_table,
    comparison_table,
    plus_minus,
    recovery_table,
)
from csac.studies import paper
from csac.studies.arms import by_condition, tasks_of, variant_of
from csac.studies.claims import interactions, lower_boundary
from csac.studies.figures import (
    NOT_REACHED,
    RANGE,
    TO_EITHER_SIDE,
    Bar,
    BarPanel,
    Bars,
    Curves,
    Line,
    Trend,
    bar_over_seeds,
    reach,
    seeds_note,
    success_curves,
    tells_of_success,
)
from csac.studies.parts import Commands, Figure, Heading, Items, Paragraph
from csac.studies.stability import stability_table
from csac.tasks.perturbations import by_step, perturbations_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from csac.record.manifest import Manifest
    from csac.record.plots import Look
    from csac.record.summaries import RunSummary
    from csac.studies.arms import Arm
    from csac.studies.figures import Drawing
    from csac.studies.parts import Part

MOST_CURVES = 7  # that are told apart in one picture
MOST_PANELS = 3  # side by side
LONGEST_FILE = 150  # bytes of a picture's name, before a hash: a condition of many steps would not fit into 255
SYMBOLS = {"relative_entropy_weight": "tau", "entropy_weight": "sigma"}
_BOUNDARY = (
    "The boundary is the lowest maximum average return, as measured here, of the methods that the paper has too. A "
    "seed that does not get there has needed more steps than its run has."
)
_SMOOTHING = "Curves are not smoothed: each point is the mean over the episodes of one evaluation."


class Scope(NamedTuple):
    """What its titles, files and pictures share in a report: its name, how much its runs are shortened, its looks."""

    name: str
    scale: float = 1.0
    looks: Mapping[str, Look] = NO_LOOKS
    """The look of each label in every picture."""

    def titled(self, text: str) -> str:
        """Return a title that says the scale."""
        return text + (f" (scale {self.scale:g})" if self.scale < 1 else "")

    def file(self, kind: str, text: str) -> str:
        """Return what the files of a picture are called, without a suffix."""
        text = re.sub(r"(?<![\w.])[-−](?=[\d.])", "minus ", text)  # two signs of a number are two pictures
        words = "".join(letter if letter.isalnum() or letter == "." else " " for letter in f"{kind} {text}").split()
        scale = ["scale", f"{self.scale:g}"] if self.scale < 1 else []
        name = "-".join([self.name, *words, *scale]).lower()
        if len(name.encode()) <= LONGEST_FILE:
            return name
        digest = hashlib.sha256(name.encode()).hexdigest()[:8]
        return f"{name.encode()[:LONGEST_FILE].decode(errors='ignore')}-{digest}"

    def figure(self, kind: str, text: str, drawing: Drawing, title: str = "") -> Figure:
        """Return a figure about `text`, which is its title too where it is given none."""
        return Figure(self.file(kind, text), self.titled(title or text), drawing._replace(looks=self.looks))


def report_looks(labels: Sequence[str], known: Mapping[str, Look] = NO_LOOKS) -> dict[str, Look]:
    """Return the looks of the labels of a report, of what stands before their first commas, and those known already."""
    looks = {**known, **looks_of(labels, known)}
    return {**looks, **looks_of(map(variant_of, labels), looks)}


def curves(arms: Sequence[Arm], scope: Scope) -> Iterator[Part]:
    """Learning curves, task by task; more than can be told apart in one picture stand in one for each variant."""
    yield Heading(scope.titled("Learning curves"))
    for (task, condition), own in by_condition(arms).items():
        for suffix, some in _pictures(own):
            panel = Panel(_runs(some), marks=marks_of(condition))
            title = ", ".join(filter(None, (described(task, condition), suffix))) or "all runs"
            yield scope.figure("curve", title, Curves((panel,)))
    yield Paragraph(_SMOOTHING)


def returns(arms: Sequence[Arm], scope: Scope) -> Iterator[Part]:
    """Maximum average returns, the paper's beside them, what the last evaluations say, and how steady learning was."""
    yield Heading(scope.titled("Maximum average returns"))
    for (task, condition), own in by_condition(arms).items():
        yield returns_table(own, scope.titled(described(task, condition)))
        yield comparison_table(compared(own))
        yield stability_table(own, scope.titled(", ".join(filter(None, (described(task, condition), "stability")))))
        for name, trend in _trends(own):
            yield scope.figure("returns", f"{described(task, condition)}, over {name}", trend)
    yield Paragraph("Mean ± standard deviation over seeds at the evaluation where that mean is highest.")


def compared(arms: Sequence[Arm]) -> tuple[RunSummary, ...]:
    """Return the arms of one task and condition beside each other, with how many of their seeds have failed."""
    return compare(_runs(arms), {arm.label: arm.failures for arm in arms})


def returns_table(arms: Sequence[Arm], title: str) -> Table:
    """Return the maximum average returns of the arms of one task and condition; where nothing changes, the paper's."""
    is_of_the_paper = not arms[0].condition and any(arm.published for arm in arms)
    published = paper.RETURNS.get(arms[0].task, {}) if is_of_the_paper else {}
    rows = []
    for arm in arms:
        over, (_, step), told = arm.maximum(), arm.best(), published.get(arm.published or "")
        beside = Cell(f"{told.mean:,.2f} ± {told.std:,.2f}", told.mean) if told else Cell("", math.nan)
        cells = (numeric(step, f"{step:,}"), Cell(str(over.seeds), over.seeds))
        rows.append(Row((Cell(arm.label), *[beside] * bool(published), plus_minus(over), *cells)))
    headings = ("method", *["the paper"] * bool(published), "measured", "at step", "seeds")
    return Table(headings, tuple(rows), title)


def efficiency(arms: Sequence[Arm], scope: Scope) -> Iterator[Part]:
    """Interactions to the lower boundary of the maximum average returns."""
    yield Heading(scope.titled("Interactions to the lower boundary of the maximum average returns"))
    for (task, condition), own in by_condition(arms).items():
        threshold = lower_boundary(own)
        if math.isnan(threshold):
            continue
        published = {} if condition else paper.INTERACTIONS.get(task, {})
        rows, bars, seeds = [], [], []
        for arm in own:
            steps = interactions(arm, threshold)
            median, told = float(np.median(steps)), float(published.get(arm.published or "", math.nan))
            reached = int(np.isfinite(steps).sum())
            seeds.append(len(steps))
            cells = (
                *[numeric(told, f"{told:,.0f}")] * bool(published),
                numeric(median, NOT_REACHED if math.isinf(median) else f"{median:,.0f}"),
                Cell(f"{reached} of {len(steps)}", reached),
            )
            rows.append(Row((Cell(arm.label), *cells)))
            bars.append(Bar(arm.label, median, *reach(steps), told if scope.scale == 1 else math.nan))
        where = described(task, condition)
        title = f"{where}, return {number(threshold)}"
        headings = ("method", *["the paper"] * bool(published), "measured, median seed", "reached")
        yield Table(headings, tuple(rows), scope.titled(title))
        note = f"bars: median seed{NEXT}{seeds_note(RANGE, seeds)}"
        drawing = Bars((BarPanel(tuple(bars)),), "environment steps", NOT_REACHED, note)
        yield scope.figure("interactions", where, drawing, title)
    yield Paragraph(_BOUNDARY)


def robustness(arms: Sequence[Arm], scope: Scope) -> Iterator[Part]:
    """What perturbations cost: for each task its conditions side by side, and a table for each change of each."""
    yield Heading(scope.titled("Perturbations"))
    for task, own in tasks_of([arm for arm in arms if arm.condition]).items():
        conditions = list(by_condition(own).items())
        for start in range(0, len(conditions), MOST_PANELS):
            some = conditions[start : start + MOST_PANELS]
            panels = [Panel(_runs(each), marks=marks_of(condition)) for (_, condition), each in some]
            kind = "friction" if all("friction" in panel.marks[0][1] for panel in panels) else "perturbed"
            title = described(task, some[0][0][1]) if len(some) == 1 else f"{task}, {kind}"
            number_of_it = f" {start // MOST_PANELS + 1}" * (len(conditions) > MOST_PANELS)
            if len(some) > 1:
                panels = [panel._replace(title=", ".join(text for _, text in panel.marks)) for panel in panels]
            yield scope.figure(kind, f"{task}{number_of_it}", Curves(tuple(panels)), title)
        titles = [title for (_, condition), _ in conditions for title in titles_of_changes(task, condition)]
        for (_, condition), each in conditions:
            for index, title in enumerate(titles_of_changes(task, condition)):
                if titles.count(title) > 1 and len(marks_of(condition)) > 1:  # another condition has the same change
                    title = f"{title} (in {_changes(condition)})"
                yield recoveries_table(each, marks_of(condition), index)._replace(title=scope.titled(title))


def recoveries_table(arms: Sequence[Arm], perturbed: Sequence[tuple[int, str]], index: int = 0) -> Table:
    """Return what the change number `index` cost each arm, as far as the next."""
    step = perturbed[index][0]
    until = perturbed[index + 1][0] if index + 1 < len(perturbed) else None
    since = perturbed[index - 1][0] if index else -1
    return recovery_table([recoveries(arm.label, arm.rows, step, until, since) for arm in arms])


def cases(arms: Sequence[Arm], scope: Scope) -> Iterator[Part]:
    """How fresh rollouts end, as bars and in a table, and the paper's table."""
    yield Heading(scope.titled("How rollouts end"))
    for (task, condition), own in by_condition(arms).items():
        told = [(arm, arm.rollouts) for arm in own if len(arm.rollouts)]
        table = case_comparison_table([(arm.label, rows) for arm, rows in told]) if told else None
        if not table:
            continue
        is_of_the_paper = task == paper.CASES_TASK and not condition
        where, panels = described(task, condition), _case_panels(told, scope.scale == 1 and is_of_the_paper)
        for start in range(0, len(panels), MOST_PANELS):
            some = panels[start : start + MOST_PANELS]
            title = ", ".join(filter(None, (where, *(panel.title for panel in some))))
            note = seeds_note(TO_EITHER_SIDE, [len(np.unique(rows["seed"])) for _, rows in told])
            yield scope.figure("cases", title, Bars(tuple(some), f"per {ROLLOUTS:,} rollouts", note=note))
        yield table._replace(title=scope.titled(where))
    if any(arm.published and arm.task == paper.CASES_TASK and not arm.condition for arm in arms):
        rows = [
            Row((Cell(name), *(Cell(f"{one.mean:g} ± {one.std:g}", one.mean) for one in published.values())))
            for name, published in paper.CASES.items()
        ]
        yield Table((f"per {paper.ROLLOUTS:,} rollouts", *paper.METHODS), tuple(rows), "The paper")


def success(arms: Sequence[Arm], scope: Scope) -> Iterator[Part]:
    """Curves of the share of successful episodes."""
    yield Heading(scope.titled("Success"))
    for (task, condition), own in by_condition([arm for arm in arms if tells_of_success(arm.rows)]).items():
        title = f"{described(task, condition)}, success"
        yield scope.figure("success", title, success_curves(_runs(own), marks_of(condition)))
    if any(arm.published and arm.task == paper.SUCCESS_TASK for arm in arms):
        told = ", ".join(f"{name} by {short(steps)} steps" for name, steps in paper.SUCCESS_STEPS.items())
        yield Paragraph(f"In the paper success is near 100 % for {told}.")


def provenance(arms: Sequence[Arm], more: Sequence[str] = ()) -> Iterator[Part]:
    """Versions, commit, device and wall time of every run, and which of them went on for longer."""
    manifests = [manifest for arm in arms for manifest in arm.manifests]
    if not manifests:
        return
    seconds = [time.seconds for arm in arms for time in arm.times]
    versions = [f"{name} {version}" for one in manifests for name, version in one.versions.items()]
    yield Heading("Where the numbers come from")
    lines = [
        *more,
        f"Versions: {', '.join(dict.fromkeys(versions))}",
        f"Commit: {', '.join(sorted({one.commit or 'unknown' for one in manifests}))}",
        f"Device: {', '.join(sorted({_device(one) for one in manifests}))}",
    ]
    if seconds:
        runs = f"{len(seconds)} run{'s' * (len(seconds) > 1)}"
        lines.append(f"Wall time: {duration(sum(seconds))} in {runs}" + ", one after another" * (len(seconds) > 1))
    yield Items((*lines, *_beginnings(arms)))


def commands(lines: Sequence[str], runs: Sequence[str], told: str) -> Iterator[Part]:
    """The commands that have made the report, and those of the runs."""
    yield Heading("Commands")
    yield Commands(tuple(lines))
    if runs:
        yield Paragraph(told)
        yield Commands(tuple(runs))


def described(task: str, condition: Sequence[str]) -> str:
    """Return a task and what was changed there in words."""
    return ", ".join(filter(None, (task, _changes(condition))))


def titles_of_changes(task: str, condition: Sequence[str]) -> list[str]:
    """Return what each change of a condition is called, where it stands by itself."""
    return [", ".join(filter(None, (task, f"{text} after step {step:,}"))) for step, text in marks_of(condition)]


def marks_of(condition: Sequence[str]) -> list[tuple[int, str]]:
    """Return where something changes, and what."""
    return by_step(perturbations_of(condition))


def plain(value: Any) -> str:
    """Return a hyperparameter as people write it."""
    if isinstance(value, tuple | list):
        return " ".join(map(str, value))
    if isinstance(value, float):
        return f"{value:g}"
    return "" if value is None else f"{value:,}" if type(value) is int else str(value)


def _changes(condition: Sequence[str]) -> str:
    return ", ".join(f"{text} after step {step:,}" if step else text for step, text in marks_of(condition))


def _beginnings(arms: Sequence[Arm]) -> Iterator[str]:
    """Tell which seeds are only the beginnings of longer runs, whose time is not theirs."""
    for arm in arms:
        for steps in sorted(set(arm.beginnings.values())):
            own = [seed for seed, longer in arm.beginnings.items() if longer == steps]
            several = len(own) > 1
            seeds = f"seed{'s' * several} {', '.join(map(str, own))}"
            where = ", ".join(filter(None, (arm.label, described(arm.task, arm.condition))))
            what = (
                f"the beginnings of runs of {steps:,} steps"
                if several
                else f"the beginning of a run of {steps:,} steps"
            )
            yield f"{where}, {seeds}: {what}"


def _runs(arms: Sequence[Arm]) -> list[tuple[str, np.ndarray]]:
    return [(arm.label, arm.rows) for arm in arms]


def _pictures(arms: Sequence[Arm]) -> list[tuple[str, list[Arm]]]:
    """Return the arms picture by picture: all in one, or where they would be too many the variants of CSAC in several.

    Whatever else learns is in each of them, beside CSAC.
    """
    ours = [arm for arm in arms if arm.algorithm == "csac"]
    others = [arm for arm in arms if arm.algorithm != "csac"]
    if not ours:
        ours, others = others, ours
    room = MOST_CURVES - len(others)
    if len(arms) <= MOST_CURVES or room < 1:
        return [("", list(arms))]
    groups = _variants(ours)
    if min(map(len, groups.values())) == 1:
        groups = {"": ours}
    pictures = []
    for name, own in groups.items():
        count = math.ceil(len(own) / room)
        for index, places in enumerate(np.array_split(np.arange(len(own)), count), start=1):
            text = " ".join(filter(None, (name, f"{index} of {count}" * (count > 1))))
            pictures.append((text, [*(own[place] for place in places), *others]))
    return pictures


def _variants(arms: Sequence[Arm]) -> dict[str, list[Arm]]:
    """Return the arms by what stands before the first comma of their labels."""
    groups: dict[str, list[Arm]] = {}
    for arm in arms:
        groups.setdefault(variant_of(arm.label), []).append(arm)
    return groups


def _trends(arms: Sequence[Arm]) -> Iterator[tuple[str, Trend]]:
    """Return the maximum average returns over a hyperparameter, where variants differ in that number alone."""
    swept: dict[str, list[Line]] = {}
    seeds: dict[str, list[int]] = {}
    for variant, own in _variants(arms).items():
        names = {name for arm in own for name in arm.hyperparameters}
        differing = [name for name in names if len({plain(arm.hyperparameters.get(name)) for arm in own}) > 1]
        is_alike = len({(arm.algorithm, arm.preset) for arm in own}) == 1
        if is_alike and len(differing) == 1 and all(_is_positive(arm.hyperparameters.get(differing[0])) for arm in own):
            own = sorted(own, key=lambda arm: arm.hyperparameters[differing[0]])
            swept.setdefault(differing[0], []).append(_line(variant, differing[0], own))
            seeds.setdefault(differing[0], []).extend(arm.maximum().seeds for arm in own)
    for name, lines in swept.items():
        symbol = SYMBOLS.get(name)
        told = f"{symbol} ({name.replace('_', ' ')})" if symbol else name.replace("_", " ")
        note = seeds_note(TO_EITHER_SIDE, seeds[name])
        yield symbol or name.replace("_", " "), Trend(tuple(lines), told, "maximum average return", note)


def _line(label: str, name: str, arms: Sequence[Arm]) -> Line:
    over = [arm.maximum() for arm in arms]
    mean, std = (np.array([getattr(one, field) for one in over]) for field in ("mean", "std"))
    x = tuple(float(arm.hyperparameters[name]) for arm in arms)
    return Line(label, x, *(tuple(values.tolist()) for values in (mean, mean - std, mean + std)))


def _is_positive(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value > 0


def _case_panels(told: Sequence[tuple[Arm, np.ndarray]], is_beside_paper: bool) -> list[BarPanel]:
    happens = case_names([rows for _, rows in told])
    names = [name for name, is_case in happens.items() if is_case and name != "success"]  # which has its own curves
    return [
        BarPanel(tuple(_case_bar(arm, rows, name, is_beside_paper) for arm, rows in told), name.replace("_", " "))
        for name in names
    ]


def _case_bar(arm: Arm, rows: np.ndarray, name: str, is_beside_paper: bool) -> Bar:
    found = cases_of(rows, {name: True})
    published = paper.CASES.get(name, {}).get(arm.published or "") if is_beside_paper else None
    if not found:
        return Bar(arm.label, math.nan, math.nan, math.nan)
    return bar_over_seeds(arm.label, found[0].over_seeds, published.mean if published else math.nan, ROLLOUTS)


def _device(manifest: Manifest) -> str:
    model = manifest.machine.gpu or manifest.machine.processor
    return f"{manifest.config.device} ({model})" if model else manifest.config.device
