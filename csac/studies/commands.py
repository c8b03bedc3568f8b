"""`csac study ...`: what each sub-command does."""

from __future__ import annotations

import shlex
import signal
import sys
from collections import Counter
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.table import Table
from rich.text import Text

from csac.console.tables import duration, make_console, program, short
from csac.processes import usable_cores
from csac.record.wandb import import_wandb
from csac.studies.calibration import Calibration, Prediction, predict
from csac.studies.cells import HOME, Cell, Store
from csac.studies.engines import run_here, run_in_processes
from csac.studies.job import Ended, Job, Message, Stopped, is_over, is_tested
from csac.studies.named import NAMED
from csac.studies.options import List, Report, Run, Show
from csac.studies.progress import StudyProgress
from csac.studies.refusals import refuse_as_results, refuse_device, refuse_file, refuse_tasks, refuse_unwritable
from csac.studies.results import Results, Runs, collect
from csac.studies.study import Study, cells_of
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from rich.console import Console

    from csac.studies.cells import Status
    from csac.studies.engines import Engine

HELP = """\
usage: csac study COMMAND ...

The paper's experiments, and your own, as studies: tasks x methods x seeds, one run for each, shared among studies.

  csac study list           list the studies
  csac study show NAME      show a study's cells, their progress, and how long the rest will take
  csac study run NAME       run what is not complete yet; stop it with Ctrl-C and run it again at any time
  csac study report NAME    report claims, tables and figures of what is complete

  csac study COMMAND --help  explain a command and its options

NAME may also be a TOML file of your own (docs/studies.md).
To begin: csac study run smoke
"""
MOST_NAMED = 5  # methods in a line
STATE_STYLES = {"complete": "green", "running": "cyan", "partial": "yellow", "waiting": "dim", "failed": "red"}


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
    for directory in filter(None, (options.directory, options.results)):
        refuse_file(directory)
    studies, store, console = options.studies(), Store(options.directory), make_console()
    cells, labels = cells_of(studies), labels_of(studies)
    collected = _collected(studies, cells, _results(options.results))
    statuses = {cell.key: store.status(cell) for cell in cells} | collected
    rollouts = _rollouts(studies)
    jobs = [Job(cell, store.path(cell), rollouts=rollouts[cell.key]) for cell in cells if cell.key not in collected]
    rest = [job for job in jobs if not is_over(job)]
    predictions = _predictions(rest, store, not options.no_measure, console)
    table = _table("cell", "what", "steps", "state", "time", "directory")
    table.columns[5].overflow = "fold"
    for index, cell in enumerate(cells):
        status = statuses[cell.key]
        text = Text(status.state + (f": {status.reason}" if status.reason else ""), STATE_STYLES[status.state])
        prediction = predictions.get(cell.key)
        table.add_row(
            str(index),
            labels[cell.key],
            f"{short(status.steps)} / {short(cell.steps)}",
            text,
            f"about {duration(prediction.seconds)}"
            if prediction
            else duration(status.seconds)
            if status.seconds
            else "",
            str(store.path(cell).relative_to(store.root)),
        )
    console.print(table)
    _tell_of_warmup(studies, cells, console)
    for directory in filter(None, (options.directory, options.results)):
        if directory != HOME and not directory.exists():  # the other is made by the first run
            _say(console, f"note: {directory} does not exist, so nothing in it is counted")
    console.print(f"{_cells(len(cells))} below {store.root}: {_counted(statuses.values())}", soft_wrap=True)
    if rest:
        console.print(_told(rest, predictions), soft_wrap=True)
    return 0


