"""The console, the format of durations, and the tables that commands print."""

from __future__ import annotations

import io
import shlex
import shutil
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import rich.table
from rich import box
from rich.console import Console
from rich.text import Text

from csac.record import report_tables
from csac.record.rendering import EMPTY, Cell, Row, Table, number, numeric, short
from csac.record.statistics import last_evaluations
from csac.record.summaries import last_rows, over_seeds, perturbation_recoveries
from csac.record.tables import COLUMNS, structured
from csac.tasks.perturbations import by_step, perturbations_of
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from rich.console import ConsoleOptions

    from csac.deploy.latency import Latency
    from csac.evaluation.evaluator import EvaluationEpisode
    from csac.record.sets import RunSet

STATE_STYLES = {"running": "cyan", "finished": "green", "failed": "red", "interrupted": "yellow", "killed": "red"}
PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}
WIDTH_ELSEWHERE = 200  # characters without a terminal: lines stay whole for grep


def make_console() -> Console:
    """Return a console on standard output that prints text verbatim and ignores a closed pipe or terminal."""
    output = sys.stdout or io.StringIO()
    width = None if output.isatty() else WIDTH_ELSEWHERE
    console = Console(markup=False, emoji=False, highlight=False, width=width)
    console.file = _LenientFile(output)  # pyright: ignore[reportAttributeAccessIssue]
    return console


def print_lines(console: Console, lines: Iterable[str | Text]) -> None:
    """Print lines without wrapping them: a wrapped path or command could not be copied."""
    for line in lines:
        console.print(line, soft_wrap=True)


def program() -> str:
    """Return what to type to run csac: its name, or the path that it was started by if it is not on the PATH."""
    started = sys.argv[0]
    is_ours = Path(started).name == "csac" and shutil.which("csac") is None
    return shlex.quote(started) if is_ours else "csac"


