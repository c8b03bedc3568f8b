"""How near training comes to what this machine can multiply.

    make roofline                            # on a quiet machine; writes the table of docs/performance.md
    make roofline ARGS='--repetitions 1'     # a look

The limit is the float32 rate of one core at the product that dominates (256 x 256 x 256), times the cores. It is
measured before and after every other measurement, in a process of its own, since a shared machine's clock wanders; the
better of the two is the limit.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from cases import Case
from products import Product, operations, update_products
from report import table, write_between_markers, write_csv
from speed import Protocol, describe_processor, measure

HERE = Path(__file__).resolve().parent
DOMINANT = Product(256, 256, 256)
SIZES = {
    "forward, hidden layer": DOMINANT,
    "forward, a critic's first layer": Product(256, 23, 256),
    "forward, the actor's last layer": Product(256, 256, 12),
    "forward, a critic's last layer": Product(256, 256, 1),
    "weight gradient, a critic's first layer": Product(23, 256, 256),
}


class Setting(NamedTuple):
    """What is measured; `aim` is the share of the limit that it is to reach, in percent."""

    kind: str  # "update alone", "training" or "training, evaluation on"
    algorithm: str
    seeds: int = 1
    cores: int = 2
    interval: int = 1
    aim: int = 0

    @property
    def name(self) -> str:
        """What the table calls it."""
        parts = [self.kind, "one seed" if self.seeds == 1 else f"{self.seeds} seeds"]
        parts.append("1 core" if self.cores == 1 else f"{self.cores} cores")
        return ", ".join(parts + [f"{self.interval} updates in one dispatch"] * (self.interval > 1))


SETTINGS = [
    *(Setting("update alone", name, cores=1) for name in ("csac", "sac", "td3", "sd3")),
    *(Setting("update alone", name) for name in ("csac", "sac", "td3", "sd3")),
    *(Setting("update alone", name, interval=10) for name in ("csac", "sac", "td3")),
    Setting("training", "csac", cores=1),
    Setting("training", "csac", aim=60),
    Setting("training", "csac", interval=10),
    Setting("training", "csac", seeds=5, aim=72),
    Setting("training, evaluation on", "csac"),
    Setting("training, evaluation on", "csac", seeds=5),
]


class Measured(NamedTuple):
    """One measurement, and the one-core rates around it."""

    repetition: int
    setting: str
    algorithm: str
    cores: int
    updates_per_second: float
    giga_operations_per_update: float
    one_core_rate: float  # giga-operations per second, the better of before and after

    @property
    def share(self) -> float:
        """Of the limit."""
        return self.updates_per_second * self.giga_operations_per_update / (self.cores * self.one_core_rate)


def one_core_rate() -> float:
    """Return giga-operations per second of the dominant product on the first processor."""
    return product_rates([DOMINANT], [_cores(1)])[0][DOMINANT] / 1e9


def product_rates(sizes: list[Product], groups: list[list[int]], seconds: float = 1.0) -> list[dict[Product, float]]:
    """Return operations per second of each size in each of several processes, side by side on these processors."""
    names = [",".join(map(str, size)) for size in sizes]
    command = [sys.executable, str(HERE / "products.py"), "--seconds", str(seconds)]
    processes = [
        subprocess.Popen(
            [*command, "--cores", ",".join(map(str, cores)), *names],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
        )
        for cores in groups
    ]
    answers = [json.loads(process.communicate()[0]) for process in processes]
    return [dict(zip(sizes, map(answer.get, names), strict=True)) for answer in answers]


def updates_per_second(setting: Setting, repetition: int, protocol: Protocol) -> float:
    """Measure one setting."""
    if setting.kind == "update alone":
        cores = ",".join(map(str, _cores(setting.cores)))
        command = [sys.executable, HERE / "update_speed.py", "--cores", cores, "--algorithm", setting.algorithm]
        command += ["--interval", str(setting.interval), "--seconds", str(protocol.seconds)]
        with tempfile.TemporaryDirectory() as folder:
            result = subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder)
        return json.loads(result.stdout.splitlines()[-1])["updates_per_second"]
    evaluated = setting.kind == "training, evaluation on"
    case = Case(
        setting.name,
        "csac",
        "csac",
        setting.algorithm,
        seeds=setting.seeds,
        cores=setting.cores,
        evaluated=evaluated,
        interval=setting.interval,
    )
    return measure(case, repetition, protocol).steps_per_second


def report(measurements: list[Measured], products: list[list[str]], machine: str) -> str:
    """Return both tables in Markdown."""
    rows = []
    for setting in SETTINGS:
        mine = [m for m in measurements if (m.setting, m.algorithm) == (setting.name, setting.algorithm)]
        if not mine:
            continue
        shares = [100 * m.share for m in mine]
        spread = f" ({min(shares):.0f} to {max(shares):.0f})" if len(shares) > 1 else ""
        rows.append(
            [
                setting.name,
                setting.algorithm.upper(),
                f"{statistics.median(m.updates_per_second for m in mine):.0f}",
                f"{mine[0].giga_operations_per_update:.2f}",
                f"{statistics.median(shares):.0f} %{spread}",
                f"{setting.aim} %" if setting.aim else "",
            ]
        )
    head = ["", "algorithm", "updates/s", "10⁹ operations in one", "share of the limit", "aim"]
    rate = statistics.median(m.one_core_rate for m in measurements)
    said = f"One core multiplies 256 x 256 x 256 at {rate:.0f} x 10⁹ operations/s (median of all repetitions)"
    product_table = table(["product", "1 core", "2 cores, one process", "2 cores, a process on each"], products)
    return f"{table(head, rows)}\n\n{product_table}\n\n{said}; {machine}.\n"


def product_rows() -> list[list[str]]:
    """Measure the products that occur, in 10⁹ operations per second."""
    first, second = _cores(2)
    sizes = list(SIZES.values())
    alone, together = product_rates(sizes, [[first]])[0], product_rates(sizes, [[first, second]])[0]
    beside = product_rates(sizes, [[first], [second]])
    return [
        [
            f"{name}: {size.rows} x {size.inner} x {size.columns}",
            *(f"{value / 1e9:.0f}" for value in (alone[size], together[size], sum(one[size] for one in beside))),
        ]
        for name, size in SIZES.items()
    ]


def _cores(number: int) -> list[int]:
    return sorted(os.sched_getaffinity(0))[:number]


def main() -> None:
    """Measure, print and, where asked, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for roofline.csv")
    parser.add_argument("--page", type=Path, help="Markdown file whose marked part becomes the table")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--only", default="", help="measure the settings whose name contains this")
    arguments = parser.parse_args()
    if not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2:
        sys.exit("the benchmark needs Linux and two processors")
    settings = [setting for setting in SETTINGS if arguments.only in f"{setting.name} {setting.algorithm}"]
    if not settings:
        sys.exit(f"no setting contains {arguments.only!r}")
    protocol, measurements = Protocol(seconds_of_five=30), []  # five seeds take turns of a second and more
    for repetition in range(arguments.repetitions):
        before = one_core_rate()
        for setting in settings:
            speed, after = updates_per_second(setting, repetition, protocol), one_core_rate()
            cost = operations(update_products(setting.algorithm)) / 1e9
            rate, before = max(before, after), after
            measured = Measured(repetition, setting.name, setting.algorithm, setting.cores, speed, cost, rate)
            measurements.append(measured)
            share = f"{100 * measured.share:.0f} % of the limit (one core {rate:.0f} x 10^9 operations/s)"
            print(f"{setting.name}, {setting.algorithm}: {speed:.1f} updates/s, {share}", flush=True)
    text = report(measurements, product_rows(), describe_processor())
    print(f"\n{text}")
    if arguments.out:
        write_csv(arguments.out / "roofline.csv", measurements)
    if arguments.page:
        write_between_markers(arguments.page, text, "roofline")


if __name__ == "__main__":
    main()