def _predictions(jobs: Sequence[Job], store: Store, measure: bool, console: Console) -> dict[str, Prediction]:
    """Return what each cell will take, of those whose kind was measured or can be."""
    calibration, predictions, refused = Calibration(), {}, set()
    if measure and any(calibration.cost(job.cell) is None for job in jobs):
        _say(
            console, "measuring each kind of cell once: some seconds, longer on a busy machine (--no-measure skips it)"
        )
    for job in jobs:
        cell = job.cell
        cost, kind = calibration.cost(cell), f"{cell.algorithm} on {cell.task}"
        if cost is None and measure and kind not in refused:
            try:
                with console.status(f"measuring {kind}") if console.is_interactive else nullcontext():
                    cost = calibration.measure(cell)
            except RuntimeError as error:
                refused.add(kind)
                _say(console, f"{kind} cannot be measured: {error}", "red")
        if cost:
            rollouts = 0 if is_tested(job) else job.rollouts
            predictions[cell.key] = predict(cell, cost, store.first_step(cell), rollouts)
    if calibration.is_busy:
        _say(console, "other processes keep this machine busy: what was measured now is too slow, and not remembered")
    return predictions


def _told(rest: Sequence[Job], predictions: Mapping[str, Prediction]) -> str:
    """Return what the cells that are not over will take together; several at once, as long as the longest of them."""
    if len(predictions) < len(rest):
        return f"{len(rest)} to run, {len(rest) - len(predictions)} of them not measured"
    workers = min(len(usable_cores()), len(rest))
    each = [one.seconds for one in predictions.values()]
    memory = sum(sorted((one.memory for one in predictions.values()), reverse=True)[:workers])
    disk = sum(sorted((one.disk for one in predictions.values()), reverse=True)[:workers])
    together = duration(max(sum(each) / workers, *each))
    at_once = f", about {together} with {workers} at once" if workers > 1 else ""
    return (
        f"{len(rest)} to run: about {duration(sum(each))} of one core{at_once}; "
        f"{memory / 2**30:.2g} GiB of memory, {disk / 2**30:.2g} GiB of disk for checkpoints"
    )


def run(options: Run) -> int:
    """Run what is not complete and return the exit code."""
    studies, store, console = options.studies(), Store(options.directory), make_console()
    cells, labels = cells_of(studies), labels_of(studies)
    engine = _engine(options)
    if options.wandb:
        import_wandb()
    if options.cell is not None:
        if not 0 <= options.cell < len(cells):
            raise InputError(f"--cell counts from 0 to {len(cells) - 1}, not {options.cell}")
        cells = [cells[options.cell]]
    every = _jobs(studies, cells, store, options)
    refuse_file(options.directory)
    results = _results(options.results)
    collected = _collected(studies, cells, results)
    jobs = [job for job in every if job.cell.key not in collected and not is_over(job)]
    if jobs and options.engine != "ray":  # whose nodes may have what this machine has not
        refuse_tasks(jobs)
        refuse_device(options.device, beside=engine is not run_here)
    if options.results:
        refuse_as_results(options.results, store)
    if jobs:
        refuse_unwritable(options.directory)
    if results:
        _collect_over(every, store, results, labels)
    statuses = {cell.key: store.status(cell) for cell in cells} | collected
    _say(console, _intention(studies, cells, statuses.values()), "bold")
    _tell_of_warmup(studies, [job.cell for job in jobs], console)
    by_key = {cell.key: cell for cell in cells}
    done = {job.cell.key: store.first_step(job.cell) for job in jobs}
    progress = StudyProgress([job.cell for job in jobs], labels, done, console)

    not_collected: dict[str, str] = {}

    def tell(message: Message) -> None:
        progress.tell(message)
        if results and isinstance(message, Ended):
            try:
                collect(store, by_key[message.key], results)
            except (OSError, InputError) as error:  # which ends no other cell
                not_collected[message.key] = getattr(error, "strerror", None) or str(error)

    try:
        if jobs:
            engine(jobs, tell)
    except Stopped as stopped:
        progress.close()
        name = signal.Signals(stopped.signal_number).name
        line = f"csac: stopped by {name}; every cell is saved. To go on, type the same line again: {command_line()}"
        print(line, file=sys.stderr)
        return 128 + stopped.signal_number
    finally:
        progress.close()
        for key, reason in not_collected.items():
            _say(console, f"not copied to {options.results}: {labels[key]}: {reason}; the same line copies it", "red")
    statuses = {cell.key: store.status(cell) for cell in cells} | collected
    told = set(progress.outcomes) if len(jobs) == 1 else set[str]()  # of several, the lines are far apart
    code = _conclude(_with_failures(statuses, progress.outcomes), labels, told, console)
    left = options.cell is not None and any(one.outcome == "elsewhere" for one in progress.outcomes.values())
    return 3 if not_collected or left else code


