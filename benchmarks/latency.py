"""Latency of one action of an exported policy, compared with SB3, on one core."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import NamedTuple

from benchmarks.measuring import ROOT, TASK, Launch, answers, call, usable_cores
from benchmarks.part import Options, Part
from benchmarks.peers import PYTHON
from benchmarks.tables import Row, grouped, table

SCRIPT = ROOT / "benchmarks" / "peers" / "sb3_policy.py"


class Case(NamedTuple):
    """A way to run a policy: one of csac's export formats, or one of SB3's ways."""

    name: str
    format: str = ""
    way: str = ""


LATENCIES = [
    Case("csac, C", "c"),
    Case("csac, ONNX Runtime", "onnx"),
    Case("csac, NumPy", "numpy"),
    Case("SB3's ONNX recipe, ONNX Runtime", way="onnx"),
    Case("SB3's predict, PyTorch", way="predict"),
]


def ask_sb3(way: str, count: int) -> list[Row]:
    """Return the answer of SB3's script; nothing if the peers are not installed."""
    if not Path(PYTHON).exists():
        print(f"SB3, {way}: there is no {PYTHON} (make peers)")
        return []
    command = [PYTHON, str(SCRIPT), "--way", way, "--count", str(count)]
    return answers([Launch(command, usable_cores()[:1])])


def measure_latency(case: Case, options: Options) -> list[Row]:
    """Return latency percentiles of one process, in microseconds."""
    calls = 2_000 if options.quick else 100_000
    if case.way:
        return [{"policy": case.name, **found} for found in ask_sb3(case.way, calls)]
    return [{"policy": case.name, **call("benchmarks.latency:latency", cores=1, format=case.format, calls=calls)}]


def latency(format: str, calls: int) -> dict[str, float]:
    """Export an untrained policy of SAC's size, and return percentiles of single calls in microseconds."""
    import numpy as np

    from csac.cli import main
    from csac.deploy.artefact import open_artefact
    from csac.deploy.latency import measure

    train_briefly()
    main(["export", "run", "--format", format, "--out", "artefact", "--episodes", "0"])
    (found,) = measure(open_artefact("artefact", optimise=True), calls, seconds=0)
    percentiles = np.percentile(found.durations, [50, 99, 99.9, 100], method="higher") / 1e3
    return dict(zip(("p50", "p99", "p99.9", "max"), percentiles.tolist(), strict=True))


def train_briefly() -> None:
    """Train SAC for a few steps into the folder `run`."""
    from csac.cli import main

    words = "--algorithm sac --warmup-steps 250 --steps 260 --evaluation-episodes 1 --directory run"
    main(["train", TASK, *words.split()])


def render_latencies(rows: list[Row]) -> str:
    """Return the medians over repetitions, and each p50 as a multiple of the first policy's."""
    policies = {name: mine for (name,), mine in grouped(rows, "policy").items()}
    first = statistics.median(row["p50"] for row in next(iter(policies.values())))
    lines = []
    for name, mine in policies.items():
        values = [statistics.median(row[column] for row in mine) for column in ("p50", "p99", "p99.9", "max")]
        lines.append([name, *(f"{value:,.1f}" for value in values), f"{values[0] / first:.1f}"])
    return table(["μs for one action", "p50", "p99", "p99.9", "max", "p50, times the first"], lines)


PARTS = [
    Part("latency", "benchmarks/README.md", "one action", LATENCIES, measure_latency, render_latencies, 3),
]
