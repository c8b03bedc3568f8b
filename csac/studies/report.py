"""The report of a study: claims and their verdicts, published numbers beside measured ones, figures, provenance."""

from __future__ import annotations

import json
import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.console.tables import duration
from csac.record.atomic import write_atomically
from csac.record.rendering import Cell, Row, Table, markdown, number, numeric, short
from csac.record.summaries import compare, recoveries
from csac.record.summary_tables import case_comparison_table, comparison_table, plus_minus, recovery_table
from csac.studies import figures, paper
from csac.studies.arms import Arm, gather, with_rows
from csac.studies.cells import complete
from csac.studies.claims import comparisons, decide, interactions, lower_boundary, tasks_of
from csac.tasks.perturbations import by_step, perturbations_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from csac.record.manifest import Manifest
    from csac.studies.results import Source
    from csac.studies.study import Study

MOST_CURVES = 7  # that are told apart in one picture
_VERDICTS = (
    "Reproduced: the 95 % bootstrap interval of the probability that a seed of the first is better than one of the "
    "second lies above one half; not reproduced: it lies below; else not yet decidable. Each claim is held against "
    "both variants of CSAC; no correction is made for the number of claims."
)
_BOUNDARY = (
    "The boundary is the lowest maximum average return, as measured here, of the methods that the paper has too. A "
    "seed that does not get there has needed more steps than its run has. Lines on the bars: the range of the seeds."
)


def write_report(studies: Sequence[Study], source: Source, directory: Path, commands: Sequence[str]) -> Path:
    """Write `report.md` and its figures into `directory`, and return its path; `commands` made it."""
    directory.mkdir(parents=True, exist_ok=True)
    parts: list[str] = []
    for study in studies:
        parts += _Writer(study, gather(study, source), directory).lines(commands)
    path = directory / "report.md"
    write_atomically(path, ("\n\n".join(parts) + "\n").encode())
    return path


