"""What `csac study run` shows: one table of the cells that are being run, on a terminal; plain lines elsewhere."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from csac.console.tables import duration, make_console, number, short
from csac.studies.job import Advanced, Ended, Message, Noted, Started

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rich.console import Console, RenderableType

    from csac.studies.cells import Cell

BAR_WIDTH = 24
MOST_ROWS = 40  # of cells that are being run; of more, only their number is shown


@dataclass
class _Row:
    """A cell that is being run."""

    where: str
    first_step: int
    began: float
    step: int
    mean_return: float = math.nan


class StudyProgress:
    """Shows how far the cells of a study are.

    Args:
        cells: those to run.
        labels: what each is called, by its key.
        done: the steps that were made before, by key.
        console: where to; by default a console on standard output that outlives its reader.
        clock: seconds, for speed and time left.
    """

    def __init__(
        self,
        cells: Sequence[Cell],
        labels: Mapping[str, str],
        done: Mapping[str, int],
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.console = console or make_console()
        self.outcomes: dict[str, Ended] = {}
        self._cells = {cell.key: cell for cell in cells}
        self._labels, self._clock = labels, clock
        self._steps = {cell.key: done.get(cell.key, 0) for cell in cells}
        self._running: dict[str, _Row] = {}
        self._began, self._first_steps = clock(), sum(self._steps.values())
        self._live: Live | None = None
        if cells and self.console.is_interactive:
            self._live = Live(get_renderable=self._display, console=self.console, refresh_per_second=2, transient=True)
            self._live.start()

    def tell(self, message: Message) -> None:
        """Show what an engine tells."""
        if isinstance(message, Started):
            step = self._steps[message.key]
            self._running[message.key] = _Row(message.where, step, self._clock(), step)
            if not self._live:
                self._say(f"begins: {self._labels[message.key]}" + (f", from step {step:,}" if step else ""))
        elif isinstance(message, Advanced):
            self._steps[message.key] = message.step
            if row := self._running.get(message.key):
                row.step, row.mean_return = message.step, message.mean_return
        elif isinstance(message, Noted):
            self._say(f"note: {self._labels[message.key]} {message.text}")
        else:
            self._end(message)

    def close(self) -> None:
        """Give the terminal back as it was. May be called again."""
        if self._live:
            self._live.stop()
            self._live = None

    def _end(self, message: Ended) -> None:
        self._running.pop(message.key, None)
        self.outcomes[message.key] = message
        if message.outcome == "complete":
            self._steps[message.key] = self._cells[message.key].steps
        words = {
            "complete": "complete",
            "failed": "failed",
            "stopped": "stopped",
            "elsewhere": "run by another process",
        }
        text = f"{words[message.outcome]}: {self._labels[message.key]}" + (f": {message.reason}" * bool(message.reason))
        style = "red" if message.outcome == "failed" else ""
        self._say(f"{text}{self._so_far()}", style)

    def _say(self, text: str, style: str = "") -> None:
        self.console.print(Text(text, style), soft_wrap=True)

    def _so_far(self) -> str:
        complete = sum(ended.outcome == "complete" for ended in self.outcomes.values())
        return f" ({complete} of {len(self._cells)} cells{self._left()})"

    def _left(self) -> str:
        """Return the time that the rest will take at the speed so far, as soon as there is one."""
        made = sum(self._steps.values()) - self._first_steps
        lost = [self._cells[key].steps - self._steps[key] for key, end in self.outcomes.items()]
        rest = sum(cell.steps for cell in self._cells.values()) - sum(self._steps.values()) - sum(lost)
        return f", {duration((self._clock() - self._began) / made * rest)} left" if made and rest else ""

    def _display(self) -> RenderableType:
        total, made = sum(cell.steps for cell in self._cells.values()), sum(self._steps.values())
        counts = [ended.outcome for ended in self.outcomes.values()]
        text = f"{100 * made // total} %, {counts.count('complete')} of {len(self._cells)} cells{self._left()}"
        text += f", {counts.count('failed')} failed" * ("failed" in counts)
        grid = Table.grid(padding=(0, 2))
        grid.add_row(ProgressBar(total=total, completed=made, width=BAR_WIDTH), Text(text))
        if len(self._running) > MOST_ROWS:
            return Group(grid, Text(f"{len(self._running)} cells are being run"))
        return Group(grid, Text(), self._table())

    def _table(self) -> Table:
        table = Table.grid(padding=(0, 2))
        for _ in range(2):
            table.add_column(no_wrap=True)
        for _ in range(3):
            table.add_column(justify="right", no_wrap=True, style="dim")
        for key, row in self._running.items():
            made, seconds = row.step - row.first_step, self._clock() - row.began
            table.add_row(
                Text(self._labels[key]),
                Text(row.where, "dim"),
                f"step {short(row.step)} of {short(self._cells[key].steps)}",
                f"{made / seconds:,.0f} steps/s" if made and seconds else "",
                "" if math.isnan(row.mean_return) else f"return {number(row.mean_return)}",
            )
        return table
