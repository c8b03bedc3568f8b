"""What `csac tune` shows: the trial that is being run and the best so far on a terminal; plain lines elsewhere."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from csac.console.tables import duration, make_console, number, short
from csac.studies.cells import LOST_EPISODE
from csac.studies.tune import Watcher

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rich.console import Console, RenderableType

    from csac.studies.shared_study import Attempt, Result, SharedStudy

BAR_WIDTH = 24


class TuneProgress(Watcher):
    """Shows how far a search is.

    Args:
        trials: how many the study is to have.
        steps: of each of them.
        console: where to; by default a console on standard output that outlives its reader.
        clock: seconds, for the time left.
    """

    def __init__(
        self,
        trials: int,
        steps: int,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.console = console or make_console()
        self._trials, self._steps, self._clock = trials, steps, clock
        self._label, self._step, self._objective = 0, 0, math.nan
        self._best: Result | None = None
        self._over, self._here, self._began = 0, 0, clock()
        self._live: Live | None = None

    def start(self, study: SharedStudy) -> None:
        """Say how far the study is, and begin to show what happens."""
        self._look(study)
        question = study.question
        title = f"tuning {question.algorithm.name} on {question.task}"
        seeds = f"{question.seeds} seed{'s' * (question.seeds > 1)}"
        trials = f"{self._trials} trial{'s' * (self._trials != 1)} of {short(question.steps)} steps"
        rest = f", {trials}, {seeds} each, {self._over} over"
        self._print(Text.assemble((title, "bold"), rest))
        self._print(Text(f"{study.directory}; searched: {', '.join(question.space)}", "dim"))
        if self.console.is_interactive:
            self._live = Live(get_renderable=self._display, console=self.console, refresh_per_second=2, transient=True)
            self._live.start()

    def begins(self, attempt: Attempt, step: int) -> None:
        """Show a trial that begins, or goes on from a step."""
        self._label, self._step, self._objective = attempt.label, step, math.nan
        begins = f"goes on from step {step:,}" if step else "begins"
        self._print(Text(f"trial {attempt.label} {begins}: {written(attempt.values)}", "dim"))

    def restarts(self, attempt: Attempt, seeds: Sequence[int]) -> None:
        """Say which seeds go on inexactly."""
        several = len(seeds) > 1
        who = f"seed{'s' * several} {', '.join(map(str, seeds))} restart{'s' * (not several)}"
        self._print(Text(f"note: trial {attempt.label}: {who} {LOST_EPISODE}"))

    def advanced(self, step: int, objective: float) -> None:
        """Show how far the trial is."""
        self._step, self._objective = step, objective

    def ended(self, result: Result, study: SharedStudy) -> None:
        """Show what came of a trial."""
        self._look(study)
        self._here += 1
        self._step = 0
        text, style = f"trial {result.label}: {outcome(result)}", "red" if result.state == "failed" else ""
        if self._best and self._best.label == result.label:
            text, style = f"{text}, the best so far", "bold"
        self._print(Text(f"{text} ({self._so_far()})", style))

    def close(self) -> None:
        """Give the terminal back as it was. May be called again."""
        if self._live:
            self._live.stop()
            self._live = None

    def _look(self, study: SharedStudy) -> None:
        self._over = sum(result.state not in ("running", "waiting") for result in study.results())
        self._best = study.best()

    def _print(self, text: Text) -> None:
        self.console.print(text, soft_wrap=True)

    def _so_far(self) -> str:
        rest = self._trials - self._over
        pace = (self._clock() - self._began) / self._here if self._here else 0.0
        left = f", {duration(rest * pace)} left" if rest > 0 and pace else ""
        return f"{self._over} of {self._trials} trials{left}"

    def _display(self) -> RenderableType:
        grid = Table.grid(padding=(0, 2))
        done = self._over + self._step / self._steps
        grid.add_row(ProgressBar(total=self._trials, completed=done, width=BAR_WIDTH), Text(self._so_far()))
        lines = [f"trial {self._label}, step {short(self._step)} of {short(self._steps)}"]
        lines[0] += "" if math.isnan(self._objective) else f": {number(self._objective)} so far"
        if self._best:
            lines.append(f"best: {number(self._best.objective)}, trial {self._best.label}")
        return Group(grid, *(Text(line, "dim") for line in lines))


def outcome(result: Result) -> str:
    """Return what came of a trial in words."""
    reached = "" if math.isnan(result.objective) else f" with {number(result.objective)}"
    words = {
        "complete": number(result.objective),
        "pruned": f"pruned at step {result.step:,}{reached}",
        "failed": f"failed: {result.reason}",
        "running": f"is being run, at step {result.step:,}{reached}",
        "waiting": "waits to go on",
    }
    return words[result.state]


def written(values: Mapping[str, Any]) -> str:
    """Return hyperparameters as people read them."""
    return ", ".join(f"{name} {value}" for name, value in values.items())
