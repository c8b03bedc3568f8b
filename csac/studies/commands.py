"""The options and the implementation of `csac study` and `csac report`."""

from __future__ import annotations

import dataclasses
import shlex
import signal
import sys
from collections import Counter
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from csac.checks import check_whole
from csac.console.tables import Fitted, duration, make_console, program
from csac.processes import cores_to_use
from csac.record.rendering import Cell, Row, Table, short
from csac.record.wandb import import_wandb
from csac.studies.arms import gather, option, read_arms, seconds_per_step
from csac.studies.study import find, named
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from csac.studies.run import Execution
    from csac.studies.study import Study

HELP = """\
usage: csac study COMMAND ...

The paper's experiments, and your own, as studies: tasks x methods x conditions x seeds, a run for each.

  csac study list           list the studies
  csac study show NAME      show a study's runs and how far they are
  csac study run NAME       run what is not over yet; stop it with Ctrl-C and run it again at any time
  csac study report NAME    report curves, tables and the paper's claims

  csac study COMMAND --help  explain a command and its options

NAME may also be a TOML file of your own (docs/studies.md).
To begin: csac study run smoke
"""


@dataclass(frozen=True)
class List:
    """List the studies."""


@dataclass(frozen=True)
class Show:
    """Show the runs of a study, their progress, and how long such runs take."""

    name: Annotated[Positional[str], arg(metavar="NAME")]
    """One of csac study list, or a TOML file."""
    scale: float = 1.0
    """Shorten every run to this share of its steps."""
    tasks: Annotated[tuple[str, ...], arg(metavar="ID ...", help_behavior_hint="(default: all)")] = ()
    """Only these tasks."""
    algorithms: Annotated[tuple[str, ...], arg(metavar="NAME ...", help_behavior_hint="(default: all)")] = ()
    """Only these algorithms or methods."""
    seeds: Annotated[int | None, arg(help_behavior_hint="(default: as in the study)")] = None
    """Number of seeds; asking for more later reuses the existing runs."""
    directory: Annotated[Path | None, arg(help_behavior_hint="(default: runs/studies/NAME)")] = None
    """Directory of the runs: METHOD/TASK[/CONDITION]/seed-K."""

    def study(self) -> Study:
        """Return the chosen study. Raises InputError for an unknown study, task or method."""
        study = dataclasses.replace(find(self.name), scale=self.scale)
        return study.narrowed(self.tasks, self.algorithms, self.seeds)

    def home(self) -> Path:
        """Return the directory of the runs."""
        scale = f"-scale-{self.scale:g}" * (self.scale != 1)
        return self.directory or Path("runs", "studies", Path(self.name).stem + scale)

    def words(self) -> list[str]:
        """Return the command-line words that make the same choice."""
        names = ("scale", "tasks", "algorithms", "seeds", "directory")
        given = {name: getattr(self, name) for name in names if getattr(self, name) != getattr(Show, name)}
        return [self.name, *(word for name, value in given.items() for word in option(name, value))]


