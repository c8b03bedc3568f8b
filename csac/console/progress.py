"""What a run shows while it trains and when it is over: a live display on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import shlex
import time
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from csac.console.tables import duration, events_table, make_console, program, recovery_tables, results_table
from csac.console.waiting import SECONDS_OF_SILENCE, Speed
from csac.record.rendering import number, short
from csac.record.statistics import evaluation_matrix
from csac.tasks.registry import can_be_drawn

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from rich.console import Console, RenderableType

    from csac.record.manifest import Manifest
    from csac.record.run import RunDirectory

BLOCKS = "▁▂▃▄▅▆▇█"
CURVE_WIDTH = 24
MOST_SEEDS_SHOWN = 12  # of more, only the mean and the range are shown


class Reporter:
    """Shows the progress of one run.

    Args:
        console: where to; by default a console on standard output that outlives its reader.
        clock: seconds, for speed and time left.
    """

    def __init__(self, console: Console | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self.console = console or make_console()
        self._clock = clock
        self._live: Live | None = None
        self._steps = 0
        self._directory = ""
        self._done: dict[int, int] = {}
        self._begin = 0
        self._curves: dict[int, list[float]] = {}
        self._failed: dict[int, str] = {}
        self._just_told: set[int] = set()  # failed seeds of which the last lines tell
        self._evaluated_at = 0
        self._speed = Speed(clock)
        self._began = self._spoke = clock()

    def start(
        self, task: str, algorithm: str, seeds: list[int], steps: int, directory: str | Path, notes: Sequence[str] = ()
    ) -> None:
        """Say what is trained and where it goes; `steps` are environment steps per seed."""
        self._steps, self._directory = steps, str(directory)
        self._done = dict.fromkeys(seeds, 0)
        self._curves = {seed: [] for seed in seeds}
        self._began = self._spoke = self._clock()
        self._print(Text.assemble((f"{algorithm} on {task}", "bold"), f", {_seeds(seeds)}, {steps:,} steps each"))
        self._print(Text(self._directory, "dim"))
        for note in notes:
            self._print(Text(note, "dim"))
        if self.console.is_interactive:
            self._print(Text())
            self._live = Live(get_renderable=self._display, console=self.console, refresh_per_second=2, transient=True)
            self._live.start()

    def go_on(self, step: int, evaluations: np.ndarray, failures: Mapping[int, str]) -> None:
        """Show what was there when the run was taken up again at `step`."""
        self._failed = {seed: f"failed at {reason}" for seed, reason in failures.items()}
        self._begin = step
        self._done.update(dict.fromkeys(self._done, step))
        steps, seeds, returns = evaluation_matrix(evaluations)
        self._evaluated_at = int(steps.max(initial=0))
        for seed, line in zip(seeds.tolist(), returns, strict=True):
            self._curves[seed] = line[~np.isnan(line)].tolist()

    def progress(self, steps_by_seed: Mapping[int, int]) -> None:
        """Note how far each seed is."""
        self._done.update(steps_by_seed)
        self._speed.add(sum(self._done.values()))
        if not self._live and self._clock() - self._spoke >= SECONDS_OF_SILENCE:
            step = min(self._living().values(), default=0)
            self._say(f"step {step:,} of {self._steps:,}{self._pace() or self._why_slow()}")

    def evaluated(self, step: int, returns: Mapping[int, float]) -> None:
        """Show the mean return of each seed's evaluation episodes at `step`."""
        self._evaluated_at = step
        for seed, value in returns.items():
            self._curves[seed].append(value)
            self._done[seed] = max(step, self._done[seed])  # it may be told of before the step is
        if not self._live and returns:
            mean = float(np.mean(list(returns.values())))
            text = f"step {step:,} of {self._steps:,}: mean return {number(mean)}{_spread(returns)}"
            self._say(text + self._pace())

    def failed(self, seed: int, step: int, reason: str) -> None:
        """Show that a seed has stopped; the others go on."""
        self._failed[seed] = f"failed at step {step:,}: {reason}"
        self._print(Text(f"seed {seed} {self._failed[seed]}", "red"))
        self._just_told.add(seed)

    def note(self, text: str) -> None:
        """Show one line about the run as a whole."""
        self._print(Text(text, "dim"))

    def finish(self, run: RunDirectory) -> None:
        """Replace the display by the results, and say where they are and what to type next."""
        self.close()
        self._print(Text())
        self._print(Text(_outcome(run.manifest, duration(self._clock() - self._began)), "bold"))
        evaluations = run.evaluations
        if len(evaluations):
            self._print(results_table(run))
            if (events := events_table(run.sound_evaluations)) is not None:
                self._print(events)
            for table in recovery_tables(run):
                self._print(table)
        else:
            self._print(Text("no evaluations yet"))
        for seed, reason in run.manifest.failures.items():
            if seed not in self._just_told:
                self._print(Text(f"seed {seed} failed at {reason}", "red"))
        self._print_next(run, bool(len(evaluations)))

    def close(self) -> None:
        """Give the terminal back as it was. May be called at any time, and again."""
        if self._live:
            self._live.stop()
            self._live = None

    def _print_next(self, run: RunDirectory, has_curve: bool) -> None:
        directory, csac = shlex.quote(str(run.path)), program()
        one, film = run.manifest, shlex.quote(str(run.path / "play.mp4"))
        is_sound = len(one.failures) < len(one.seeds)
        log = run.path / "log.txt"
        lines = [("why", f"the traceback is in {log}")] if one.failures and _has_traceback(log) else []
        lines += [("curve", str(run.path / "curve.png"))] if has_curve else []
        # A failed seed that was never evaluated would fail in a test as well: its task does not run.
        if one.steps_done and run.seeds_with_policies() and (is_sound or has_curve):
            if one.task_is_callable:  # which no command line can name
                task = one.task if one.task.isidentifier() else "your_task"
                more = f", environment_arguments={one.environment_arguments}" if one.environment_arguments else ""
                lines += [("test it", f"in Python: evaluate(load({str(run.path)!r}), {task}{more})")] * is_sound
            else:
                lines.append(("test it", f"{csac} evaluate {directory}"))
                is_seen = is_sound and can_be_drawn(one.task)
                lines += [("watch it", f"{csac} play {directory} --video {film}")] * is_seen
        for label, line in lines:
            self._print(Text.assemble((f"{label:<9}", "dim"), line))

    def _print(self, renderable: RenderableType) -> None:
        # A path or a command that is cut into lines could not be copied.
        self.console.print(renderable, soft_wrap=isinstance(renderable, Text))
        self._spoke = self._clock()

    def _say(self, text: str) -> None:
        self._just_told.clear()
        self._print(Text(text))

    def _living(self) -> dict[int, int]:
        return {seed: step for seed, step in self._done.items() if seed not in self._failed}

    def _pace(self) -> str:
        """Return how fast it goes and how long it will take, as soon as both are known."""
        speed = self._speed.per_second()
        if not speed:
            return ""
        unit = "steps/s" if len(self._done) == 1 else "seed-steps/s"
        left = sum(self._steps - step for step in self._living().values()) / speed
        return f", {speed:,.0f} {unit}" + (f", {duration(left)} left" if left else "")

    def _why_slow(self) -> str:
        """Return what goes on while no step is made: before the first one, and after the last."""
        living = self._living()
        if living and all(step <= self._begin for step in living.values()):
            return f", compiling for {duration(self._clock() - self._began)}"
        return ", finishing" if living and all(step >= self._steps for step in living.values()) else ""

    def _display(self) -> RenderableType:
        return Group(self._bar(), Text(), self._returns()) if any(self._curves.values()) else self._bar()

    def _bar(self) -> RenderableType:
        living = self._living() or self._done
        done, total = sum(living.values()), self._steps * len(living)
        step = f"step {short(min(living.values()))} of {short(self._steps)}"
        text = f"{100 * done // total} %, {step}{self._why_slow() or self._pace()}"
        width = min(CURVE_WIDTH, max(self.console.width - len(text) - 2, 4))
        grid = Table.grid(padding=(0, 2))
        grid.add_row(ProgressBar(total=total, completed=done, width=width), Text(text))
        return grid

    def _returns(self) -> RenderableType:
        """One line per seed, its returns so far as a curve, then the mean over the seeds that are still training."""
        shown = {seed: curve for seed, curve in self._curves.items() if curve or seed in self._failed}
        known = [value for curve in shown.values() for value in curve if math.isfinite(value)]
        low, high = min(known, default=0.0), max(known, default=0.0)
        table = Table.grid(padding=(0, 2))
        table.add_column(justify="right", style="dim")
        table.add_column(style="cyan", no_wrap=True)
        table.add_column(justify="right")
        table.add_column(style="dim", no_wrap=True)

        def add(label: str, curve: list[float], note: str = "", style: str = "") -> None:
            picture = "" if self.console.options.ascii_only else sparkline(curve, low, high, CURVE_WIDTH)
            latest = number(curve[-1], largest=max(abs(low), abs(high))) if curve else ""
            table.add_row(Text(label), Text(picture), Text(latest), Text(note), style=style)

        if len(shown) <= MOST_SEEDS_SHOWN:
            for seed, curve in shown.items():
                note, style = ("stopped", "red") if seed in self._failed else ("", "")
                add(f"seed {seed}", list(curve), note, style)
        living = [curve for seed, curve in shown.items() if curve and seed not in self._failed]
        if len(living) > 1:
            shortest = min(len(curve) for curve in living)
            values = np.array([curve[:shortest] for curve in living])
            note = (
                ""
                if len(shown) <= MOST_SEEDS_SHOWN
                else f"{number(values[:, -1].min())} to {number(values[:, -1].max())}"
            )
            add("mean", list(values.mean(axis=0)), note, "bold")
        return Group(Text(f"return at step {self._evaluated_at:,}", "dim"), table)


