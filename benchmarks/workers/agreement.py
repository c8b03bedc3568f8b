"""Which GPU there is, and whether its numbers are those of the CPU."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from benchmarks.driver import Driver, make_learner


def measure(updates: int) -> dict[str, Any]:
    """Return which GPU there is, and how far it is from the CPU after so many updates from the same beginning.

    The difference is relative to the size of each parameter array, and the largest of all. Where JAX can use no GPU,
    `device` is "".
    """
    try:
        gpu = jax.devices("gpu")[0]
    except RuntimeError:
        return {"device": ""}
    if not updates:
        return {"device": gpu.device_kind}
    pairs = zip(*(_parameters(device, updates) for device in (jax.devices("cpu")[0], gpu)), strict=True)
    difference = max(float(np.abs(ours - theirs).max() / (np.abs(ours).max() + 1e-6)) for ours, theirs in pairs)
    return {"device": gpu.device_kind, "updates": updates, "largest_difference": difference}


def _parameters(device: Any, updates: int) -> list[np.ndarray]:
    with jax.default_device(device):
        driver = Driver(make_learner("csac", seeds=2, replay_size=1_000), seeds=2)
        for _ in range(updates):
            driver.step += 1
            driver.learner.step(driver.observations, np.zeros((2, 6), np.float32), driver.outcome, driver.step)
        return [np.asarray(leaf) for leaf in jax.tree.leaves(driver.learner.networks())]
