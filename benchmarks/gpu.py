"""Training on a GPU: seed-steps per second against seeds, and whether its numbers are those of the CPU.

    pip install 'csac[cuda]'
    python benchmarks/gpu.py --out benchmarks           # one GPU; writes gpu.csv
    python benchmarks/gpu.py --device cpu --quick       # does it run, without a GPU?

What runs is `csac.train` on HalfCheetah-v4 with evaluation off, at the paper's settings: all seeds in one program, the
replay on the device, one dispatch for each environment step of all seeds, or for ten.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from cases import Case
from report import table, write_csv
from speed import Protocol, measure
from update_speed import Driver, make_learner

from csac.types import Spec

SEEDS = [1, 2, 5, 10, 25, 50]
INTERVALS = [1, 10]
AIMS = {5: 10_000, 25: 25_000}  # seed-steps per second on an H200


class Point(NamedTuple):
    """One measurement: seed-steps per second is environment steps, each with its update, of all seeds together."""

    seeds: int
    updates_in_one_dispatch: int
    seed_steps_per_second: float
    start_seconds: float
    peak_mib: float  # of the host


def measured(seeds: int, interval: int, device: str, protocol: Protocol) -> Point:
    """Train so many seeds for a while."""
    case = Case(f"{seeds} seeds", "csac", "csac", "csac", seeds=seeds, interval=interval, device=device)
    result = measure(case, 0, protocol)
    return Point(seeds, interval, result.steps_per_second, result.start_seconds, result.peak_mib)


def largest_difference(steps: int = 200) -> float:
    """Return how far apart CPU and GPU are after so many updates, relative to the size of each parameter array."""
    parameters = []
    for device in (jax.devices("cpu")[0], jax.devices("gpu")[0]):
        with jax.default_device(device):
            driver = Driver(make_learner("csac", Spec(17, 6), seeds=2, replay_size=1_000), seeds=2)
            for _ in range(steps):
                driver.step += 1
                driver.learner.step(driver.observations, np.zeros((2, 6), np.float32), driver.outcome, driver.step)
            parameters.append([np.asarray(leaf) for leaf in jax.tree.leaves(driver.learner.networks())])
    pairs = zip(*parameters, strict=True)
    return max(float(np.abs(ours - theirs).max() / (np.abs(ours).max() + 1e-6)) for ours, theirs in pairs)


def main() -> None:
    """Measure, print and, where asked, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("gpu", "cpu"), default="gpu")
    parser.add_argument("--out", type=Path, help="folder for gpu.csv")
    parser.add_argument("--quick", action="store_true", help="one and two seeds for a second, to see that it runs")
    arguments = parser.parse_args()
    if arguments.device == "gpu":
        try:
            print(f"{jax.devices('gpu')[0].device_kind}: largest difference to the CPU {largest_difference():.1e}")
        except RuntimeError:
            sys.exit("no GPU that JAX can use: install csac[cuda], or see that it runs with --device cpu --quick")
    seconds = 1.0 if arguments.quick else 10.0
    protocol = Protocol(repetitions=1, settled=260, seconds=seconds, seconds_of_five=seconds)
    points = []
    for interval in INTERVALS:
        for seeds in SEEDS[:2] if arguments.quick else SEEDS:
            points.append(measured(seeds, interval, arguments.device, protocol))
            print(f"{seeds} seeds, {interval} in one dispatch: {points[-1].seed_steps_per_second:,.0f}/s", flush=True)
    head = ["seeds", "updates in one dispatch", "seed-steps/s", "aim", "start, s", "host memory, MiB"]
    rows = [
        [
            str(point.seeds),
            str(point.updates_in_one_dispatch),
            f"{point.seed_steps_per_second:,.0f}",
            f"{AIMS[point.seeds]:,}" if point.seeds in AIMS else "",
            f"{point.start_seconds:.1f}",
            f"{point.peak_mib:,.0f}",
        ]
        for point in points
    ]
    print(f"\n{table(head, rows)}")
    if arguments.out and not arguments.quick:
        write_csv(arguments.out / "gpu.csv", points)


if __name__ == "__main__":
    main()
