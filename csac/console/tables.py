"""Text for people: the console, numbers and lengths of time, and the tables that commands print."""

from __future__ import annotations

import io
import shlex
import shutil
import sys
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import rich.table
from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.text import Text

from csac.record import summary_tables
from csac.record.rendering import EMPTY, Cell, Row, Table, number, numeric, short
from csac.record.statistics import last_evaluations
from csac.record.summaries import case_names, last_rows, over_seeds, perturbation_recoveries
from csac.tasks.perturbations import by_step, perturbations_of
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from rich.console import ConsoleOptions

    from csac.evaluation.evaluator import EvaluationEpisode
    from csac.record.sets import RunSet

STATE_STYLES = {"running": "cyan", "finished": "green", "failed": "red", "interrupted": "yellow", "killed": "red"}
WIDTH_ELSEWHERE = 200  # characters where there is no terminal: lines stay whole for grep
PADDINGS = ((0, 1, 0, 1), (0, 1, 0, 0), (0, 0, 0, 0))  # of cells: above, right, below, left; the loosest that fits
WIDEST = 10_000  # characters: as wide as a table would like to be


def make_console() -> Console:
    """Return a console on standard output that takes text as it is, and that goes quiet when nobody reads any more."""
    output = sys.stdout
    if output is None or output.closed:
        output = io.StringIO()
    width = None if output.isatty() else WIDTH_ELSEWHERE
    console = Console(markup=False, emoji=False, highlight=False, width=width)
    console.file = _LenientFile(output)  # pyright: ignore[reportAttributeAccessIssue]
    return console


def program() -> str:
    """Return what to type for csac: its name, or the path it was started by where a shell would not find the name."""
    started = sys.argv[0]
    is_ours = Path(started).name == "csac" and shutil.which("csac") is None
    return shlex.quote(started) if is_ours else "csac"


