"""Training on a GPU: seed-steps per second against seeds, and whether its numbers are those of the CPU.

CSAC at the settings of the presets `paper` and `strong`, its seeds in as many processes as csac chooses.
"""

from __future__ import annotations

import functools
import os
from typing import Any, NamedTuple

import numpy as np

from benchmarks.measuring import Launch, call, csac_command, time_training, usable_cores
from benchmarks.part import Options, Part
from benchmarks.tables import Row
from csac.types import InputError

PAGE = "benchmarks/README.md"


class Case(NamedTuple):
    """So many seeds at the settings of a preset, with so many updates in one dispatch."""

    seeds: int
    preset: str = "paper"
    interval: int = 1

    @property
    def name(self) -> str:
        """What --only looks in."""
        return f"{self.seeds} seeds, preset {self.preset}, {self.interval} in one dispatch"


CASES = [*map(Case, (1, 2, 5, 10, 25, 50)), Case(25, interval=10), Case(5, "strong"), Case(25, "strong")]


def measure_speed(case: Case, options: Options) -> list[Row]:
    """Train so many seeds for a while."""
    device = "CPU" if options.device == "cpu" else gpu_name()
    several = ["--update-interval", str(case.interval)] * (case.interval > 1)
    command = csac_command("csac", *several, preset=case.preset, seeds=case.seeds, device=options.device)
    window = options.window()._replace(every=25)
    found = time_training([Launch(command, usable_cores())], window, case.seeds, options.device)
    row = {"device": device, "preset": case.preset, "seeds": case.seeds, "processes": int(found["processes"])}
    row["updates_in_one_dispatch"] = case.interval
    return [{**row, **{column: found[column] for column in ("steps_per_second", "start_seconds", "peak_mib")}}]


def measure_agreement(preset: str, options: Options) -> list[Row]:
    """Make the same updates on GPU and CPU; nothing where the CPU is measured."""
    return [] if options.device == "cpu" else [_on_gpu(updates=50, preset=preset)]


@functools.cache
def gpu_name() -> str:
    """Return what the GPU is, which takes a process with JAX to find out. Raises InputError where there is none."""
    return _on_gpu(updates=0, preset="paper")["device"]


def _on_gpu(updates: int, preset: str) -> Row:
    found = call("benchmarks.gpu:compare", device="gpu", updates=updates, preset=preset)
    if not found["device"]:
        raise InputError(
            "there is no GPU that JAX can use: pip install '.[cuda]' in a clone of csac, "
            "or see that it runs with --device cpu --quick"
        )
    return found


def compare(updates: int, preset: str) -> dict[str, Any]:
    """Return which GPU there is, and how far CSAC is there from the CPU after so many updates from the same beginning.

    Where JAX can use no GPU, `device` is "".
    """
    import jax

    from csac.training.devices import FLAGS, multiply_in_float32, with_exact_kernels

    os.environ[FLAGS] = with_exact_kernels(os.environ.get(FLAGS, ""))  # as `csac train --device gpu`
    multiply_in_float32()
    try:
        gpu = jax.devices("gpu")[0]
    except RuntimeError:
        return {"device": ""}
    if not updates:
        return {"device": gpu.device_kind}
    ours, theirs = (learnt(device, updates, preset) for device in (jax.devices("cpu")[0], gpu))
    difference = largest_difference(ours, theirs)
    return {"device": gpu.device_kind, "preset": preset, "updates": updates, "largest_difference": difference}


def learnt(device: Any, updates: int, preset: str) -> dict[str, np.ndarray]:
    """Return all that two seeds have learnt after so many updates on this device, with the optimisers' moments."""
    import jax

    from benchmarks.updates import HALF_CHEETAH, Driver, make_learner

    with jax.default_device(device):
        driver = Driver(make_learner("csac", seeds=2, preset=preset, replay_size=1_000), seeds=2)
        generator = np.random.default_rng(1)
        for _ in range(updates):
            # Transitions that differ: a batch of equal ones is nothing but its rounding errors once it is normalised.
            before, after = generator.standard_normal((2, 2, HALF_CHEETAH.observation_size), np.float32)
            driver.actions = generator.uniform(-1.0, 1.0, (2, HALF_CHEETAH.action_size)).astype(np.float32)
            driver.make_step(before, generator.standard_normal(2, np.float32), after)
        saved = [driver.learner.save(index).arrays for index in range(2)]
    return {f"{seed} {name}": array for seed, arrays in enumerate(saved) for name, array in arrays.items()}


def largest_difference(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> float:
    """Return the largest difference of any number, relative to the largest number in its array of ours."""
    pairs = [(np.asarray(ours[name], np.float64), np.asarray(theirs[name], np.float64)) for name in ours]
    return float(np.max([np.abs(a - b).max(initial=0.0) / (np.abs(a).max(initial=0.0) + 1e-6) for a, b in pairs]))


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
    "start, s": "{start_seconds:.1f}",
    "host memory, MiB": "{peak_mib:,.0f}",
}
PARTS = [
    Part(
        "gpu-agreement",
        PAGE,
        "GPU and CPU after the same updates",
        ["paper", "strong"],
        measure_agreement,
        AGREEMENT_COLUMNS,
    ),
    Part("gpu-speed", PAGE, "seed-steps per second of 1 to 50 seeds", CASES, measure_speed, SPEED_COLUMNS),
]
