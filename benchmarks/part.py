"""What all benchmarks share: options, repetitions, a CSV of rows with notes, and a table on a page."""

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
    """The options of the command line; `python -m benchmarks --help` explains them."""

    only: str = ""
    repetitions: int | None = None
    quick: bool = False
    device: str = "gpu"

    def lasting(self, usual: float) -> float:
        """Return how many seconds to measure: `usual`, or less with --quick."""
        return 0.3 if self.quick else usual

    def window(self, usual: float = 5.0) -> Window:
        """Return when training steps are counted."""
        return Window(self.lasting(usual), settled=300 if self.quick else 500)


@dataclass(frozen=True)
class Part:
    """A benchmark with one table: `results/NAME.csv` holds its rows, NAME.txt its notes.

    `measure` returns the rows of a case. A case is a name or an object with an attribute `name`.
    """

    name: str
    page: str
    about: str
    cases: Sequence[Any]
    measure: Callable[[Any, Options], list[Row]]
    render: Callable[[list[Row]], str] | Mapping[str, str]  # a function, or formats of the columns by heading
    repetitions: int = 1
    notes: Callable[[list[Row]], list[str]] = lambda rows: []
    draw: Callable[[list[Row], Path], None] | None = None

    def run(self, options: Options) -> list[Row]:
        """Measure the cases in the order A B C A B C; `--quick` measures only the first case, once."""
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
        """Return the table or tables of these rows in Markdown."""
        return self.render(rows) if callable(self.render) else formatted(rows, self.render)

    def all_notes(self, rows: list[Row], options: Options) -> list[str]:
        """Return what the results depend on, one line each."""
        return [*machine(options.lasting(1.0)), *self.notes(rows)]

    def write(self, rows: list[Row], notes: Sequence[str], folder: Path = RESULTS) -> None:
        """Write the rows, the notes and the picture, if there is one."""
        write_rows(folder / f"{self.name}.csv", rows)
        (folder / f"{self.name}.txt").write_text("".join(f"{note}\n" for note in notes))
        if self.draw:
            self.draw(rows, folder / f"{self.name}.png")

    def block(self, folder: Path = RESULTS) -> str:
        """Return the text for the page: the table of the saved rows, and the notes below it."""
        if not (folder / f"{self.name}.csv").exists():
            return f"Not measured yet: `python -m benchmarks {self.name} --write` puts the table here.\n"
        notes = (folder / f"{self.name}.txt").read_text().splitlines()
        return shown(self.table(read_rows(folder / f"{self.name}.csv")), notes)

    def publish(self, folder: Path = RESULTS, root: Path = ROOT) -> None:
        """Insert the table into its page."""
        page = root / self.page
        page.write_text(between_markers(page.read_text(), self.name, self.block(folder)))


def shown(table: str, notes: Sequence[str]) -> str:
    """Return a table with its notes, in Markdown."""
    return "\n".join([table, "", *(f"- {note}" for note in notes), ""])
