"""Show a set of runs during and after training: a live display on a terminal, plain lines elsewhere."""

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

from csac.console.tables import duration, make_console, program, result_tables
from csac.console.waiting import SECONDS_OF_SILENCE, Speed
from csac.record.rendering import number, short
from csac.seeds import name_seeds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rich.console import Console, RenderableType

    from csac.record.run import RunDirectory
    from csac.record.sets import RunSet

BLOCKS = "▁▂▃▄▅▆▇█"
CURVE_WIDTH = 24
MOST_SEEDS_SHOWN = 12  # with more, only the mean and the range are shown


class _Seed:
    """The progress of one run: its step, and the mean return of each evaluation, keyed by step."""

    def __init__(self, run: RunDirectory) -> None:
        manifest, origin = run.manifest, run.manifest.forked_from
        resumes_at = max(manifest.last_checkpoint, origin.step if origin else 0)
        self.begin = self.step = manifest.steps_done if manifest.state == "finished" else resumes_at
        self.failure = ""
        rows = run.evaluations
        rows = rows[rows["step"] <= self.step]  # later ones are rolled back
        self.returns = {
            int(step): float(rows["return"][rows["step"] == step].mean()) for step in np.unique(rows["step"])
        }


class Reporter:
    """Show the progress of a set of runs, by default on standard output; `clock` returns seconds."""

    def __init__(self, console: Console | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self.console = console or make_console()
        self._clock, self._speed = clock, Speed(clock)
        self._live: Live | None = None
        self._seeds: dict[int, _Seed] = {}
        self._steps = self._printed = 0  # steps per run; step of the newest evaluation printed as a line
        self._warmup = 0.0  # steps before the first update, whose speed says nothing about later steps
        self._started = self._last_output = clock()

    def start(self, runs: RunSet, notes: Sequence[str] = ()) -> None:
        """Print what is trained, its directory and the notes, and start the live display on a terminal."""
        config = runs.config
        self._steps, self._seeds = config.steps, {run.seed: _Seed(run) for run in runs.runs}
        self._warmup = config.hyperparameters.get("warmup_steps", 0)
        self._printed = self._newest_common_step()
        self._started = self._last_output = self._clock()
        title = Text.assemble((f"{config.algorithm} on {config.task}", "bold"))
        self._print(title.append(f", {name_seeds(runs.seeds)}, {config.steps:,} steps{' each' * (len(runs.runs) > 1)}"))
        for line in (str(runs.path), *notes):
            self._print(Text(line, "dim"))
        if self.console.is_interactive:
            self._print(Text())
            self._live = Live(get_renderable=self._display, console=self.console, refresh_per_second=2, transient=True)
            self._live.start()

    def progress(self, steps: Mapping[int, int]) -> None:
        """Record the current steps of some seeds."""
        for seed, step in steps.items():
            self._seeds[seed].step = step
        if self._is_warming_up():
            self._speed = Speed(self._clock)
        self._speed.add(sum(one.step for one in self._seeds.values()))
        if not self._live and self._clock() - self._last_output >= SECONDS_OF_SILENCE:
            reached = sorted({one.step for one in (self._living() or self._seeds).values()})
            span = " to ".join(f"{step:,}" for step in dict.fromkeys((reached[0], reached[-1])))
            self._print(Text(f"step {span} of {self._steps:,}{self._pace()}"))

    def evaluated(self, step: int, returns: Mapping[int, float]) -> None:
        """Record the mean returns of some seeds' evaluations at `step`; print a line once no seed is behind."""
        for seed, value in returns.items():
            one = self._seeds[seed]
            one.returns[step], one.step = value, max(step, one.step)
        passed = self._newest_common_step()
        if not self._live and passed > self._printed:
            self._printed = passed
            living = {seed: one.returns[passed] for seed, one in self._living().items() if passed in one.returns}
            mean = float(np.mean(list(living.values())))
            self._print(
                Text(f"step {passed:,} of {self._steps:,}: mean return {number(mean)}{_spread(living)}{self._pace()}")
            )

    def failed(self, seed: int, step: int, reason: str) -> None:
        """Show that a seed has failed; the others continue."""
        self._seeds[seed].failure = f"seed {seed} failed at step {step:,}: {reason}"
        self._print(Text(self._seeds[seed].failure, "red"))

    def note(self, text: str) -> None:
        """Show one line about the runs as a whole."""
        self._print(Text(text, "dim"))

    def finish(self, runs: RunSet) -> None:
        """Replace the display by the results, and print where they are and what to type next."""
        self.close()
        self._print(Text())
        self._print(Text(_outcome(runs, duration(self._clock() - self._started)), "bold"))
        has_curve = bool(len(runs.evaluations))
        for table in result_tables(runs) if has_curve else [Text("no evaluations")]:
            self._print(table)
        for seed, reason in runs.failures.items():
            if seed not in self._seeds or not self._seeds[seed].failure:
                self._print(Text(f"seed {seed} failed at {reason}", "red"))
        for label, line in _next_lines(runs, has_curve):
            self._print(Text.assemble((f"{label:<9}", "dim"), line))

    def close(self) -> None:
        """Stop the live display and restore the terminal. May be called at any time, and more than once."""
        if self._live:
            self._live.stop()
            self._live = None

    def _print(self, renderable: RenderableType) -> None:
        # A path or a command that is wrapped could not be copied.
        self.console.print(renderable, soft_wrap=isinstance(renderable, Text))
        self._last_output = self._clock()

    def _living(self) -> dict[int, _Seed]:
        return {seed: one for seed, one in self._seeds.items() if not one.failure}

    def _newest_common_step(self) -> int:
        """Return the newest step at which all seeds that have not failed are evaluated, 0 before the first."""
        newest = [max(one.returns, default=0) for one in self._living().values()]
        return min(newest, default=0)

    def _is_warming_up(self) -> bool:
        return any(one.step < min(self._warmup, self._steps) for one in self._living().values())

    def _pace(self) -> str:
        """Return the speed and the time left, or the phase: compiling, warm-up or finishing."""
        living = self._living().values()
        if living and all(one.step <= one.begin for one in living):
            return f", compiling for {duration(self._clock() - self._started)}"
        left = sum(self._steps - one.step for one in living)
        if living and not left:
            return ", finishing"
        if self._is_warming_up():
            return f", {self._warmup:,} random steps before learning"
        speed = self._speed.per_second()
        unit = "steps/s" if len(self._seeds) == 1 else "seed-steps/s"
        return f", {speed:,.0f} {unit}, {duration(left / speed)} left" if speed else ""

    def _display(self) -> RenderableType:
        """Return a bar over all seeds, and a line for each: its step, its returns as a curve, and the last one."""
        living = (self._living() or self._seeds).values()
        done, total = sum(one.step for one in living), self._steps * len(living)
        step = short(min(one.step for one in living))
        text = f"{100 * done // total} %, step {step} of {short(self._steps)}{self._pace()}"
        width = min(CURVE_WIDTH, max(self.console.width - len(text) - 2, 4))
        bar = Table.grid(padding=(0, 2))
        bar.add_row(ProgressBar(total=total, completed=done, width=width), Text(text))
        if not any(one.returns for one in self._seeds.values()):
            return bar
        return Group(bar, Text(), self._curves())

    def _curves(self) -> Table:
        curves = {seed: list(one.returns.values()) for seed, one in self._seeds.items()}
        known = [value for curve in curves.values() for value in curve if math.isfinite(value)]
        low, high = min(known, default=0.0), max(known, default=0.0)
        table = Table.grid(padding=(0, 2))
        table.add_column(justify="right", style="dim")
        table.add_column(justify="right", style="dim")
        table.add_column(style="cyan", no_wrap=True)
        table.add_column(justify="right")
        table.add_column(style="dim", no_wrap=True)

        def add(label: str, step: str, curve: Iterable[float], note: str = "", style: str = "") -> None:
            values = list(curve)
            picture = "" if self.console.options.ascii_only else sparkline(values, low, high, CURVE_WIDTH)
            latest = number(values[-1], largest=max(abs(low), abs(high))) if values else ""
            table.add_row(Text(label), Text(step), Text(picture), Text(latest), Text(note), style=style)

        if len(curves) <= MOST_SEEDS_SHOWN:
            for seed, one in self._seeds.items():
                add(f"seed {seed}", short(one.step), curves[seed], *(("stopped", "red") if one.failure else ()))
        living = [curves[seed] for seed in self._living() if curves[seed]]
        if len(living) > 1:
            shortest = min(map(len, living))
            values = np.array([curve[:shortest] for curve in living])
            ends = f"{number(values[:, -1].min())} to {number(values[:, -1].max())}"
            add("mean", "", values.mean(axis=0), ends if len(curves) > MOST_SEEDS_SHOWN else "", "bold")
        return table


def sparkline(values: Sequence[float] | np.ndarray, low: float, high: float, width: int) -> str:
    """Draw values between `low` and `high` in at most `width` characters, each the mean of a chunk; NaN is blank."""
    array = np.asarray(values, dtype=np.float64)
    parts = np.array_split(array, min(width, len(array))) if len(array) else []
    span, drawn = high - low, ""
    for part in parts:
        level = (part.mean() - low) / span if span > 0 else 0.5
        drawn += BLOCKS[min(max(int(level * len(BLOCKS)), 0), len(BLOCKS) - 1)] if math.isfinite(level) else " "
    return drawn


def _next_lines(runs: RunSet, has_curve: bool) -> list[tuple[str, str]]:
    """Return (label, line) pairs that say where to look and what to type next."""
    directory, config = shlex.quote(str(runs.path)), runs.config
    logs = [run.path / "log.txt" for run in runs.runs if run.seed in runs.failures]
    lines = [("why", f"see {log}") for log in logs if log.exists()]
    lines += [("curve", str(runs.curve))] if has_curve else []
    if not any(run.policy_file().exists() for run in runs.runs if run.seed not in runs.failures):
        return lines
    if config.task_is_callable:  # no command line can name it
        task = config.task if config.task.isidentifier() else "your_task"
        return [*lines, ("test it", f"in Python: evaluate(load({str(runs.path)!r}), {task})")]
    lines.append(("test it", f"{program()} evaluate {directory}"))
    if has_curve or len(runs.runs) == 1:
        film = shlex.quote(str(runs.path / "play.mp4"))
        lines.append(("watch it", f"{program()} play {directory} --video {film}"))
    return [*lines, ("export", f"{program()} export {directory} --format numpy")]


def _outcome(runs: RunSet, time_taken: str) -> str:
    steps, failed, seeds = f"{runs.steps_done:,}", len(runs.failures), len(runs.seeds)
    if runs.state in ("interrupted", "killed", "running"):
        return f"stopped at step {steps} of {runs.config.steps:,} after {time_taken}"
    if failed == seeds:
        return f"failed at step {steps} after {time_taken}"
    return f"finished {steps} steps in {time_taken}" + (f", but {failed} of {seeds} seeds failed" if failed else "")


def _spread(returns: Mapping[int, float]) -> str:
    if len(returns) == 1:
        return ""
    if len(returns) > MOST_SEEDS_SHOWN:
        return f" ({number(min(returns.values()))} to {number(max(returns.values()))})"
    return " (" + ", ".join(f"seed {seed} {number(value)}" for seed, value in returns.items()) + ")"