class _Writer:
    """The report of one study, part by part; each part is a paragraph, a table or a picture in Markdown."""

    def __init__(self, study: Study, arms: list[Arm], directory: Path) -> None:
        self.study, self.arms, self.directory = study, arms, directory

    def lines(self, commands: Sequence[str]) -> Iterator[str]:
        """Yield the parts."""
        yield f"# {self.study.title}"
        if self.study.scale < 1:
            text = f"Every run is shortened to {self.study.scale:g} of its steps"
            yield f"**{text}.** Runs that are shorter than the paper's neither confirm nor refute it."
        yield self._count()
        if with_rows(self.arms):
            yield from self._claims()
            kinds: Mapping[str, Callable[[], Iterator[str]]] = {
                "curves": self._curves,
                "returns": self._returns,
                "efficiency": self._efficiency,
                "robustness": self._robustness,
                "cases": self._cases,
                "success": self._success,
            }
            for analysis in self.study.analyses:
                yield from kinds[analysis]()
        yield from self._hyperparameters()
        yield from self._provenance()
        yield from self._commands(commands)

    def _titled(self, text: str) -> str:
        return text + (f" (scale {self.study.scale:g})" if self.study.scale < 1 else "")

    def _count(self) -> str:
        """Say how much of the study there is, and what is missing."""
        done = sum(len(arm.records) for arm in self.arms)
        failed = sum(len(arm.failures) for arm in self.arms)
        missing = sum(len(arm.missing) for arm in self.arms)
        text = f"{done} of {done + failed + missing} cells are complete"
        text += f", {failed} failed" * bool(failed) + f", {missing} are not over" * bool(missing) + "."
        lines = [
            f"- {_name(arm)}, seed {seed} failed: {reason}"
            for arm in self.arms
            for seed, reason in arm.failures.items()
        ]
        lines += [f"- {_name(arm)}: no seed {', '.join(map(str, arm.missing))} yet" for arm in self.arms if arm.missing]
        return "\n".join([text, "", *lines] if lines else [text])

    def _claims(self) -> Iterator[str]:
        decisions = [
            decide(one, self.study.scale == 1) for one in comparisons(self.study.name, self.study.analyses, self.arms)
        ]
        if not decisions:
            return
        yield self._titled("## The paper's claims")
        rows = [Row((Cell(one.claim), Cell(one.verdict), Cell(one.why))) for one in decisions]
        yield markdown(Table(("claim", "verdict", "because"), tuple(rows)))
        yield _VERDICTS

    def _curves(self) -> Iterator[str]:
        yield self._titled("## Learning curves")
        for task, arms in tasks_of(with_rows(self.arms)).items():
            for suffix, some in _pictures(arms):
                title = self._titled(f"{task}{suffix and f', {suffix}'}")
                path = self._path("curve", f"{task} {suffix}")
                figures.curves(path, title, [(arm.label, arm.rows) for arm in some])
                yield _picture(title, path)

    def _returns(self) -> Iterator[str]:
        yield self._titled("## Maximum average returns")
        for task, arms in tasks_of(with_rows(self.arms)).items():
            published = paper.RETURNS.get(task, {})
            rows = []
            for arm in arms:
                over, (_, step) = arm.maximum(), arm.best()
                told = published.get(arm.method.published or "")
                cells = (
                    Cell(arm.label),
                    Cell(f"{told.mean:,.2f} ± {told.std:,.2f}", told.mean) if told else Cell("", math.nan),
                    plus_minus(over),
                    numeric(step, f"{step:,}"),
                    Cell(str(over.seeds), over.seeds),
                )
                rows.append(Row(cells))
            headings = ("method", "the paper", "measured", "at step", "seeds")
            yield markdown(Table(headings, tuple(rows), self._titled(task)))
            yield markdown(comparison_table(compare([(arm.label, arm.rows) for arm in arms])))
        yield "Mean ± standard deviation over seeds at the evaluation where that mean is highest."

    def _efficiency(self) -> Iterator[str]:
        yield self._titled("## Interactions to the lower boundary of the maximum average returns")
        for task, arms in tasks_of(with_rows(self.arms)).items():
            threshold = lower_boundary(arms)
            if math.isnan(threshold):
                continue
            published, rows, bars = paper.INTERACTIONS.get(task, {}), [], []
            for arm in arms:
                steps = interactions(arm, threshold)
                median, told = float(np.median(steps)), float(published.get(arm.method.published or "", math.nan))
                reached = int(np.isfinite(steps).sum())
                cells = (
                    Cell(arm.label),
                    numeric(told, f"{told:,.0f}"),
                    numeric(median, figures.NOT_REACHED if math.isinf(median) else f"{median:,.0f}"),
                    Cell(f"{reached} of {len(steps)}", reached),
                )
                rows.append(Row(cells))
                bars.append(
                    figures.Bar(arm.label, median, *figures.reach(steps), told if self.study.scale == 1 else math.nan)
                )
            title = self._titled(f"{task}, return {number(threshold)}")
            yield markdown(Table(("method", "the paper", "measured, median seed", "reached"), tuple(rows), title))
            path = self._path("interactions", task)
            figures.bars(path, title, "environment steps", bars)
            yield _picture(title, path)
        yield _BOUNDARY

    def _robustness(self) -> Iterator[str]:
        yield self._titled("## Perturbations")
        for (task, condition), arms in _by_condition(with_rows(self.arms)).items():
            perturbed = by_step(perturbations_of(condition))
            if not perturbed:
                continue
            step, text = perturbed[0]
            title = self._titled(f"{task}, {text} after step {step:,}")
            path = self._path("friction" if "friction" in text else "perturbed", f"{task} {text}")
            figures.curves(path, title, [(arm.label, arm.rows) for arm in arms], perturbed)
            yield _picture(title, path)
            until = perturbed[1][0] if len(perturbed) > 1 else None
            yield markdown(
                recovery_table([recoveries(arm.label, arm.rows, step, until) for arm in arms])._replace(title=title)
            )

    def _cases(self) -> Iterator[str]:
        yield self._titled("## How rollouts end")
        for task, arms in tasks_of(with_rows(self.arms)).items():
            told = [(arm.label, arm.rollouts) for arm in arms if len(arm.rollouts)]
            if told and (table := case_comparison_table(told)):
                yield markdown(table._replace(title=self._titled(task)))
        rows = [
            Row((Cell(name), *(Cell(f"{one.mean:g} ± {one.std:g}", one.mean) for one in published.values())))
            for name, published in paper.CASES.items()
        ]
        headings = (f"per {paper.ROLLOUTS:,} rollouts", *paper.METHODS)
        yield markdown(Table(headings, tuple(rows), "The paper"))

    def _success(self) -> Iterator[str]:
        yield self._titled("## Success")
        for task, arms in tasks_of(with_rows(self.arms)).items():
            title, path = self._titled(f"{task}, success"), self._path("success", task)
            figures.success_curves(path, title, [(arm.label, arm.rows) for arm in arms])
            yield _picture(title, path)
        told = ", ".join(f"{name} by {short(steps)} steps" for name, steps in paper.SUCCESS_STEPS.items())
        yield f"In the paper success is near 100 % for {told}."

    def _hyperparameters(self) -> Iterator[str]:
        yield "## Hyperparameters"
        task = self.study.tasks[0]
        names: dict[str, dict[str, Any]] = {}
        for method in self.study.methods:
            for name, value in method.hyperparameters_on(task).items():
                names.setdefault(name, {})[method.label] = value
        rows = [
            Row((Cell(name), *(Cell(_plain(values.get(method.label))) for method in self.study.methods)))
            for name, values in names.items()
        ]
        yield markdown(Table((f"on {task}", *(method.label for method in self.study.methods)), tuple(rows)))
        if self.study.scale < 1:
            yield "Warm-up is a tenth of a shortened run at most; runs are evaluated twenty times at least."

    def _provenance(self) -> Iterator[str]:
        records = [record for arm in self.arms for record in arm.records]
        if not records:
            return
        yield "## Where the numbers come from"
        seconds = [record.seconds for record in records if record.seconds]
        manifests = [record.manifest for record in records]
        versions = [f"{name} {version}" for one in manifests for name, version in one.versions.items()]
        published = any(method.published for method in self.study.methods)
        lines = [f"- {text}" for text in paper.INFERRED * published]
        lines += [
            f"- Versions: {', '.join(dict.fromkeys(versions))}",
            f"- Commit: {', '.join(sorted({str(one.commit) for one in manifests}))}",
            f"- Device: {', '.join(sorted({_device(one) for one in manifests}))}",
            f"- Wall time: {duration(sum(seconds))} in {len(seconds)} cells, one after another",
        ]
        yield "\n".join(lines)

    def _commands(self, commands: Sequence[str]) -> Iterator[str]:
        yield "## Commands"
        yield "\n".join(["```sh", *commands, "```"])
        yield "Each arm by itself, all its seeds in one run:"
        arms = (_train_command(arm, self.study.seeds) for arm in self.arms if arm.records)
        yield "```sh\n" + "\n".join(arms) + "\n```"

    def _path(self, kind: str, text: str) -> Path:
        """Return where a picture goes; the format is added."""
        words = "".join(letter if letter.isalnum() or letter == "." else " " for letter in f"{kind} {text}").split()
        scale = [f"scale {self.study.scale:g}"] * (self.study.scale < 1)
        return self.directory / ("-".join([self.study.name, *words, *"-".join(scale).split()]).lower() + ".png")