def duration(seconds: float) -> str:
    """Format a duration with its two largest units: 45 s, 3 min 20 s, 1 h 42 min, 2 d 3 h."""
    whole = round(seconds)
    for size, unit, smaller_size, smaller in ((86400, "d", 3600, "h"), (3600, "h", 60, "min"), (60, "min", 1, "s")):
        if whole >= size:
            count, rest = divmod(whole, size)
            return f"{count} {unit}" + (f" {rest // smaller_size} {smaller}" if rest // smaller_size else "")
    return f"{whole} s"


@dataclass
class Fitted:
    """A table on a terminal; if that is too narrow, cells are folded so that no digit is lost."""

    table: Table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[rich.table.Table]:
        table = self.table
        shown = rich.table.Table(box=box.SIMPLE, pad_edge=False, title=table.title or None, caption=table.note or None)
        shown.title_justify = shown.caption_justify = "left"
        shown.title_style, shown.caption_style = "bold", "dim"
        for column, heading in enumerate(table.headings):
            shown.add_column(Text(heading), justify="right" if table.is_numeric(column) else "left", overflow="fold")
        previous = "plain"
        for row in table.rows:
            if row.kind == "summary" != previous:
                shown.add_section()
            previous = row.kind
            shown.add_row(*(Text(cell.text) for cell in row.cells), style="red" if row.kind == "failed" else None)
        yield shown


def result_tables(runs: RunSet) -> list[Fitted]:
    """Return tables of the results by seed, the cases in the last evaluations, and what perturbations cost."""
    rows, failed = runs.evaluations, runs.failures.keys()
    trained, episodes = np.unique(runs.rows("episodes")["seed"], return_counts=True)
    counts = dict(zip(trained.tolist(), episodes.tolist(), strict=True))
    cases = report_tables.case_table(last_rows(rows[~np.isin(rows["seed"], list(failed))]))
    tables = [report_tables.results_table(rows, failed, counts), *([cases] if cases else [])]
    perturbed = by_step(perturbations_of(runs.config.perturbations))
    tables += [report_tables.recovery_table([cost]) for cost in perturbation_recoveries(rows, perturbed, failed)]
    return [Fitted(table) for table in tables]


def evaluation_tables(
    results: Mapping[int, Sequence[EvaluationEpisode]], failed: Collection[int] = frozenset()
) -> list[Fitted]:
    """Return tables of the returns by seed, and of the cases over the seeds that did not fail in training."""
    rows = _rows(results)
    cases = report_tables.case_table(rows[~np.isin(rows["seed"], list(failed))])
    return [Fitted(table) for table in (_evaluation_table(rows, failed), cases) if table]


def _evaluation_table(rows: np.ndarray, failed: Collection[int]) -> Table:
    """Return a table with a row per seed, and the mean with its interval over seeds that did not fail in training."""
    largest, has_success = float(np.abs(rows["return"]).max(initial=0.0)), not np.isnan(rows["success"]).all()
    body, sound = [], []
    for seed in np.unique(rows["seed"]).tolist():
        own = rows[rows["seed"] == seed]
        over, length = over_seeds(own["return"]), float(own["length"].mean())
        numbers = (over.mean, over.std, own["return"].min(), own["return"].max())
        cells = [numeric(float(value), number(value, largest)) for value in numbers] + [Cell(f"{length:,.1f}", length)]
        if has_success:
            share = float(np.nan_to_num(own["success"]).mean())
            cells.append(Cell(f"{share:.0%}", share))
        body.append(Row((Cell(str(seed), seed), *cells), "failed" if seed in failed else "plain"))
        sound += [] if seed in failed else [over.mean]
    if len(sound) > 1:
        over, blank = over_seeds(sound), [EMPTY] * (4 + has_success)
        body.append(Row((Cell("mean", np.nan), numeric(over.mean, number(over.mean, largest)), *blank), "summary"))
        body += report_tables.interval_rows([over], largest, len(blank))
    headings = ("seed", "mean return", "± std", "min", "max", "length", *["success"] * has_success)
    return Table(headings, tuple(body), note=report_tables.few_seeds(len(sound)))


def run_lines(sets: Sequence[RunSet]) -> list[Text]:
    """Return a line for each set of runs: task, algorithm, seeds, steps, state, last return, directory.

    The last return is a mean over the seeds that have not failed.
    """
    table = [("task", "algorithm", "seeds", "steps", "state", "last return", "directory")] if sets else []
    for runs in sets:
        config, steps = runs.config, f"{short(runs.steps_done)} / {short(runs.config.steps)}"
        seeds = str(len(runs.seeds))
        table.append((config.task, config.algorithm, seeds, steps, runs.state, _last_return(runs), str(runs.path)))
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = []
    for row in table:
        *first, state, last, path = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        coloured = (state, STATE_STYLES.get(state.strip(), ""))
        lines.append(Text.assemble("  ".join([*first, ""]), coloured, f"  {last}  {path.rstrip()}"))
    return lines


def export_lines(verification: Mapping[str, Any]) -> list[str]:
    """Return lines that compare an artefact with the policy that it was exported from."""
    count, largest = verification["observations"], verification["largest_difference"]
    lines = [f"{count:,} observations: actions differ by at most {largest:.1e} of their range"]
    if returns := verification.get("returns"):
        through, without = (_mean(some) for some in (returns, verification["returns_of_the_run"]))
        lines.append(f"{returns['count']} episodes: mean return {through}; the run's policy {without}")
    return lines


def latency_table(measured: Mapping[str, Sequence[Latency]]) -> Fitted:
    """Return a table of the microseconds per call, a row for each artefact and call rate."""
    headings = ("μs for one action", "calls", *PERCENTILES, "late: p99", "late: max")
    rows = []
    for name, several in measured.items():
        for latency in several:
            way = "flat out" if latency.rate is None else f"at {latency.rate:g} Hz"
            late = [EMPTY] * 2 if latency.lateness is None else _microseconds(latency.lateness, [99.0, 100.0])
            cells = [*_microseconds(latency.durations, [*PERCENTILES.values()]), *late]
            count = len(latency.durations)
            rows.append(Row((Cell(f"{name}, {way}"), Cell(f"{count:,}", count), *cells)))
    return Fitted(Table(headings, tuple(rows), note="late: how long after its time a call began"))


def _last_return(runs: RunSet) -> str:
    try:
        returns = last_evaluations(runs.sound_evaluations, points=1)
    except InputError:
        return "damaged"
    return number(float(np.mean(list(returns.values())))) if returns else ""


def _rows(results: Mapping[int, Sequence[EvaluationEpisode]]) -> np.ndarray:
    """Return episodes as rows of evaluations.csv."""
    rows = [episode.row(seed, 0) for seed, episodes in results.items() for episode in episodes]
    names = list(rows[0]) if rows else list(COLUMNS["evaluations"])
    found = np.empty(len(rows), structured(names, []).dtype)
    for name in names:
        found[name] = [np.nan if row[name] is None else row[name] for row in rows]
    return found


def _mean(returns: Mapping[str, Any]) -> str:
    mean = returns["mean_return"]
    return f"{number(mean)} ± {number(returns['standard_deviation'] or 0.0, mean)}"


def _microseconds(nanoseconds: np.ndarray, percentiles: list[float]) -> list[Cell]:
    values = np.percentile(nanoseconds, percentiles, method="higher") / 1e3
    return [Cell(f"{value:.1f}" if value < 1000 else f"{value:,.0f}", float(value)) for value in values]


class _LenientFile:
    """A text file that ignores write errors, so that a run continues after its terminal or pipe is closed."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file

    def write(self, text: str) -> int:
        try:
            return self._file.write(text)
        except (OSError, ValueError):  # ValueError: it is closed
            return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            self._file.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