def duration(seconds: float) -> str:
    """Return a length of time with the two units that matter: 45 s, 3 min 20 s, 1 h 42 min, 2 d 3 h."""
    whole = round(seconds)
    for size, unit, smaller_size, smaller in ((86400, "d", 3600, "h"), (3600, "h", 60, "min"), (60, "min", 1, "s")):
        if whole >= size:
            count, rest = divmod(whole, size)
            return f"{count} {unit}" + (f" {rest // smaller_size} {smaller}" if rest // smaller_size else "")
    return f"{whole} s"


class Fitted:
    """A table on a terminal, its numbers whole at any width.

    Where the columns do not fit side by side, they move closer; then some follow below, with the first column again.
    """

    def __init__(self, table: Table) -> None:
        self.table = table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[rich.table.Table]:
        def fits(part: rich.table.Table) -> bool:
            return Measurement.get(console, options.update(max_width=WIDEST), part).maximum <= options.max_width

        columns = range(1, len(self.table.headings))
        for padding in PADDINGS:
            if fits(whole := self._part(columns, padding)):
                yield whole
                return
        while columns:
            count = len(columns)
            while count > 1 and not fits(self._part(columns[:count], PADDINGS[-1])):
                count -= 1
            yield self._part(columns[:count], PADDINGS[-1])
            columns = columns[count:]

    def _part(self, columns: range, padding: tuple[int, int, int, int]) -> rich.table.Table:
        part = rich.table.Table(box=box.SIMPLE, pad_edge=False, padding=padding)
        if columns.start == 1:
            part.title, part.title_justify, part.title_style = self.table.title or None, "left", "bold"
        if columns.stop == len(self.table.headings):
            part.caption, part.caption_justify, part.caption_style = self.table.note or None, "left", "dim"
        for column in (0, *columns):
            justify = "right" if self.table.is_numeric(column) else "left"
            part.add_column(Text(self.table.headings[column]), justify=justify, overflow="fold")
        in_summary = False
        for row in self.table.rows:
            texts = [Text(row.cells[column].text) for column in (0, *columns)]
            if row.kind == "summary" and not any(texts[1:]):
                continue
            if row.kind == "summary" and not in_summary:
                part.add_section()
            in_summary = row.kind == "summary"
            part.add_row(*texts, style="red" if row.kind == "failed" else None)
        return part


def results_table(run: RunSet) -> Fitted:
    """Return the results of a run, one row per seed, and below them what the seeds that did not fail have in common."""
    trained, episodes = np.unique(run.rows("episodes")["seed"], return_counts=True)
    counts = dict(zip(trained.tolist(), episodes.tolist(), strict=True))
    return Fitted(summary_tables.results_table(run.evaluations, _failed(run), counts))


def recovery_tables(run: RunSet) -> list[Fitted]:
    """Return a table for each step at which the task was perturbed: what it cost each seed, and how it came back.

    Each looks as far as the next perturbation. There is none where no evaluation lies before the step or none after it.
    """
    perturbed = by_step(perturbations_of(run.config.perturbations))
    costs = perturbation_recoveries(run.evaluations, perturbed, _failed(run))
    return [Fitted(summary_tables.recovery_table([cost])) for cost in costs]


def events_table(rows: np.ndarray) -> Fitted | None:
    """Return what the last evaluations say beside returns: success and each event. None where the task says nothing."""
    table = summary_tables.events_table(last_rows(rows), case_names([rows]))
    return table and Fitted(table)


def evaluation_table(
    results: Mapping[int, Sequence[EvaluationEpisode]], failed: Collection[int] = frozenset()
) -> Fitted:
    """Return one row per seed: mean, standard deviation and range of its episodes' returns, their mean length.

    Where there are several seeds, the last rows are the mean of their means and its 95 % t-interval, without those of
    seeds that failed in training.
    """
    returns = {seed: np.array([episode.episode_return for episode in result]) for seed, result in results.items()}
    largest = max((float(np.abs(values).max()) for values in returns.values()), default=0.0)
    has_success = any(episode.success is not None for result in results.values() for episode in result)
    headings = ("seed", "mean return", "± std", "min", "max", "length", *["success"] * has_success)
    rows = []
    for seed, values in returns.items():
        over, lengths = over_seeds(values), [episode.length for episode in results[seed]]
        numbers = (over.mean, over.std, values.min(), values.max())
        cells = [Cell(str(seed), seed), *(numeric(value, number(value, largest)) for value in numbers)]
        cells.append(Cell(f"{np.mean(lengths):,.1f}", float(np.mean(lengths))))
        if has_success:
            share = float(np.mean([episode.success or 0.0 for episode in results[seed]]))
            cells.append(Cell(f"{share:.0%}", share))
        rows.append(Row(tuple(cells), "failed" if seed in failed else "plain"))
    sound = [values.mean() for seed, values in returns.items() if seed not in failed]
    if len(sound) > 1:
        over = over_seeds(sound)
        blank = [EMPTY] * (len(headings) - 2)
        rows.append(Row((Cell("mean", np.nan), Cell(number(over.mean, largest), over.mean), *blank), "summary"))
        rows += summary_tables.interval_rows([over], largest, len(blank))
    return Fitted(Table(headings, tuple(rows), note=summary_tables.few_seeds(len(sound))))


def case_table(results: Mapping[int, Sequence[EvaluationEpisode]]) -> Fitted | None:
    """Return the paper's case table of these episodes, see `summary_tables`; None where the task says nothing."""
    table = summary_tables.case_table(_rows(results))
    return table and Fitted(table)


def silent_events(results: Mapping[int, Sequence[EvaluationEpisode]]) -> list[str]:
    """Return the events that no episode has held."""
    episodes = [episode for result in results.values() for episode in result]
    names = episodes[0].events if episodes else ()
    return [name for name in names if all(episode.events.get(name) is None for episode in episodes)]


def print_runs(console: Console, runs: Sequence[RunSet]) -> None:
    """Print what was trained in each run, how far it is, its last return and where it is.

    The last return is the mean over the seeds that have not failed.

    A table where it fits, else a few lines for each run: a path that is cut could not be copied.
    """
    headings = ("task", "algorithm", "seeds", "steps", "state", "last return", "directory")
    table, lines = rich.table.Table(box=box.SIMPLE, pad_edge=False), Text()
    for heading in headings:
        table.add_column(heading, justify="right" if heading in ("seeds", "steps", "last return") else "left")
    for run in runs:
        state, last, config = run.state, _last_return(run), run.config
        task, algorithm, seeds = config.task, config.algorithm, len(run.seeds)
        steps = f"{short(run.steps_done)} / {short(config.steps)}"
        coloured = Text(state, STATE_STYLES.get(state, ""))
        table.add_row(Text(task), algorithm, str(seeds), steps, coloured, last, Text(str(run.path)))
        of_seeds = f"{seeds} seed{'s' * (seeds > 1)}"
        lines.append(f"{run.path}\n  {task}, {algorithm}, {of_seeds}, {steps} steps, ")
        lines.append(coloured).append(f", last return {last}\n" if last else "\n")
    natural = Measurement.get(console, console.options.update(max_width=WIDEST), table).maximum
    console.print(table if natural <= console.width else lines, soft_wrap=True, end="")


def _failed(run: RunSet) -> set[int]:
    return set(run.failures)


def _rows(results: Mapping[int, Sequence[EvaluationEpisode]]) -> np.ndarray:
    """Return episodes as rows of evaluations.csv: NaN for what an episode does not say."""
    episodes = [(seed, episode) for seed, result in results.items() for episode in result]
    events = list(episodes[0][1].events) if episodes else []
    columns = [("seed", np.int64), ("return", np.float64), ("success", np.float64)]
    rows = np.empty(len(episodes), columns + [(name, np.float64) for name in events])
    for row, (seed, episode) in zip(rows, episodes, strict=True):
        row["seed"], row["return"] = seed, episode.episode_return
        for name, value in (("success", episode.success), *((name, episode.events.get(name)) for name in events)):
            row[name] = np.nan if value is None else float(value)
    return rows


def _last_return(run: RunSet) -> str:
    try:
        returns = last_evaluations(run.sound_evaluations, points=1)
    except InputError:
        return "damaged"
    return number(float(np.mean(list(returns.values())))) if returns else ""


class _LenientFile:
    """A text file that swallows what can no longer be written: a run goes on after its terminal or pipe is gone."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file

    def write(self, text: str) -> int:
        try:
            return self._file.write(text)
        except (OSError, ValueError):  # ValueError: it is closed
            return len(text)

    def flush(self) -> None:
        try:
            self._file.flush()
        except (OSError, ValueError):
            return

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