def _collect_over(jobs: Iterable[Job], store: Store, results: Results, labels: Mapping[str, str]) -> None:
    """Collect the cells that are over and were not collected with all that is wanted of them.

    What another machine may have run stays as it is. Raises InputError for what cannot be copied.
    """
    for job in jobs:
        is_there = results.has(job.cell) and results.status(job.cell, job.rollouts) is not None
        if not is_there and is_over(job):
            try:
                collect(store, job.cell, results)
            except OSError as error:
                label, why = labels[job.cell.key], error.strerror
                raise InputError(f"cannot copy {label} to {results.directory}: {why}") from None


def report(options: Report) -> int:
    """Write the report and print where it is."""
    from csac.studies.report import write_report  # matplotlib is slow to import

    refuse_file(options.directory)
    studies, store, console = options.studies(), Store(options.directory), make_console()
    source = Results(options.results) if options.results else Runs(store)
    scale = f"-scale-{studies[0].scale:g}" if options.scale < 1 else ""
    folder = options.out or options.results or Path("runs/studies/reports", f"{Path(options.name).stem}{scale}")
    chosen = options.words()
    results = [] if options.results is None else ["--results", str(options.results)]
    place = [] if options.out is None else ["--out", str(options.out)]
    run, report = (["csac", "study", command, *chosen, *results] for command in ("run", "report"))
    is_empty = not any(source.record(cell) for cell in cells_of(studies))
    if is_empty:
        _keep_report(folder, options.results or options.directory)
    path = write_report(studies, source, folder, [shlex.join(run), shlex.join([*report, *place])])
    _say(console, f"{path}\n{path.with_suffix('.md')}")
    if is_empty:
        _say(console, f"note: no cell is over yet in {options.results or options.directory}, so there is little in it")
    return 0


def _keep_report(folder: Path, source: Path) -> None:
    """Raise InputError where a report of nothing would replace another."""
    for path in (folder / "report.html", folder / "report.md"):
        if path.exists():
            raise InputError(
                f"no cell is over yet in {source}, and a report of that would replace {path}: "
                "give another --directory, --results or --out"
            )


COMMANDS: Mapping[str, tuple[type, Any]] = {
    "list": (List, list_studies),
    "show": (Show, show),
    "run": (Run, run),
    "report": (Report, report),
}


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
    if options.engine == "ray":
        from csac.studies.cluster import Request, run_on_ray  # an optional dependency

        if options.workers:
            raise InputError("--engine ray runs as many cells as the cluster has room for: leave out --workers")
        if options.cell_cores < 1 or options.cell_gpus < 0 or options.cell_memory < 0:
            raise InputError("--cell-cores is at least 1, --cell-gpus and --cell-memory are not below 0")
        request = Request(options.cell_cores, options.cell_gpus, options.cell_memory)
        return partial(run_on_ray, address=options.address, request=request)
    for name in ("address", "cell_cores", "cell_gpus", "cell_memory"):
        if getattr(options, name) != getattr(Run, name):
            raise InputError(f"--{name.replace('_', '-')} is for Ray: add --engine ray")
    several = len(usable_cores()) > 1 and options.cell is None and options.device == "cpu"
    engine = options.engine or ("processes" if several or options.workers else "local")
    if engine == "local" and options.workers:
        raise InputError("--engine local runs one cell after another: leave out --workers")
    return run_here if engine == "local" else partial(run_in_processes, workers=options.workers)