@dataclass(frozen=True)
class Run(Show):
    """Train a study's unfinished runs, from their checkpoints if there are any; finished and failed runs are skipped.

    Exit codes: 0 done, 1 the directory can no longer be written, 2 wrong arguments, 3 a run failed, 130 or 143 stopped
    by a signal (every run is saved).
    """

    engine: Annotated[Literal["local", "processes", "ray"], arg(help_behavior_hint="(default: processes)")] = (
        "processes"
    )
    """local: one run at a time, on all cores. processes: several at once. ray: on a Ray cluster (docs/cluster.md)."""
    workers: Annotated[int | None, arg(help_behavior_hint="(default: one per core, or one on a GPU)")] = None
    """Number of runs that train in parallel, each with its share of the cores."""
    cell: Annotated[int | None, arg(help_behavior_hint="(default: all)")] = None
    """Only the run with this number in csac study show, for example as one job of a job array."""
    address: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="(default: a new one, here)")] = None
    """Address of the Ray cluster; auto is the one that this machine belongs to."""
    cell_cores: int = 1
    """Cores that each run requests from Ray."""
    cell_gpus: float = 0.0
    """GPUs, or a share of one, that each run requests from Ray."""
    cell_memory: float = 0.0
    """GiB of memory that each run requests from Ray; 0 requests none in particular."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Device that the networks are trained on."""
    wandb: FlagCreatePairsOff[bool] = False
    """Also log each run to Weights & Biases, in the project WANDB_PROJECT or else csac."""
    keep_checkpoints: FlagCreatePairsOff[bool] = False
    """Keep the checkpoints of finished runs too; they contain the replay buffer and take most of the space."""

    def study(self) -> Study:
        """Return the chosen study on the chosen device."""
        return dataclasses.replace(super().study(), device=self.device)

    def execution(self) -> Execution:
        """Return the execution options. Raises InputError for options that conflict."""
        from csac.studies.ray import Cluster
        from csac.studies.run import Execution

        workers = cores_to_use() if self.workers is None else self.workers
        check_whole("--workers", workers, 1, 10_000)
        if self.workers is not None and (self.engine != "processes" or self.cell is not None):
            raise InputError("--workers is for --engine processes without --cell")
        cluster = Cluster(self.address, self.cell_cores, self.cell_gpus, self.cell_memory)
        if self.engine != "ray" and cluster != Cluster():
            raise InputError("--address and --cell-cores, -gpus and -memory are for Ray: add --engine ray")
        check_whole("--cell-cores", self.cell_cores, 1, 10_000)
        if not (self.cell_gpus >= 0 and self.cell_memory >= 0):
            raise InputError("--cell-gpus and --cell-memory must be 0 or more")
        if self.wandb:
            import_wandb()
        one_at_a_time = self.engine == "local" or self.cell is not None or (self.device == "gpu" and not self.workers)
        return Execution(
            1 if one_at_a_time else workers,
            cluster if self.engine == "ray" else None,
            self.wandb,
            self.keep_checkpoints,
            shlex.join(["csac", *sys.argv[1:]]),
        )


@dataclass(frozen=True)
class StudyReport(Show):
    """Write a report of a study's runs so far: curves, tables, the paper's claims, commands."""

    out: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: report.html beside the runs)")] = None
    """Where to write the report: an .html file, or an .md file with its pictures beside it."""


@dataclass(frozen=True)
class Report:
    """Compare runs: curves, returns, intervals, what perturbations cost, hyperparameters, commands.

    Runs that differ only in their seeds are one method; methods are named by the settings in which they differ.
    """

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="DIR...", help_behavior_hint="(or --label)")] = ()
    """Runs, sets of runs, or directories that contain some."""
    label: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME=DIR,...")] = ()
    """More runs to compare, as one method of this name."""
    until: Annotated[int | None, arg(help_behavior_hint="(default: the end)")] = None
    """Ignore evaluations after this step."""
    title: Annotated[str | None, arg(help_behavior_hint="(default: the tasks)")] = None
    """Title of the report."""
    out: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: runs/reports/DATE-TIME.html)")] = None
    """Where to write the report: an .html file, or an .md file with its pictures beside it."""


def list_studies(_: List) -> int:
    """Print the studies that come with csac."""
    rows = []
    for name in named():
        study = find(name)
        rows.append((name, str(len(study.runs())), study.title))
    _print_table(("study", "runs", "what it shows"), rows)
    return 0


def show(options: Show) -> int:
    """Print the runs of a study, their progress and the time that such runs take."""
    directory, rows, paces = options.home(), [], {}
    found = [(run, run.open(directory)) for run in options.study().runs()]
    for run, existing in found:
        if existing and (pace := seconds_per_step(existing)):
            paces.setdefault((run.config.task, run.config.algorithm), []).append(pace)
    for index, (run, existing) in enumerate(found):
        steps = existing.manifest.steps_done if existing else 0
        known = paces.get((run.config.task, run.config.algorithm))
        time = f"about {duration(median(known) * run.config.steps)}" if known else ""
        state = existing.state if existing else "waiting"
        rows.append((str(index), run.name, f"{short(steps)} / {short(run.config.steps)}", state, time))
    _print_table(("run", "what", "steps", "state", "such runs take"), rows)
    _print_states(directory, Counter(row[3] for row in rows))
    return 0


