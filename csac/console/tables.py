"""Text for people: the console, numbers and lengths of time, and the tables that commands print."""

from __future__ import annotations

import platform
import shlex
import shutil
import sys
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import psutil
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from csac.record.statistics import (
    Recovery,
    evaluation_matrix,
    last_evaluations,
    last_means,
    mean_and_interval,
    mean_told,
    recovery,
)
from csac.record.tables import COLUMNS
from csac.tasks.perturbations import by_step, perturbations_of
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from csac.evaluation.evaluator import EvaluationEpisode
    from csac.record.run import RunDirectory

STATE_STYLES = {"running": "cyan", "finished": "green", "failed": "red", "interrupted": "yellow", "killed": "red"}
ROLLOUTS = 1_000  # that the cases of `csac evaluate` are counted in, as in the paper
MOST_COLUMNS = 5  # of seeds in that table; of more, only the mean and the deviation
WIDTH_ELSEWHERE = 200  # characters where there is no terminal: lines stay whole for grep


def make_console() -> Console:
    """Return a console on standard output that takes text as it is, and that goes quiet when nobody reads any more."""
    width = None if sys.stdout.isatty() else WIDTH_ELSEWHERE
    console = Console(markup=False, emoji=False, highlight=False, width=width)
    console.file = _Outliving(console.file)  # pyright: ignore[reportAttributeAccessIssue]
    return console


def program() -> str:
    """Return what to type for csac: its name, or the path it was started by where a shell would not find the name."""
    started = sys.argv[0]
    is_ours = Path(started).name == "csac" and shutil.which("csac") is None
    return shlex.quote(started) if is_ours else "csac"


def number(value: float, largest: float | None = None) -> str:
    """Return a return as people read it; `largest` sets the decimals for a whole column."""
    size = abs(value) if largest is None else largest
    return f"{value:,.{1 if size >= 100 else 2}f}"


def short(steps: int) -> str:
    """Return a number of steps in little room: 500, 12.5k, 1M."""
    for size, suffix in ((1_000_000, "M"), (1_000, "k")):
        if steps >= size:
            return f"{steps / size:.4g}{suffix}"
    return str(steps)