def _results(directory: Path | None) -> Results | None:
    return None if directory is None else Results(directory, may_be_empty=True)


def _collected(studies: Sequence[Study], cells: Sequence[Cell], results: Results | None) -> dict[str, Status]:
    """Return how the cells ended that were collected there with all that these studies want of them."""
    if results is None:
        return {}
    rollouts = _rollouts(studies)
    statuses = {cell.key: results.status(cell, rollouts[cell.key]) for cell in cells}
    return {key: status for key, status in statuses.items() if status is not None}


def _rollouts(studies: Sequence[Study]) -> Counter[str]:
    """Return how many episodes each policy is tested on: as many as the most demanding of the studies asks for."""
    rollouts = Counter[str]()
    for study in studies:
        for entry in study.entries():
            rollouts[entry.cell.key] = max(rollouts[entry.cell.key], study.rollouts_each)
    return rollouts


def _jobs(studies: Sequence[Study], cells: Sequence[Cell], store: Store, options: Run) -> list[Job]:
    rollouts = _rollouts(studies)
    return [
        Job(
            cell,
            store.path(cell),
            device=options.device,
            keep_checkpoints=options.keep_checkpoints,
            wandb=options.wandb,
            rollouts=rollouts[cell.key],
            command=shlex.join(["csac", *sys.argv[1:]]),
        )
        for cell in cells
    ]


def _intention(studies: Sequence[Study], cells: Sequence[Cell], statuses: Iterable[Status]) -> str:
    scale = f", at {studies[0].scale:g} of the steps" if studies[0].scale < 1 else ""
    return f"{', '.join(study.name for study in studies)}{scale}: {_cells(len(cells))}, {_counted(statuses)}"


def _with_failures(statuses: Mapping[str, Status], outcomes: Mapping[str, Ended]) -> dict[str, Status]:
    """Return how the cells are, those that have just failed as failed: a full disk may not hold that they did."""
    failed = {key: ended.reason for key, ended in outcomes.items() if ended.outcome == "failed"}
    return {**statuses, **{key: statuses[key]._replace(state="failed", reason=failed[key]) for key in failed}}


def _conclude(
    statuses: Mapping[str, Status], labels: Mapping[str, str], told: Collection[str], console: Console
) -> int:
    """Print what became of the cells, but for failures that were `told` already, and return the exit code."""
    failed = {key: status.reason for key, status in statuses.items() if status.state == "failed"}
    for key in (key for key in failed if key not in told):
        _say(console, f"failed: {labels[key]}: {failed[key]}", "red")
    _say(console, f"{_cells(len(statuses))}: {_counted(statuses.values())}")
    return 3 if failed else 0


def _cells(count: int) -> str:
    return f"{count:,} cell{'s' * (count != 1)}"


def _tell_of_warmup(studies: Iterable[Study], cells: Iterable[Cell], console: Console) -> None:
    """Say which methods will learn nothing in these cells, since they end before the first update."""
    keys, idle = {cell.key for cell in cells}, dict[str, None]()
    for study in studies:
        for method, _, cell in study.entries():
            if cell.key in keys and cell.steps < cell.make_algorithm().cadence.first_update:
                idle[f"{method.label} on {cell.task}"] = None
    if idle:
        more = f" and {len(idle) - MOST_NAMED} more" if len(idle) > MOST_NAMED else ""
        named = "; ".join(list(idle)[:MOST_NAMED])
        _say(console, f"note: nothing will be learnt by {named}{more}: all steps come before the first update")


def _counted(statuses: Iterable[Status]) -> str:
    states = Counter(status.state for status in statuses)
    return ", ".join(f"{states[state]} {state}" for state in STATE_STYLES if states[state])


def _say(console: Console, text: str, style: str = "") -> None:
    console.print(Text(text, style), soft_wrap=True)


def _table(*headings: str) -> Table:
    table = Table(box=box.SIMPLE, pad_edge=False)
    for heading in headings:
        table.add_column(heading)
    return table
