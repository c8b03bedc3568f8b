"""`csac report`: any runs side by side, as a page and in Markdown, or as one table of a page that is there already."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from csac.record.files import write_atomically
from csac.record.plots import learning_curve
from csac.record.rendering import Cell, Row, Table, between_markers, markdown
from csac.record.summary_tables import case_comparison_table, comparison_table
from csac.studies import sections
from csac.studies.aggregates import over_tasks
from csac.studies.arms import Arm, by_condition, with_rows
from csac.studies.collected import ROLLOUTS
from csac.studies.comparison import Comparison, seeds_of
from csac.studies.configurations import differing, unlike
from csac.studies.figures import tells_of_success
from csac.studies.parts import Heading, Items, Paragraph, write
from csac.studies.sections import Scope, described, marks_of, plain, report_looks
from csac.studies.standing import wall_times
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from csac.record.plots import Format
    from csac.studies.parts import Part

TableName = Literal["returns", "recovery", "cases"]


def default_page() -> Path:
    """Return where a report goes that is given no place; nothing is created."""
    return Path("runs", "reports", datetime.now().strftime("%Y%m%d-%H%M%S"), "report.html")


def refuse_places(comparison: Comparison, curve: Path | None, page: Path | None) -> None:
    """Raise InputError for a picture or a page that there cannot be, so that nothing is written before it is told."""
    if curve:
        _kind_of(curve)
        _one_group(comparison.arms())
    if page:
        _page(page)


def write_run_report(comparison: Comparison, path: Path, title: str | None, commands: Sequence[str]) -> Path:
    """Write the page `path`, the same in Markdown beside it, and its figures; return the page's path.

    In a directory that is there the page is called report.html. `commands` made it.

    Raises:
        InputError: it cannot be written, or the runs do not go together.
    """
    path, arms = _page(path), comparison.arms()
    title = title or ", ".join(dict.fromkeys(arm.task for arm in arms if arm.task)) or "Runs"
    scope = Scope(path.stem, looks=report_looks([arm.label for arm in arms]))
    write(path, title, list(_parts(comparison, arms, scope, title, commands)))
    return path


def write_table(comparison: Comparison, page: Path, name: str, kind: TableName) -> None:
    """Write one table between the marks `name` of a page in Markdown.

    Raises:
        InputError: the page lacks them or cannot be written, or the runs have no such table.
    """
    tables = _tables(comparison.arms(), kind)
    if not tables:
        raise InputError(f"these runs have no table of {kind}")
    write_between(page, name, "\n\n".join(map(markdown, tables)) + "\n")


def write_between(page: Path, name: str, text: str) -> None:
    """Write `text` between the marks `name` of a page in Markdown.

    Raises:
        InputError: no name is given, or the page lacks its marks or cannot be written.
    """
    if not name:
        raise InputError(f"say between which marks to write: {page}#NAME")
    try:
        new = between_markers(page.read_text(encoding="utf-8"), name, text)
        write_atomically(page, new.encode())
    except FileNotFoundError:
        raise InputError(
            f"cannot write into {page}: there is no such page; make it, with the marks of {name}"
        ) from None
    except OSError as error:
        raise InputError(f"cannot write into {page}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise InputError(f"cannot write into {page}: it is not a text file") from None


def draw_curves(comparison: Comparison, path: Path, title: str | None) -> None:
    """Draw the learning curves of runs of one task as one picture. Raises InputError for several tasks."""
    kind = _kind_of(path)
    (task, condition), arms = _one_group(comparison.arms())
    try:
        learning_curve([(arm.label, arm.rows) for arm in arms], path, title or task, marks_of(condition), (kind,))
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from None


def _page(path: Path) -> Path:
    path = path / "report.html" if path.is_dir() else path
    if path.suffix != ".html":
        raise InputError(f"the report is a page: name it {path.with_suffix('.html')}")
    return path


def _kind_of(picture: Path) -> Format:
    kind = picture.suffix[1:]
    if kind not in ("png", "pdf", "svg"):
        raise InputError(f"a picture is a .png, .pdf or .svg file, not {picture}")
    return kind


def _one_group(arms: Sequence[Arm]) -> tuple[tuple[str, tuple[str, ...]], list[Arm]]:
    """Return the task and condition of these arms, and the arms."""
    groups = list(by_condition(arms).items())
    if len(groups) > 1:
        raise InputError("these runs are of several tasks or perturbations: one picture would mix them")
    return groups[0]


def _tables(arms: Sequence[Arm], kind: TableName) -> list[Table]:
    groups, tables = by_condition(arms), []
    for (task, condition), own in groups.items():
        title = described(task, condition) if len(groups) > 1 else ""
        if kind == "returns":
            found = {title: comparison_table(sections.compared(own))}
        elif kind == "cases":
            tested = [(arm.label, arm.rollouts) for arm in own if len(arm.rollouts)]
            found = {title: case_comparison_table(tested) if tested else None}
        else:
            found = _recoveries(own, title)
        note = _behind(own)
        tables += [
            table._replace(title=title, note=f"{table.note} {note}".strip()) for title, table in found.items() if table
        ]
    return tables


def _recoveries(arms: Sequence[Arm], title: str) -> dict[str, Table]:
    """Return a table for each change of the arms of one task and condition: under `title`, or told from each other."""
    task, condition = arms[0].task, arms[0].condition
    marks = marks_of(condition)
    titles = sections.titles_of_changes(task, condition) if len(marks) > 1 else [title] * len(marks)
    return {title: sections.recoveries_table(arms, marks, index) for index, title in enumerate(titles)}


def _parts(
    comparison: Comparison, arms: list[Arm], scope: Scope, title: str, commands: Sequence[str]
) -> Iterator[Part]:
    shown = with_rows(arms)
    yield Heading(title, 1)
    if comparison.until is not None:
        yield Paragraph(f"Evaluations after step {comparison.until:,} are left out.")
    yield _runs_table(comparison)
    failed = [f"{arm.label}, seed {seed} failed: {reason}" for arm in arms for seed, reason in arm.failures.items()]
    if failed:
        yield Paragraph("Seeds that failed are counted below, and are in no other number.")
        yield Items(tuple(failed))
    if behind := _behind(arms):
        yield Paragraph(behind)
    if plainly := [arm for arm in shown if not arm.condition]:
        yield from sections.curves(plainly, scope)
    if shown:
        yield from sections.returns(shown, scope)
        if changing := unlike(shown):
            yield Paragraph(f"Not the same on every task, see Hyperparameters: {', '.join(changing)}.")
        yield from over_tasks(arms, scope)
    if perturbed := [arm for arm in shown if arm.condition]:
        yield from sections.robustness(perturbed, scope)
    if any(tells_of_success(arm.rows) for arm in shown):
        yield from sections.success(shown, scope)
    if any(len(arm.rollouts) for arm in shown):
        yield from sections.cases(shown, scope)
        none = "has none" if comparison.until is None else f"has none, or went on after step {comparison.until:,},"
        yield Paragraph(f"Rollouts are those of {ROLLOUTS}, and of a run that {none} its last evaluation's episodes.")
    yield from _hyperparameters(shown)
    yield from sections.provenance(arms)
    yield from wall_times(arms)
    lines = [one.command for arm in arms for one in arm.manifests if one.command]
    yield from sections.commands(commands, list(dict.fromkeys(lines)), "The runs:")


def _runs_table(comparison: Comparison) -> Table:
    rows = []
    for run in comparison.runs:
        one, seeds = run.manifest, sorted(seeds_of([run]))
        steps = one.steps_done if one else int(run.rows["step"].max(initial=0))
        told = (one.config.task, one.config.algorithm) if one else ("", "")
        texts = (str(run.path), *told, ", ".join(map(str, seeds)))
        rows.append(Row((*map(Cell, texts), Cell(f"{steps:,}", steps), Cell(one.state if one else ""))))
    return Table(("run", "task", "algorithm", "seeds", "steps", "state"), tuple(rows))


def _hyperparameters(arms: Sequence[Arm]) -> Iterator[Part]:
    """Yield what differs among the arms of each task, and then, once, what is the same in all of them."""
    known = [arm for arm in arms if arm.hyperparameters]
    if not known:
        return
    yield Heading("Hyperparameters")
    for (task, condition), own in by_condition(known).items():
        if names := differing([arm.hyperparameters for arm in own]):
            rows = [Row((Cell(name), *(Cell(plain(arm.hyperparameters.get(name))) for arm in own))) for name in names]
            headings = (f"what differs on {described(task, condition)}", *(arm.label for arm in own))
            yield Table(headings, tuple(rows))
    if changing := list(_between_tasks(known)):
        tasks = dict.fromkeys(arm.task for arm in known)
        yield Table(("what differs between tasks", "hyperparameter", *tasks), tuple(changing))
    others = differing([arm.hyperparameters for arm in known])
    same = {name: value for name, value in known[0].hyperparameters.items() if name not in others}
    rows = [Row((Cell(name), Cell(plain(value)))) for name, value in same.items()]
    yield Table(("the same in all", "value"), tuple(rows))


def _between_tasks(arms: Sequence[Arm]) -> Iterator[Row]:
    tasks = dict.fromkeys(arm.task for arm in arms)
    for label, names in unlike(arms).items():
        for name in names:
            values = {arm.task: plain(arm.hyperparameters.get(name)) for arm in arms if arm.label == label}
            yield Row((Cell(label), Cell(name), *(Cell(values.get(task, "")) for task in tasks)))


def _behind(arms: Sequence[Arm]) -> str:
    """Say which seeds are in no number since others of their arm have come further; nothing where there are none."""
    behind = [f"{arm.label}, seed {seed}" for arm in arms for seed in arm.missing]
    told = "Left out, as others of the same have come further (--until STEP compares what all have made)"
    return f"{told}: {'; '.join(behind)}." if behind else ""
