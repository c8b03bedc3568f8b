"""`csac study ...`: the options of each sub-command and what it does."""

from __future__ import annotations

import shlex
import signal
import sys
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich import box
from rich.table import Table
from rich.text import Text
from tyro.conf import FlagCreatePairsOff, Positional, arg

from csac.console.tables import make_console, program, short
from csac.processes import usable_cores
from csac.studies.cells import HOME, Cell, Store
from csac.studies.engines import run_here, run_in_processes
from csac.studies.job import Job, Stopped
from csac.studies.named import NAMED, find
from csac.studies.progress import StudyProgress
from csac.studies.study import Study, cells_of
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from csac.studies.cells import Status
    from csac.studies.engines import Engine

HELP = """\
usage: csac study COMMAND ...

The paper's experiments, and your own, as studies: tasks x methods x seeds, one run for each, shared among studies.

  csac study list           the studies that there are
  csac study show NAME      the cells of one, how far they are, and what the rest will take
  csac study run NAME       run what is not complete yet; Ctrl-C at any time, and run it again

  csac study COMMAND --help  explain a command and its options

NAME may also be a TOML file of your own (docs/studies.md).
To begin: csac study run smoke
"""
STATE_STYLES = {"running": "cyan", "complete": "green", "failed": "red", "partial": "yellow", "waiting": "dim"}


@dataclass(frozen=True)
class Chosen:
    """Which study, and what of it."""

    name: Annotated[Positional[str], arg(metavar="NAME")]
    """One of csac study list, or a TOML file."""
    scale: float = 1.0
    """Shorten every run to this share of its steps; all that comes of it says so."""
    tasks: Annotated[str | None, arg(metavar="ID,...", help_behavior_hint="(default: all)")] = None
    """Only these tasks."""
    algorithms: Annotated[str | None, arg(metavar="NAME,...", help_behavior_hint="(default: all)")] = None
    """Only these algorithms or methods."""
    seeds: Annotated[int | None, arg(help_behavior_hint="(default: as the study has)")] = None
    """How many seeds; more later reuse what is there."""
    directory: Path = HOME
    """Where the runs of all cells are."""

    def studies(self) -> list[Study]:
        """Return the studies that are meant."""
        tasks, algorithms = (None if text is None else text.split(",") for text in (self.tasks, self.algorithms))
        return narrowed([study.shortened(self.scale) for study in find(self.name)], tasks, algorithms, self.seeds)


@dataclass(frozen=True)
class List:
    """List the studies."""


@dataclass(frozen=True)
class Show(Chosen):
    """Show the cells of a study and how far they are."""


@dataclass(frozen=True)
class Run(Chosen):
    """Run every cell of a study that is not complete: partial ones go on, failed ones are listed and stop no other.

    Exit codes: 0 done, 2 wrong arguments, 3 a cell failed, 130 or 143 stopped by a signal (every cell is saved).
    """

    engine: Annotated[
        Literal["local", "processes"] | None, arg(help_behavior_hint="(default: processes, where there are cores)")
    ] = None
    """local: one cell after another, in this process. processes: as many at once as there are workers."""
    workers: Annotated[int | None, arg(help_behavior_hint="(default: one for each core)")] = None
    """Processes that run a cell each, on their own share of the cores."""
    cell: Annotated[int | None, arg(help_behavior_hint="(default: all)")] = None
    """Run the cell of this number alone, as csac study show counts them: one job of an array."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Where the networks learn."""
    keep_checkpoints: FlagCreatePairsOff[bool] = False
    """Keep the checkpoints of finished cells too: they hold the replay, and take most of the room."""


def narrowed(
    studies: Sequence[Study], tasks: Sequence[str] | None, algorithms: Sequence[str] | None, seeds: int | None
) -> list[Study]:
    """Narrow each of the studies; those of several that have none of the tasks or algorithms are left out.

    Raises:
        InputError: none of them has one that is asked for.
    """
    chosen, complaint = [], None
    for study in studies:
        try:
            chosen.append(study.narrowed(tasks, algorithms, seeds))
        except InputError as error:
            complaint = complaint or error
    if complaint and not chosen:
        raise complaint
    return chosen


def list_studies(_: List) -> int:
    """Print the named studies."""
    table = _table("study", "what it shows", "tasks", "methods", "seeds", "steps", "cells")
    for name, studies in NAMED.items():
        title = studies[0].title if len(studies) == 1 else "All of them, tiny: that everything works"
        steps = {study.steps_for(task) for study in studies for task in study.tasks}
        table.add_row(
            name,
            title,
            str(len({task for study in studies for task in study.tasks})),
            str(len({method.label for study in studies for method in study.methods})),
            str(studies[0].seeds),
            " to ".join(dict.fromkeys(short(count) for count in (min(steps), max(steps)))),
            str(len(cells_of(studies))),
        )
    make_console().print(table)
    return 0


