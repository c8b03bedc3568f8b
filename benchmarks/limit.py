"""How close training comes to the arithmetic limit of this machine.

The limit is the float32 rate of one core for the dominant matrix product (256 x 256 x 256), times the number of cores.
It is measured before and after every other measurement, because the clock of a shared machine varies; the higher of the
two rates counts.
"""

from __future__ import annotations

import statistics
from typing import NamedTuple

from benchmarks.measuring import Launch, call, csac_command, one_core_rate, product_rates, time_training, usable_cores
from benchmarks.part import Options, Part
from benchmarks.products import DOMINANT, Product, operations, update_products
from benchmarks.tables import Row, grouped, table, with_range

PAGE = "benchmarks/limit.md"
PRODUCTS = {
    "forward, hidden layer": DOMINANT,
    "forward, a critic's first layer": Product(256, 23, 256),
    "forward, the actor's last layer": Product(256, 256, 12),
    "forward, a critic's last layer": Product(256, 256, 1),
    "weight gradient, a critic's first layer": Product(23, 256, 256),
}


class Setting(NamedTuple):
    """What to measure."""

    kind: str  # "update alone" or "training"
    algorithm: str
    seeds: int = 1
    cores: int = 2
    interval: int = 1

    @property
    def title(self) -> str:
        """The name in the table."""
        parts = [self.kind, "one seed" if self.seeds == 1 else f"{self.seeds} seeds"]
        parts.append("1 core" if self.cores == 1 else f"{self.cores} cores")
        return ", ".join(parts + [f"{self.interval} updates in one dispatch"] * (self.interval > 1))

    @property
    def name(self) -> str:
        """The text that --only searches."""
        return f"{self.title} {self.algorithm}"


SETTINGS = [
    *(Setting("update alone", name, cores=1) for name in ("csac", "sac", "td3", "sd3")),
    *(Setting("update alone", name) for name in ("csac", "sac", "td3", "sd3")),
    *(Setting("update alone", name, interval=10) for name in ("csac", "sac", "td3")),
    Setting("training", "csac", cores=1),
    Setting("training", "csac"),
    Setting("training", "csac", interval=10),
    Setting("training", "csac", seeds=5),
]


def measure_share(setting: Setting, options: Options) -> list[Row]:
    """Measure one setting, and the rate of one core before and after it."""
    before = one_core_rate(options.lasting(1.0))
    speed = updates_per_second(setting, options)
    row = {
        "setting": setting.title,
        "algorithm": setting.algorithm,
        "cores": setting.cores,
        "updates_per_second": speed,
        "giga_operations_per_update": operations(update_products(setting.algorithm)) / 1e9,
        "one_core_rate": max(before, one_core_rate(options.lasting(1.0))),  # giga-operations per second
    }
    return [row]


def updates_per_second(setting: Setting, options: Options) -> float:
    """Measure the updates per second of one setting."""
    if setting.kind == "update alone":
        settings = {"algorithm": setting.algorithm, "interval": setting.interval}
        found = call("benchmarks.updates:measure", setting.cores, seconds=options.lasting(5.0), **settings)
        return found["updates_per_second"]
    several = ["--update-interval", str(setting.interval)] * (setting.interval > 1)
    launch = Launch(csac_command(setting.algorithm, *several, seeds=setting.seeds), usable_cores()[: setting.cores])
    window = options.window(30.0 if setting.seeds > 1 else 5.0)
    return time_training([launch], window, setting.seeds)["steps_per_second"]


def share(row: Row) -> float:
    """Return the share of the limit, in percent."""
    limit = row["cores"] * row["one_core_rate"]
    return 100 * row["updates_per_second"] * row["giga_operations_per_update"] / limit


def render_shares(rows: list[Row]) -> str:
    """Return a row for each setting, and the measured rate of one core."""
    lines = [
        [
            *(setting, algorithm.upper()),
            f"{statistics.median(row['updates_per_second'] for row in mine):.0f}",
            f"{mine[0]['giga_operations_per_update']:.2f}",
            with_range([share(row) for row in mine], ".0f", " %"),
        ]
        for (setting, algorithm), mine in grouped(rows, "setting", "algorithm").items()
    ]
    rate = statistics.median(row["one_core_rate"] for row in rows)
    said = f"One core multiplied 256 x 256 x 256 at {rate:.0f} x 10⁹ operations/s (median of all repetitions)."
    head = ["", "algorithm", "updates/s", "10⁹ operations in one", "share of the limit"]
    return f"{table(head, lines)}\n\n{said}"


def measure_rate(name: str, options: Options) -> list[Row]:
    """Measure the rate of one matrix product, in 10⁹ operations per second."""
    first, second = usable_cores()[:2]
    groups = {"one_core": [[first]], "two_cores": [[first, second]], "a_process_on_each": [[first], [second]]}
    rates = {
        column: sum(product_rates(PRODUCTS[name], cores, options.lasting(1.0))) / 1e9
        for column, cores in groups.items()
    }
    return [{"product": name, "size": " x ".join(map(str, PRODUCTS[name])), **rates}]


RATE_COLUMNS = {
    "product": "{product}: {size}",
    "1 core": "{one_core:.0f}",
    "2 cores, one process": "{two_cores:.0f}",
    "2 cores, a process on each": "{a_process_on_each:.0f}",
}

PARTS = [
    Part("limit-share", PAGE, "updates and training beside the limit", SETTINGS, measure_share, render_shares, 3),
    Part("limit-products", PAGE, "how fast matrix products are", list(PRODUCTS), measure_rate, RATE_COLUMNS),
]