def duration(seconds: float) -> str:
    """Return a length of time with the two units that matter: 45 s, 3 min 20 s, 1 h 42 min, 2 d 3 h."""
    whole = round(seconds)
    for size, unit, smaller_size, smaller in ((86400, "d", 3600, "h"), (3600, "h", 60, "min"), (60, "min", 1, "s")):
        if whole >= size:
            count, rest = divmod(whole, size)
            return f"{count} {unit}" + (f" {rest // smaller_size} {smaller}" if rest // smaller_size else "")
    return f"{whole} s"


def results_table(run: RunDirectory) -> Table:
    """Return the results of a run, one row per seed: last evaluation, mean of the last three, best, episodes trained.

    Below them the mean, standard deviation and 95 % t-interval over the seeds that did not fail. Their best is the best
    evaluation of all seeds together (the paper's maximum average return), not the mean of each seed's own.
    """
    rows, failures = run.evaluations, run.manifest.failures
    steps, seeds, returns = evaluation_matrix(rows)
    trained, last_three = run.rows("episodes")["seed"], last_evaluations(rows, points=3)
    largest = float(np.nanmax(np.abs(returns), initial=0.0))
    table = _table("seed", "last return", "last three", "best", "at step", "episodes")
    for seed, line in zip(seeds.tolist(), returns, strict=True):
        best = int(np.nanargmax(line))
        values = (line[~np.isnan(line)][-1], last_three[seed], line[best])
        cells = [*(number(value, largest) for value in values), f"{steps[best]:,}"]
        style = "red" if seed in failures else None
        table.add_row(str(seed), *cells, f"{np.count_nonzero(trained == seed):,}", style=style)
    sound = np.array([seed not in failures for seed in seeds.tolist()])
    together = ~np.isnan(returns[sound]).any(axis=0)
    if sound.sum() > 1 and together.any():
        steps, returns = steps[together], returns[sound][:, together]
        best = int(returns.mean(axis=0).argmax())
        three = np.array([last_three[seed] for seed in seeds[sound].tolist()])
        table.add_section()
        for label, cells in _over_seeds(np.stack([returns[:, -1], three, returns[:, best]], axis=1), largest):
            table.add_row(label, *cells, f"{steps[best]:,}" if label == "mean" else "", "")
    return table


def recovery_tables(run: RunDirectory) -> list[Table]:
    """Return a table for each step at which the task was perturbed: what it cost each seed, and how it came back.

    Each looks as far as the next perturbation. There is none where no evaluation lies before the step or none after it.
    """
    rows, perturbed = run.evaluations, by_step(perturbations_of(run.manifest.perturbations))
    tables = []
    for index, (step, text) in enumerate(perturbed):
        until = perturbed[index + 1][0] if index + 1 < len(perturbed) else None
        recoveries = recovery(rows, step, until, perturbed[index - 1][0] if index else -1)
        if any(np.isfinite(seed.drop) for seed in recoveries.values()):
            title = f"{text} after step {step:,}" + (
                f", until {until:,}" if until and until < rows["step"].max() else ""
            )
            tables.append(_recovery_table(title, recoveries, run.manifest.failures))
    return tables


def _recovery_table(title: str, recoveries: Mapping[int, Recovery], failures: Mapping[int, str]) -> Table:
    """Return one row per seed, and below them the mean and standard deviation over seeds that did not fail.

    Where a seed never came back there is no mean of the steps, but how many did; a share of a return of 0 is left out.
    """
    table = _table("seed", "before", "drop", "relative", "steps to 90 %", "area lost", "final", "worst fall")
    table.title, table.title_justify, table.title_style = title, "left", "bold"
    values = np.array(list(recoveries.values()))
    largest = float(np.nanmax(np.abs(values[:, [0, 1, 5, 6]])))
    for seed, one in recoveries.items():
        table.add_row(str(seed), *_recovery_cells(one, largest), style="red" if seed in failures else None)
    sound = np.array([one for seed, one in recoveries.items() if seed not in failures and np.isfinite(one.drop)])
    if len(sound) > 1:
        back = np.isfinite(sound[:, 3])
        columns = np.where(back.all() | (np.arange(7) != 3), sound, np.nan).T
        known = [column[~np.isnan(column)] for column in columns]
        means = [column.mean() if len(column) else np.nan for column in known]
        deviations = [column.std(ddof=1) if len(column) > 1 else np.nan for column in known]
        mean, std = (_recovery_cells(Recovery(*map(float, row)), largest) for row in (means, deviations))
        mean[3] = mean[3] or f"{back.sum()} of {len(back)}"
        table.add_section()
        table.add_row("mean", *mean)
        table.add_row("± std", *std)
    return table


def _recovery_cells(one: Recovery, largest: float) -> list[str]:
    texts = [
        number(one.before, largest),
        number(one.drop, largest),
        f"{one.relative_drop:.0%}",
        "never" if one.steps_to_regain == np.inf else f"{one.steps_to_regain:,.0f}",
        f"{one.area_lost:,.3g}" if one.area_lost < 1000 else short(round(one.area_lost)),
        number(one.final, largest),
        number(one.worst_drawdown, largest),
    ]
    return ["" if np.isnan(value) else text for value, text in zip(one, texts, strict=True)]


def evaluation_table(results: Mapping[int, Sequence[EvaluationEpisode]]) -> Table:
    """Return one row per seed: mean, standard deviation and range of its episodes' returns, their mean length.

    Where there are several seeds, the last row is the mean of their means with its 95 % t-interval.
    """
    returns = {seed: np.array([episode.episode_return for episode in result]) for seed, result in results.items()}
    largest = max((float(np.abs(values).max()) for values in returns.values()), default=0.0)
    has_success = any(episode.success is not None for result in results.values() for episode in result)
    table = _table("seed", "mean return", "± std", "min", "max", "length", *["success"] * has_success)
    for seed, values in returns.items():
        std = values.std(ddof=1) if len(values) > 1 else 0.0
        cells = [number(value, largest) for value in (values.mean(), std, values.min(), values.max())]
        cells.append(f"{np.mean([episode.length for episode in results[seed]]):,.1f}")
        if has_success:
            cells.append(f"{np.mean([episode.success or 0.0 for episode in results[seed]]):.0%}")
        table.add_row(str(seed), *cells)
    if len(returns) > 1:
        mean, _, high = mean_and_interval(np.array([values.mean() for values in returns.values()]))
        table.add_section()
        table.add_row("mean", number(float(mean), largest))
        table.add_row("± 95 %", number(float(high - mean), largest))
    return table


def events_table(rows: np.ndarray) -> Table | None:
    """Return what the last evaluations say beside returns: success and each event, as means per episode.

    One row each: the mean over the seeds and, where there are several, their standard deviation and range. None where
    the task says nothing.
    """
    names = [name for name in rows.dtype.names or () if name == "success" or name not in COLUMNS["evaluations"]]
    means = {name: np.array(list(last_means(rows, name).values())) for name in names}
    means = {name: values for name, values in means.items() if name != "success" or not np.isnan(values).all()}
    if not means:
        return None
    several = len(np.unique(rows["seed"])) > 1
    table = _table("per episode, last evaluation", "mean", *["± std", "min", "max"] * several)
    table.columns[0].justify = "left"
    for name, values in means.items():
        known = values[~np.isnan(values)]
        cells = [f"{known.mean():.3f}" if len(known) else ""]
        if several:
            cells += [f"{known.std(ddof=1):.3f}"] if len(known) > 1 else [""]
            cells += [f"{known.min():.3f}", f"{known.max():.3f}"] if len(known) else ["", ""]
        table.add_row(Text(name), *cells)
    return table


def case_table(results: Mapping[int, Sequence[EvaluationEpisode]]) -> Table | None:
    """Return the paper's case table: how often success and each event came in 1,000 rollouts, one column per seed.

    A rollout that does not speak of a case counts as one without it. What is a count in itself, such as waypoints
    reached, is a mean per rollout instead, over those that tell it. Where there are several seeds, the last columns are
    the mean over them and their standard deviation. None where the task says nothing.
    """
    episodes = [episode for result in results.values() for episode in result]
    rows: dict[str, list[list[float | None]]]
    rows = {"success": [[_as_bool(episode.success) for episode in result] for result in results.values()]}
    rows = {} if all(episode.success is None for episode in episodes) else rows
    for name in episodes[0].events if episodes else ():
        rows[name] = [[episode.events.get(name) for episode in result] for result in results.values()]
    if not rows:
        return None
    per_seed = len(episodes) // len(results)
    scaled = "" if per_seed == ROLLOUTS else f" (from {per_seed:,} of each seed)"
    shown = len(results) <= MOST_COLUMNS
    headings = [f"seed {seed}" for seed in results] if shown else []
    table = _table(f"per {ROLLOUTS:,} rollouts{scaled}", *headings, *["mean", "± std"] * (len(results) > 1))
    table.columns[0].justify = "left"
    for name, by_seed in rows.items():
        told = [value for values in by_seed for value in values if value is not None]
        is_case = all(isinstance(value, bool) for value in told)
        scale, digits = (ROLLOUTS, 1) if is_case else (1, 3)
        values = np.array([scale * mean_told(np.array(values, float), is_case and told != []) for values in by_seed])
        known = values[~np.isnan(values)]
        cells = [_cell(value, digits) for value in values] if shown else []
        if len(results) > 1:
            cells.append(_cell(known.mean() if len(known) else np.nan, digits))
            cells.append(_cell(known.std(ddof=1) if len(known) > 1 else np.nan, digits))
        table.add_row(Text(name if is_case else f"{name} (mean)"), *cells)
    return table


def silent_events(results: Mapping[int, Sequence[EvaluationEpisode]]) -> list[str]:
    """Return the events that no episode has held."""
    episodes = [episode for result in results.values() for episode in result]
    names = episodes[0].events if episodes else ()
    return [name for name in names if all(episode.events.get(name) is None for episode in episodes)]


def runs_table(runs: Sequence[RunDirectory]) -> Table:
    """Return one row per run: what was trained, how far it is, its last return (mean over its seeds), where it is."""
    table = _table("task", "algorithm", "seeds", "steps", "state", "last return", "directory")
    for column in (0, 1, 4, 6):
        table.columns[column].justify = "left"
    table.columns[6].overflow = "fold"
    for run in runs:
        manifest, state = run.manifest, _state(run)
        steps = f"{short(manifest.steps_done)} / {short(manifest.steps)}"
        table.add_row(
            Text(manifest.task),
            manifest.algorithm,
            str(len(manifest.seeds)),
            steps,
            Text(state, STATE_STYLES.get(state, "")),
            _last_return(run),
            Text(str(run.path)),
        )
    return table


def _over_seeds(values: np.ndarray, largest: float) -> Iterable[tuple[str, list[str]]]:
    """Yield the summary rows for `values` [seed, column]."""
    mean, _, high = mean_and_interval(values)
    for label, row in (("mean", mean), ("± std", values.std(axis=0, ddof=1)), ("± 95 %", high - mean)):
        yield label, [number(value, largest) for value in row]


def _as_bool(success: float | None) -> bool | None:
    return None if success is None else bool(success)


def _cell(value: float, digits: int) -> str:
    return "" if np.isnan(value) else f"{value:,.{digits}f}"


def _state(run: RunDirectory) -> str:
    """Return the state of the manifest, but see through a run whose process, on this machine, is no more."""
    state, process = run.manifest.state, run.manifest.process
    host = run.manifest.machine.host or platform.node()
    if state == "running" and process and host == platform.node() and not psutil.pid_exists(process):
        return "killed"
    return state


def _last_return(run: RunDirectory) -> str:
    try:
        returns = last_evaluations(run.evaluations, points=1)
    except InputError:
        return "damaged"
    return number(float(np.mean(list(returns.values())))) if returns else ""


def _table(*headings: str) -> Table:
    table = Table(box=box.SIMPLE, pad_edge=False)
    for heading in headings:
        table.add_column(heading, justify="right")
    return table


class _Outliving:
    """A text file that swallows what can no longer be written: a run goes on after its terminal or pipe is gone."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file

    def write(self, text: str) -> int:
        try:
            return self._file.write(text)
        except OSError:
            return len(text)

    def flush(self) -> None:
        try:
            self._file.flush()
        except OSError:
            return

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
