"""What all measurements have in common: options, turns, a CSV of rows with its notes, and a table in a page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.measuring import ROOT, Window, machine
from benchmarks.tables import Row, formatted, read_rows, write_rows
from csac.record.rendering import between_markers

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

RESULTS = ROOT / "benchmarks" / "results"


class Options(NamedTuple):
    """What the command line says; `python -m benchmarks --help` tells what each means."""

    only: str = ""
    repetitions: int | None = None
    seconds: float | None = None
    quick: bool = False
    device: str = "gpu"

    def lasting(self, usual: float) -> float:
        """Return for how long to measure what usually takes so many seconds."""
        return self.seconds or (min(usual, 1.0) if self.quick else usual)

    def window(self, usual: float, evaluated: bool = False) -> Window:
        """Return when steps are counted: usually for so many seconds; `evaluated`, for an interval at least."""
        window = Window(settled=260 if self.quick else 500, seconds=self.lasting(usual) if usual else 0.0)
        interval, episodes = (250, 1) if self.quick else (5_000, 10)
        counted = {"steps": interval, "evaluation_interval": interval, "evaluation_episodes": episodes}
        return window._replace(**counted) if evaluated else window


@dataclass(frozen=True)
class Part:
    """Something that is measured: `results/NAME.csv` has its rows, NAME.txt what they depend on, `page` its table.

    `measure` gives the rows of a case. A case is its name, or has one; where its `repeated` is false, it is measured in
    the first repetition alone. Only where `repetitions` is more than one can the command line choose another number.
    """

    name: str
    page: str
    about: str
    cases: Sequence[Any]
    measure: Callable[[Any, Options], list[Row]]
    render: Callable[[list[Row]], str] | Mapping[str, str]  # or its columns, by their headings
    repetitions: int = 1
    quick_cases: int = 1
    notes: Callable[[list[Row], Options], list[str]] = lambda rows, options: []
    draw: Callable[[list[Row], Path], None] | None = None

    def run(self, options: Options, unfinished: Path | None = None) -> list[Row]:
        """Measure the cases in turns, A B C A B C, and say what comes out; `unfinished` has the rows so far."""
        chosen = [case for case in self.cases if options.only in getattr(case, "name", case)]
        repetitions = options.repetitions or self.repetitions if self.repetitions > 1 else 1
        if options.quick:
            chosen, repetitions = chosen[: self.quick_cases], 1
        rows = []
        for repetition in range(repetitions):
            for case in chosen:
                if repetition == 0 or getattr(case, "repeated", True):
                    measured = self.measure(case, options)
                    for row in measured:
                        values = (f"{key} {value:.4g}" for key, value in row.items() if isinstance(value, float))
                        print(f"{getattr(case, 'name', case)}: {', '.join(values)}", flush=True)
                    rows += [{"repetition": repetition, **row} if self.repetitions > 1 else row for row in measured]
                    if unfinished and rows:
                        write_rows(unfinished, rows)
        return rows

    def table(self, rows: list[Row]) -> str:
        """Return the table, or tables, of these rows in Markdown."""
        return self.render(rows) if callable(self.render) else formatted(rows, self.render)

    def all_notes(self, rows: list[Row], options: Options) -> list[str]:
        """Return what the numbers depend on, a line each."""
        return [*machine(0.1 if options.quick else 1.0), *self.notes(rows, options)]

    def unfinished(self, folder: Path = RESULTS) -> Path:
        """Return where rows lie until all are measured and written: an hour's work outlives what cuts it off."""
        return folder / f"{self.name}.unfinished.csv"

    def write(self, rows: list[Row], notes: Sequence[str], folder: Path = RESULTS) -> None:
        """Write the rows, the notes and, where there is one, the picture."""
        write_rows(folder / f"{self.name}.csv", rows)
        (folder / f"{self.name}.txt").write_text("".join(f"{note}\n" for note in notes))
        if self.draw:
            self.draw(rows, folder / f"{self.name}.png")
        self.unfinished(folder).unlink(missing_ok=True)

    def block(self, folder: Path = RESULTS) -> str:
        """Return what stands in the page: the table of the rows that were written, and below it the notes."""
        if not (folder / f"{self.name}.csv").exists():
            return f"Not measured yet: `python -m benchmarks {self.name} --write` puts the table here.\n"
        notes = (folder / f"{self.name}.txt").read_text().splitlines()
        return shown(self.table(read_rows(folder / f"{self.name}.csv")), notes)

    def publish(self, folder: Path = RESULTS, root: Path = ROOT) -> None:
        """Put the table into its page."""
        page = root / self.page
        page.write_text(between_markers(page.read_text(), self.name, self.block(folder)))


def shown(table: str, notes: Sequence[str]) -> str:
    """Return a table with its notes, in Markdown."""
    return "\n".join([table, "", *(f"- {note}" for note in notes), ""])
