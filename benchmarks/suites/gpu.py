"""Training on a GPU: seed-steps per second against seeds, and whether its numbers are those of the CPU.

What runs is `csac.train` on HalfCheetah-v4 with evaluation off: CSAC at the paper's settings, or those of the preset
`strong`. The seeds are in one program, or split over those of several processes. The replay is on the device, and
there is one dispatch for each environment step of a program's seeds, or for ten.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

from benchmarks.measuring import run_one, training, worker
from benchmarks.parts import Options, Part
from benchmarks.tables import Row, formatted
from csac.types import InputError

PAGE = "docs/gpu.md"
PRESETS = ["paper", "strong"]
AIMS = {5: "10,000", 25: "25,000"}  # seed-steps per second on an H200


class Seeds(NamedTuple):
    """So many seeds, the processes that they are split over, and the updates in one dispatch."""

    seeds: int
    groups: int = 1
    interval: int = 1
    preset: str = "paper"

    @property
    def name(self) -> str:
        """What --only looks in."""
        return f"{self.seeds} seeds, processes {self.groups}, {self.interval} in one dispatch, preset {self.preset}"


def measure_agreement(preset: str, options: Options) -> list[Row]:
    """Make the same updates on GPU and CPU; nothing where the CPU is measured."""
    return [] if options.device == "cpu" else [on_gpu(updates=50, preset=preset)]


def measure_speed(case: Seeds, options: Options) -> list[Row]:
    """Train so many seeds for a while."""
    device = "CPU" if options.device == "cpu" else gpu_name()
    window = options.window(5.0)._replace(settled=260)
    command = training(
        "csac",
        window,
        seeds=case.seeds,
        interval=case.interval,
        device=options.device,
        preset=case.preset,
        groups=case.groups,
    )
    found = run_one(command, device=options.device)
    row = {
        "device": device,
        "preset": case.preset,
        "seeds": case.seeds,
        "processes": case.groups,
        "updates_in_one_dispatch": case.interval,
    }
    return [{**row, **{column: found[column] for column in ("steps_per_second", "start_seconds", "peak_mib")}}]


@functools.cache
def gpu_name() -> str:
    """Return what the GPU is, which takes a process with JAX to find out. Raises InputError as `on_gpu` does."""
    return on_gpu(updates=0)["device"]


def on_gpu(updates: int, preset: str = "paper") -> Row:
    """Return what the GPU is, and how far it is from the CPU after so many updates.

    Raises:
        InputError: there is none that JAX can use.
    """
    found = run_one(worker("agreement", updates=updates, preset=preset), device="gpu")
    if not found["device"]:
        raise InputError(
            "there is no GPU that JAX can use: pip install '.[cuda]' in a clone of csac, "
            "or see that it runs with --device cpu --quick"
        )
    return found


AGREEMENT_COLUMNS = {
    "GPU": "{device}",
    "preset": "{preset}",
    "updates": "{updates}",
    "largest difference to the CPU": "{largest_difference:.1e}",
}
SPEED_COLUMNS = {
    "device": "{device}",
    "preset": "{preset}",
    "seeds": "{seeds}",
    "processes": "{processes}",
    "updates in one dispatch": "{updates_in_one_dispatch}",
    "seed-steps/s": "{steps_per_second:,.0f}",
    "aim (H200)": "{aim}",
    "start, s": "{start_seconds:.1f}",
    "host memory, MiB": "{peak_mib:,.0f}",
}


def render_speed(rows: list[Row]) -> str:
    """Return a row for each number of seeds, processes and updates in one dispatch."""
    return formatted([{**row, "aim": _aim(row)} for row in rows], SPEED_COLUMNS)


def _aim(row: Row) -> str:
    """Return what is aimed at; an aim is for the paper's settings in strict order, one update in a dispatch."""
    is_aimed_at = row["preset"] == "paper" and row["updates_in_one_dispatch"] == 1
    return AIMS.get(row["seeds"], "") if is_aimed_at else ""


CASES = [Seeds(seeds) for seeds in (1, 2, 5, 10, 25)]
CASES += [Seeds(seeds, groups) for seeds, groups in ((10, 2), (25, 4), (50, 4))]
CASES += [Seeds(25, interval=10), Seeds(5, preset="strong"), Seeds(25, 4, preset="strong")]
PARTS = [
    Part("gpu-agreement", PAGE, "GPU and CPU after the same updates", PRESETS, measure_agreement, AGREEMENT_COLUMNS),
    Part("gpu-speed", PAGE, "seed-steps per second of 1 to 50 seeds", CASES, measure_speed, render_speed),
]
