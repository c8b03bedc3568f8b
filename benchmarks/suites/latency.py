"""How long a policy takes for one action: csac's artefacts, and SB3's two ways, in turns, on one core."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import NamedTuple

from benchmarks.contenders import PEERS_PYTHON
from benchmarks.measuring import ROOT, run_one, worker
from benchmarks.parts import Options, Part
from benchmarks.tables import Row, grouped, table

SCRIPT = ROOT / "benchmarks" / "peers" / "sb3_latency.py"


class Case(NamedTuple):
    """A way to ask a policy for an action: a format of csac's, or one of SB3's ways."""

    name: str
    format: str = ""
    way: str = ""


CASES = [
    Case("csac, C", "c"),
    Case("csac, ONNX Runtime", "onnx"),
    Case("csac, NumPy", "numpy"),
    Case("SB3's ONNX recipe, ONNX Runtime", way="onnx"),
    Case("SB3's predict, PyTorch", way="predict"),
]


def measure_latency(case: Case, options: Options) -> list[Row]:
    """Return the percentiles of one process; nothing where there are no peers."""
    calls = 2_000 if options.quick else 100_000
    if case.way and not Path(PEERS_PYTHON).exists():
        print(f"{case.name}: there is no {PEERS_PYTHON} (make peers)")
        return []
    command = worker("latency", format=case.format, calls=calls)
    if case.way:
        command = [PEERS_PYTHON, str(SCRIPT), "--way", case.way, "--calls", str(calls)]
    return [{"policy": case.name, **run_one(command, cores=1)}]


def render_latencies(rows: list[Row]) -> str:
    """Return the medians over repetitions, and how many times csac's artefact in C is faster."""
    policies = {name: mine for (name,), mine in grouped(rows, "policy").items()}
    first = statistics.median(row["p50"] for row in next(iter(policies.values())))
    lines = []
    for name, mine in policies.items():
        values = [statistics.median(row[column] for row in mine) for column in ("p50", "p99", "p99.9", "max")]
        lines.append([name, *(f"{value:,.1f}" for value in values), f"{values[0] / first:.1f}"])
    return table(["μs for one action", "p50", "p99", "p99.9", "max", "p50, times the first"], lines)


PARTS = [
    Part("latency", "docs/deploy.md", "one action, beside SB3's", CASES, measure_latency, render_latencies, 3),
]
