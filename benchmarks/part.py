"""What all benchmarks have in common: options, turns, a CSV of rows with its notes, and a table in a page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.measuring import ROOT, Window, machine
from benchmarks.tables import Row, between_markers, formatted, read_rows, write_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

RESULTS = ROOT / "benchmarks" / "results"


class Options(NamedTuple):
    """What the command line says; `python -m benchmarks --help` tells what each means."""

    only: str = ""
    repetitions: int | None = None
    quick: bool = False
    device: str = "gpu"

    def lasting(self, usual: float) -> float:
        """Return for how long to measure what usually takes so many seconds."""
        return 0.3 if self.quick else usual

    def window(self, usual: float = 5.0) -> Window:
        """Return when training steps are counted."""
        return Window(self.lasting(usual), settled=300 if self.quick else 500)


@dataclass(frozen=True)
class Part:
    """A benchmark with one table: `results/NAME.csv` has its rows, NAME.txt what they depend on.

    `measure` returns the rows of a case. A case is its name, or has one.
    """

    name: str
    page: str
    about: str
    cases: Sequence[Any]
    measure: Callable[[Any, Options], list[Row]]
    render: Callable[[list[Row]], str] | Mapping[str, str]  # or its columns, by their headings
    repetitions: int = 1
    notes: Callable[[list[Row]], list[str]] = lambda rows: []
    draw: Callable[[list[Row], Path], None] | None = None

    def run(self, options: Options) -> list[Row]:
        """Measure the cases in turns, A B C A B C; `--quick` measures the first alone."""
        chosen = [case for case in self.cases if options.only in getattr(case, "name", case)]
        repetitions = options.repetitions or self.repetitions
        if options.quick:
            chosen, repetitions = chosen[:1], 1
        rows = []
        for repetition in range(repetitions):
            for case in chosen:
                measured = self.measure(case, options)
                for row in measured:
                    values = (f"{key} {value:.4g}" for key, value in row.items() if isinstance(value, float))
                    print(f"{getattr(case, 'name', case)}: {', '.join(values)}", flush=True)
                rows += [{"repetition": repetition, **row} for row in measured]
        return rows

    def table(self, rows: list[Row]) -> str:
        """Return the table, or tables, of these rows in Markdown."""
        return self.render(rows) if callable(self.render) else formatted(rows, self.render)

    def all_notes(self, rows: list[Row], options: Options) -> list[str]:
        """Return what the numbers depend on, a line each."""
        return [*machine(options.lasting(1.0)), *self.notes(rows)]

    def write(self, rows: list[Row], notes: Sequence[str], folder: Path = RESULTS) -> None:
        """Write the rows, the notes and, where there is one, the picture."""
        write_rows(folder / f"{self.name}.csv", rows)
        (folder / f"{self.name}.txt").write_text("".join(f"{note}\n" for note in notes))
        if self.draw:
            self.draw(rows, folder / f"{self.name}.png")

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
