"""Training on a GPU: seed-steps per second by number of seeds, and agreement with the CPU.

CSAC with the presets `paper` and `strong`; csac chooses the number of processes.
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
    """A number of seeds, a preset, and the number of updates per dispatch."""

    seeds: int
    preset: str = "paper"
    interval: int = 1

    @property
    def name(self) -> str:
        """The text that --only searches."""
        return f"{self.seeds} seeds, preset {self.preset}, {self.interval} in one dispatch"


CASES = [*map(Case, (1, 2, 5, 10, 25, 50)), Case(25, interval=10), Case(5, "strong"), Case(25, "strong")]


def measure_speed(case: Case, options: Options) -> list[Row]:
    """Measure the speed of training this many seeds."""
    device = "CPU" if options.device == "cpu" else gpu_name()
    several = ["--update-interval", str(case.interval)] * (case.interval > 1)
    command = csac_command("csac", *several, preset=case.preset, seeds=case.seeds, device=options.device)
    window = options.window()._replace(every=25)
    found = time_training([Launch(command, usable_cores())], window, case.seeds, options.device)
    row = {"device": device, "preset": case.preset, "seeds": case.seeds, "processes": int(found["processes"])}
    row["updates_in_one_dispatch"] = case.interval
    return [{**row, **{column: found[column] for column in ("steps_per_second", "start_seconds", "peak_mib")}}]


def measure_agreement(preset: str, options: Options) -> list[Row]:
    """Make the same updates on GPU and CPU; return nothing if the CPU is measured."""
    return [] if options.device == "cpu" else [_on_gpu(updates=50, preset=preset)]


@functools.cache
def gpu_name() -> str:
    """Return the name of the GPU, as JAX reports it in a separate process. Raises InputError if there is none."""
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
    """Return the GPU's name, and how far CSAC's numbers differ between GPU and CPU after the same updates.

    If JAX cannot use a GPU, `device` is "".
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
    """Return the learnt arrays of two seeds, including optimiser moments, after `updates` updates on this device."""
    import jax

    from benchmarks.updates import HALF_CHEETAH, Driver, make_learner

    with jax.default_device(device):
        driver = Driver(make_learner("csac", seeds=2, preset=preset, replay_size=1_000), seeds=2)
        generator = np.random.default_rng(1)
        for _ in range(updates):
            # Different transitions: if all were equal, a normalised batch would contain only rounding errors.
            before, after = generator.standard_normal((2, 2, HALF_CHEETAH.observation_size), np.float32)
            driver.actions = generator.uniform(-1.0, 1.0, (2, HALF_CHEETAH.action_size)).astype(np.float32)
            driver.make_step(before, generator.standard_normal(2, np.float32), after)
        saved = [driver.learner.save(index).arrays for index in range(2)]
    return {f"{seed} {name}": array for seed, arrays in enumerate(saved) for name, array in arrays.items()}


def largest_difference(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> float:
    """Return the largest absolute difference, relative to the largest absolute value in the same array of `ours`."""
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