def _pictures(arms: list[Arm]) -> list[tuple[str, list[Arm]]]:
    """Return the arms picture by picture: all in one, or by variant where they would be too many."""
    groups: dict[str, list[Arm]] = {}
    for arm in arms:
        groups.setdefault(arm.label.partition(", ")[0], []).append(arm)
    if len(arms) <= MOST_CURVES or min(map(len, groups.values())) == 1:
        return [("", arms)]
    return list(groups.items())


def _by_condition(arms: Sequence[Arm]) -> dict[tuple[str, tuple[str, ...]], list[Arm]]:
    groups: dict[tuple[str, tuple[str, ...]], list[Arm]] = {}
    for arm in arms:
        groups.setdefault((arm.task, arm.condition), []).append(arm)
    return groups


def _name(arm: Arm) -> str:
    return ", ".join([f"{arm.label} on {arm.task}", *arm.condition])


def _picture(title: str, path: Path) -> str:
    return f"![{title}]({path.name}) ([SVG]({path.with_suffix('.svg').name}))"


def _plain(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    return (
        ""
        if value is None
        else f"{value:g}"
        if isinstance(value, float)
        else f"{value:,}"
        if type(value) is int
        else str(value)
    )


def _device(manifest: Manifest) -> str:
    return f"{manifest.device} ({manifest.machine.processor})" if manifest.machine.processor else manifest.device


def _train_command(arm: Arm, seeds: int) -> str:
    """Return the `csac train` that trains every seed of an arm in one run."""
    one = arm.records[0].manifest
    words = ["csac", "train", one.task, "--algorithm", one.algorithm, "--steps", str(one.steps), "--seeds", str(seeds)]
    words += ["--evaluation-interval", str(one.evaluation.interval)]
    words += ["--evaluation-episodes", str(one.evaluation.episodes)]
    words += [word for perturbation in one.perturbations for word in ("--perturb", perturbation)]
    words += ["--env-kwargs", json.dumps(one.environment_arguments)] * bool(one.environment_arguments)
    words += ["--events", ",".join(one.events)] * bool(one.events)
    default = complete(one.algorithm, {})
    for name, value in complete(one.algorithm, one.hyperparameters).items():
        if value != default[name]:
            words += _option(name, value)
    return shlex.join(words)


def _option(name: str, value: Any) -> list[str]:
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{flag}" if value else f"--no-{flag}"]
    return [f"--{flag}", *map(str, value if isinstance(value, tuple) else (value,))]
