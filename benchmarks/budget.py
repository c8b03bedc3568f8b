"""Where the time of one update goes, by kind of operation: what JAX's profiler says of the compiled program.

    taskset --cpu-list 0 python benchmarks/budget.py --algorithm sac

On one core the operations follow each other, so that their times add up. Tracing makes each of them a little slower.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import time
from collections import Counter
from pathlib import Path

import jax
from report import table
from update_speed import Driver, make_learner

from csac.types import Spec

KINDS = {  # the first that matches; XLA names a fused operation after what it ends with
    "products": r"ynn_fusion|dot",
    "activations and their gradients": r".*maximum|compare_select|multiply_select",
    "Adam and target networks": r"multiply_add|.*sqrt_fusion|.*divide",
    "random numbers": r"while|call|xor|.*shift|.*slice|broadcast_add",
    "the draw from the replay": r".*gather",
    "copies": r"copy",
    "losses, distributions and the rest": r"[a-z_-]+_(fusion|reduce)|wrapped|reduce|convert|tanh|exponential",
}
UPDATES = 100


def traced(driver: Driver) -> Counter[str]:
    """Return the microseconds of each operation in one update, by name."""
    options = jax.profiler.ProfileOptions()
    options.host_tracer_level, options.python_tracer_level = 3, 0
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder, profiler_options=options):
            steps(driver, UPDATES)
        (path,) = Path(folder).rglob("*.xplane.pb")
        profile = jax.profiler.ProfileData.from_file(str(path))
    times: Counter[str] = Counter()
    for plane in profile.planes:
        for line in plane.lines:
            for event in line.events:
                times[event.name] += event.duration_ns / 1000 / UPDATES
    return times


def steps(driver: Driver, number: int) -> float:
    """Make so many updates and return the microseconds of each."""
    began = time.perf_counter()
    for _ in range(number):
        driver.step += 1
        driver.learner.step(driver.observations, driver.actions, driver.outcome, driver.step)
    return (time.perf_counter() - began) / number * 1e6


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithm", choices=("csac", "sac", "td3", "sd3"), default="csac")
    arguments = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    driver = Driver(make_learner(arguments.algorithm, Spec(17, 6), replay_size=100_000))
    driver.run(1.0)
    whole = min(steps(driver, UPDATES) for _ in range(5))
    sums, calls = Counter(), Counter()
    for name, time_taken in traced(driver).items():
        kind = next((kind for kind, pattern in KINDS.items() if re.match(pattern, name)), None)
        if kind:
            sums[kind] += time_taken
            calls[kind] += 1
    rows = [[kind, f"{sums[kind]:.0f}", f"{sums[kind] / sum(sums.values()):.0%}", str(calls[kind])] for kind in KINDS]
    print(table(["operations", "μs in one update, traced", "share", "distinct operations"], rows))
    print(f"\none update without tracing: {whole:.0f} μs; the operations traced: {sum(sums.values()):.0f} μs")


if __name__ == "__main__":
    main()