def sparkline(values: Sequence[float] | np.ndarray, low: float, high: float, width: int) -> str:
    """Draw values between `low` and `high` in at most `width` characters, each the mean of its share; NaN is blank."""
    array = np.asarray(values, dtype=np.float64)
    parts = np.array_split(array, min(width, len(array))) if len(array) else []
    span = high - low
    drawn = ""
    for part in parts:
        level = (part.mean() - low) / span if span > 0 else 0.5
        drawn += BLOCKS[min(max(int(level * len(BLOCKS)), 0), len(BLOCKS) - 1)] if math.isfinite(level) else " "
    return drawn


def _has_traceback(log: Path) -> bool:
    """Whether a log says more of a failure than its line: where a number is not finite, nothing was raised."""
    return log.exists() and "\nTraceback (most recent" in log.read_text(encoding="utf-8", errors="replace")


def _outcome(manifest: Manifest, time_taken: str) -> str:
    steps, failed, seeds = f"{manifest.steps_done:,}", len(manifest.failures), len(manifest.seeds)
    if manifest.state == "interrupted":
        return f"stopped at step {steps} of {manifest.steps:,} after {time_taken}"
    if failed == seeds:
        return f"failed at step {steps} after {time_taken}"
    return f"finished {steps} steps in {time_taken}" + (f", but {failed} of {seeds} seeds failed" if failed else "")


def _seeds(seeds: Sequence[int]) -> str:
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"


def _spread(returns: Mapping[int, float]) -> str:
    if len(returns) == 1:
        return ""
    if len(returns) > MOST_SEEDS_SHOWN:
        return f" ({number(min(returns.values()))} to {number(max(returns.values()))})"
    return " (" + ", ".join(f"seed {seed} {number(value)}" for seed, value in returns.items()) + ")"