def run(options: Run) -> int:
    """Train the unfinished runs and return the exit code."""
    from csac.studies.run import run_study

    console, directory, runs = make_console(), options.home(), options.study().runs()
    if options.cell is not None:
        check_whole("--cell", options.cell, 0, len(runs) - 1)
        runs = [runs[options.cell]]
    stopped = run_study(runs, directory, options.execution(), console)
    states = Counter(existing.state if (existing := one.open(directory)) else "waiting" for one in runs)
    _print_states(directory, states)
    for one in runs:
        if (existing := one.open(directory)) and existing.state == "failed":
            console.print(f"{one.name} failed at {existing.manifest.failure} ({existing.path})", soft_wrap=True)
    if stopped:
        line = shlex.join([program(), *sys.argv[1:]])
        name = signal.Signals(stopped).name
        print(f"csac: stopped by {name}; every run is saved. To go on: {line}", file=sys.stderr)
        return 128 + stopped
    return 3 if states["failed"] else 0


def report_study(options: StudyReport) -> int:
    """Write the report of a study and print its path."""
    from csac.studies.report import report_of, write  # matplotlib is slow to import

    study, directory = options.study(), options.home()
    arms = gather(study, directory)
    if not any(arm.runs for arm in arms):
        raise InputError(f"there is no run of {study.name} in {directory}: csac study run {options.name} makes them")
    out = options.out or directory / "report.html"
    title = study.title + (f", at {study.scale:g} of its steps" if study.scale < 1 else "")
    lines = [shlex.join(["csac", "study", command, *options.words()]) for command in ("run", "report")]
    write(out, title, report_of(arms, lines, study.analyses))
    make_console().print(str(out), soft_wrap=True)
    return 0


def report(options: Report, command: str) -> int:
    """Write a report of any runs and print its path; the report shows `command`, the line that made it."""
    from csac.studies.report import ANALYSES, report_of, write  # matplotlib is slow to import

    if not (options.runs or options.label):
        raise InputError("there is nothing to report on: give run directories ('csac runs' lists them)")
    if options.until is not None:
        check_whole("--until", options.until, 1, 2**31)
    labelled = []
    for text in options.label:
        name, _, paths = text.partition("=")
        if not (name and all(paths.split(","))):
            raise InputError(f"--label is written NAME=DIR,DIR, not {text!r}")
        labelled.append((name, [Path(path) for path in paths.split(",")]))
    arms = read_arms(options.runs, labelled, options.until, lambda error: print(f"damaged: {error}", file=sys.stderr))
    if options.until is not None:
        steps = [run.evaluations["step"].min(initial=2**31) for arm in arms for run in arm.runs]
        if min(steps) > options.until:
            raise InputError(f"no run has an evaluation up to --until {options.until:,}")
    out = options.out or Path("runs", "reports", f"{datetime.now():%Y%m%d-%H%M%S}.html")
    title = options.title or ", ".join(dict.fromkeys(arm.task for arm in arms))
    write(out, title, report_of(arms, [command], ANALYSES))
    make_console().print(str(out), soft_wrap=True)
    return 0


COMMANDS: Mapping[str, tuple[type, Any]] = {
    "list": (List, list_studies),
    "show": (Show, show),
    "run": (Run, run),
    "report": (StudyReport, report_study),
}


def _print_states(directory: Path, states: Mapping[str, int]) -> None:
    summary = ", ".join(f"{count} {state}" for state, count in states.items())
    make_console().print(f"runs in {directory}: {summary}", soft_wrap=True)


def _print_table(headings: tuple[str, ...], rows: Sequence[Sequence[str]]) -> None:
    cells = tuple(Row(tuple(map(Cell, row)), "failed" if "failed" in row else "plain") for row in rows)
    make_console().print(Fitted(Table(headings, cells)))