def show(options: Show) -> int:
    """Print the cells of a study, one row for each."""
    studies, store, console = options.studies(), Store(options.directory), make_console()
    cells, labels = cells_of(studies), labels_of(studies)
    table = _table("cell", "what", "steps", "state", "directory")
    table.columns[4].overflow = "fold"
    states = Counter[str]()
    for index, cell in enumerate(cells):
        status = store.status(cell)
        states[status.state] += 1
        text = Text(status.state + (f": {status.reason}" if status.reason else ""), STATE_STYLES[status.state])
        done = f"{short(status.steps)} / {short(cell.steps)}"
        table.add_row(str(index), labels[cell.key], done, text, str(store.path(cell).relative_to(store.root)))
    console.print(table)
    console.print(f"{len(cells)} cells below {store.root}: {_counted(states)}", soft_wrap=True)
    return 0


def run(options: Run) -> int:
    """Run what is not complete and return the exit code."""
    studies, store = options.studies(), Store(options.directory)
    cells, labels = cells_of(studies), labels_of(studies)
    engine = _engine(options)
    if options.cell is not None:
        if not 0 <= options.cell < len(cells):
            raise InputError(f"--cell counts from 0 to {len(cells) - 1}, not {options.cell}")
        cells = [cells[options.cell]]
    statuses = {cell.key: store.status(cell) for cell in cells}
    jobs = [
        Job(cell, store.path(cell), options.device, keep_checkpoints=options.keep_checkpoints, command=command_line())
        for cell in cells
        if not store.is_final(cell)
    ]
    console = make_console()
    console.print(Text(_intention(studies, cells, statuses), "bold"), soft_wrap=True)
    progress = StudyProgress(
        [job.cell for job in jobs], labels, {key: status.steps for key, status in statuses.items()}, console
    )
    try:
        if jobs:
            engine(jobs, progress.tell)
    except Stopped as stopped:
        progress.close()
        print(
            f"csac: stopped by {signal.Signals(stopped.signal_number).name}; to go on, type the same line again: "
            f"{command_line()}",
            file=sys.stderr,
        )
        return 128 + stopped.signal_number
    finally:
        progress.close()
    return _conclude(cells, labels, store, console)


COMMANDS: Mapping[str, tuple[type, Any]] = {"list": (List, list_studies), "show": (Show, show), "run": (Run, run)}


def labels_of(studies: Iterable[Study]) -> dict[str, str]:
    """Return what each cell is called, by its key."""
    labels = {}
    for study in studies:
        for method, condition, cell in study.entries():
            words = [f"{method.label} on {cell.task}", *condition, f"seed {cell.seed}"]
            labels.setdefault(cell.key, ", ".join(words))
    return labels


def command_line() -> str:
    """Return the line that started this process."""
    return shlex.join([program(), *sys.argv[1:]])


def _engine(options: Run) -> Engine:
    if options.workers is not None and options.workers < 1:
        raise InputError(f"--workers must be at least 1, not {options.workers}")
    several = len(usable_cores()) > 1 and options.cell is None and options.device == "cpu"
    engine = options.engine or ("processes" if several or options.workers else "local")
    if engine == "local" and options.workers:
        raise InputError("--engine local runs one cell after another: leave out --workers")
    return run_here if engine == "local" else partial(run_in_processes, workers=options.workers)


def _intention(studies: Sequence[Study], cells: Sequence[Cell], statuses: Mapping[str, Status]) -> str:
    states = Counter(status.state for status in statuses.values())
    scale = f", at {studies[0].scale:g} of the steps" if studies[0].scale < 1 else ""
    names = ", ".join(study.name for study in studies)
    return f"{names}{scale}: {len(cells)} cells, {_counted(states)}"


def _conclude(cells: Sequence[Cell], labels: Mapping[str, str], store: Store, console: Any) -> int:
    """Print what became of the cells, and return the exit code."""
    statuses = {cell.key: store.status(cell) for cell in cells}
    for key, status in statuses.items():
        if status.state == "failed":
            console.print(Text(f"failed: {labels[key]}: {status.reason}", "red"), soft_wrap=True)
    console.print(f"{len(cells)} cells: {_counted(Counter(status.state for status in statuses.values()))}")
    return 3 if any(status.state == "failed" for status in statuses.values()) else 0


def _counted(states: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {state}" for state, count in states.items())


def _table(*headings: str) -> Table:
    table = Table(box=box.SIMPLE, pad_edge=False)
    for heading in headings:
        table.add_column(heading)
    return table
