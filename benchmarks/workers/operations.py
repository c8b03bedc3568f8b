"""Where the time of one update goes, by kind of operation: what JAX's profiler says of the compiled program.

On one core the operations follow each other, so that their times add up. Tracing makes each of them a little slower.
"""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import jax

from benchmarks.driver import Driver, make_learner

KINDS = {  # the first that matches; XLA names a fused operation after what it ends with
    "products": r"ynn_fusion|dot",
    "activations and their gradients": r".*maximum|compare_select|multiply_select",
    "Adam and target networks": r"multiply_add|.*sqrt_fusion|.*divide",
    "random numbers": r"while|call|xor|.*shift|.*slice|broadcast_add",
    "the draw from the replay": r".*gather",
    "copies": r"copy",
    "losses, distributions and the rest": r"[a-z_-]+_(fusion|reduce)|wrapped|reduce|convert|tanh|exponential",
}


def measure(algorithm: str, seconds: float, updates: int) -> dict[str, list[dict[str, Any]]]:
    """Return a row for each kind of operation: microseconds and number, beside those of an untraced update."""
    driver = Driver(make_learner(algorithm, replay_size=100_000))
    driver.run(seconds)
    whole = min(driver.make(updates) for _ in range(5)) / updates * 1e6
    microseconds, counts = Counter(), Counter()
    for name, time_taken in _traced(driver, updates).items():
        if kind := next((kind for kind, pattern in KINDS.items() if re.match(pattern, name)), None):
            microseconds[kind] += time_taken
            counts[kind] += 1
    columns = ("algorithm", "kind", "microseconds", "operations", "update_microseconds")
    rows = [(algorithm, kind, float(microseconds[kind]), counts[kind], whole) for kind in KINDS]
    return {"rows": [dict(zip(columns, row, strict=True)) for row in rows]}


def _traced(driver: Driver, updates: int) -> Counter[str]:
    """Return the microseconds of each operation in one update, by name."""
    options = jax.profiler.ProfileOptions()
    options.host_tracer_level, options.python_tracer_level = 3, 0
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder, profiler_options=options):
            driver.make(updates)
        (path,) = Path(folder).rglob("*.xplane.pb")
        profile = jax.profiler.ProfileData.from_file(str(path))
    times: Counter[str] = Counter()
    for plane in profile.planes:
        for line in plane.lines:
            for event in line.events:
                times[event.name] += event.duration_ns / 1000 / updates
    return times
