"""What is told of an export: where each artefact is, how exact it is, how well it does, how much room it takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from csac.console.tables import Fitted, number
from csac.record.rendering import Cell, Row, Table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.evaluation.export import Exported
    from csac.evaluation.verify import Returns

FORMATS = {"numpy": "NumPy", "onnx": "ONNX", "c": "C"}


def export_lines(exported: Exported) -> list[str]:
    """Return the lines that tell of one artefact."""
    contract, compared = exported.contract, exported.compared
    by_kind = ", ".join(f"{result.name} {result.largest:.1e}" for result in compared)
    count, largest = sum(result.observations for result in compared), max(result.largest for result in compared)
    lines = [
        f"{FORMATS[contract.format]}: {exported.place}",
        f"  {count:,} observations: actions differ by at most {largest:.1e} of their range ({by_kind})",
    ]
    if contract.weights != "float32":
        mean = max(result.mean for result in compared)
        lines.append(f"  {contract.weights} weights: by at most {mean:.1e} of the range on average")
    told = _returns_line(exported.returns) if exported.returns else "not run in closed loop"
    return [*lines, f"  {told}"]


def size_table(exported: Sequence[Exported]) -> Fitted | None:
    """Return what a C artefact takes, in bytes; None where there is none, or nothing here to measure it with."""
    sizes = [size for one in exported for size in one.sizes]
    if not sizes:
        return None
    rows = [Row((Cell(size.target), *(Cell(f"{count:,}", count) for count in size[1:]))) for size in sizes]
    return Fitted(Table(("C, bytes", "code", "constants", "data", "stack at most"), tuple(rows)))


def _returns_line(returns: Returns) -> str:
    largest = float(max(abs(returns.policy).max(), abs(returns.artefact).max()))
    through, without = (
        f"{number(values.mean(), largest)} ± {number(values.std(ddof=min(1, len(values) - 1)), largest)}"
        for values in (returns.artefact, returns.policy)
    )
    episodes = f"{len(returns.policy)} episode{'s' * (len(returns.policy) != 1)}"
    return f"{episodes}: mean return {through}; the run's policy {without}"
