"""The report of a study: claims and their verdicts, published numbers beside measured ones, figures, provenance."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from typing import TYPE_CHECKING

from csac.record.plots import NO_LOOKS
from csac.record.rendering import Cell, Row, Table
from csac.studies import paper, sections
from csac.studies.aggregates import over_tasks
from csac.studies.arms import gather, with_rows
from csac.studies.cells import complete
from csac.studies.claims import VERDICTS, comparisons, decide
from csac.studies.command_words import changed
from csac.studies.parts import Heading, Paragraph, write
from csac.studies.sections import Scope, report_looks
from csac.studies.settings import hyperparameters
from csac.studies.standing import cells_so_far, wall_times

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from csac.record.plots import Look
    from csac.studies.arms import Arm
    from csac.studies.parts import Part
    from csac.studies.results import Source
    from csac.studies.study import Study

_VERDICTS = (
    "Reproduced: the 95 % bootstrap interval of the probability that a seed of the first is better than one of the "
    "second lies above one half; not reproduced: it lies below; else not yet decidable. No correction is made for the "
    "number of claims."
)

_SECTIONS: Mapping[str, Callable[[Sequence[Arm], Scope], Iterator[Part]]] = {
    "curves": sections.curves,
    "returns": sections.returns,
    "efficiency": sections.efficiency,
    "robustness": sections.robustness,
    "cases": sections.cases,
    "success": sections.success,
}


def write_report(studies: Sequence[Study], source: Source, directory: Path, commands: Sequence[str]) -> Path:
    """Write `report.html`, the same as `report.md`, and the figures into `directory`; return the page's path.

    `commands` have made it. Raises InputError where it cannot be written.
    """
    parts: list[Part] = []
    looks: Mapping[str, Look] = NO_LOOKS
    for study in studies:
        looks = report_looks([method.label for method in study.methods], looks)
        parts += _parts(study, gather(study, source), commands, looks)
    path = directory / "report.html"
    write(path, studies[0].title if len(studies) == 1 else "Studies", parts)
    return path


def train_command(arm: Arm) -> str:
    """Return the `csac train` that trains every seed of an arm in one run."""
    one = arm.manifests[0]
    seeds = {*arm.missing, *arm.failures, *(manifest.config.seed for manifest in arm.manifests)}
    words = ["csac", "train", one.config.task, "--algorithm", one.config.algorithm, "--steps", str(one.config.steps)]
    words += ["--seeds", str(len(seeds)), *(["--first-seed", str(min(seeds))] if min(seeds) else [])]
    words += ["--evaluation-interval", str(one.config.evaluation_interval)]
    words += ["--evaluation-episodes", str(one.config.evaluation_episodes)]
    words += [word for perturbation in one.config.perturbations for word in ("--perturb", perturbation)]
    words += ["--env-kwargs", json.dumps(one.config.environment_arguments)] * bool(one.config.environment_arguments)
    words += ["--events", ",".join(one.config.events)] * bool(one.config.events)
    words += changed(complete(one.config.algorithm, one.config.hyperparameters), complete(one.config.algorithm, {}))
    return shlex.join(words)


def _parts(study: Study, arms: list[Arm], commands: Sequence[str], looks: Mapping[str, Look]) -> Iterator[Part]:
    scope, shown = Scope(study.name, study.scale, looks), with_rows(arms)
    yield Heading(study.title, 1)
    if study.scale < 1:
        told = f"Every run is shortened to {study.scale:g} of its steps."
        yield Paragraph("Runs that are shorter than the paper's neither confirm nor refute it.", told)
    yield from cells_so_far(arms)
    if shown:
        for analysis in study.analyses:
            yield from _SECTIONS[analysis](shown, scope)
            if analysis == "returns":
                yield from over_tasks(arms, scope)
        yield from _claims(study, arms, scope)
    yield from hyperparameters(study)
    published = any(method.published for method in study.methods)
    yield from sections.provenance(arms, paper.INFERRED if published else ())
    yield from wall_times(arms)
    runs = [train_command(arm) for arm in arms if arm.manifests]
    yield from sections.commands(commands, runs, "Each arm by itself, all its seeds in one run:")


def _claims(study: Study, arms: Sequence[Arm], scope: Scope) -> Iterator[Part]:
    """How the paper's claims stand, for each variant of CSAC; those of which a side was not measured are counted."""
    found = comparisons(study, arms)
    measured = [one for one in found if len(one.ours) and len(one.others)]
    if not measured:
        return
    yield Heading(scope.titled("The paper's claims"))
    for variant in dict.fromkeys(one.variant for one in measured):
        decisions = [decide(one) for one in measured if one.variant == variant]
        counts = Counter(one.verdict for one in decisions)
        told = [f"{counts[verdict]} {verdict}" for verdict in VERDICTS]
        rows = [Row((Cell(one.claim), Cell(one.verdict), Cell(one.why))) for one in decisions]
        yield Paragraph(f"{', '.join(told)}.", f"{variant}, {len(decisions)} claims:")
        yield Table((f"{variant} has or shows", "verdict", "because"), tuple(rows))
    if len(found) > len(measured):
        yield Paragraph(f"Of {len(found) - len(measured)} more nothing was measured, or not both sides.")
    yield Paragraph(_VERDICTS)
