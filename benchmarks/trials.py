"""Other ways to do the same update, measured in turns against csac's own: what pays, and what does not.

    python benchmarks/trials.py                     # all cores
    taskset --cpu-list 0 python benchmarks/trials.py --algorithm td3

All variants live in one process and take turns, a fifth of a second each, so that a machine whose clock wanders treats
them alike. A ratio above 1 is faster than csac's own.
"""

from __future__ import annotations

import argparse
import importlib
import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
from report import table
from update_speed import Driver, make_learner

from csac.algorithms import critics, networks
from csac.training import learner
from csac.types import Spec

OWN_MAKE_CRITICS, OWN_CALL, OWN_NORMAL = critics.make_critics, networks.MLP.__call__, jax.random.normal


def stacked_make_critics(*arguments: Any) -> Any:
    """Return both critics as one network whose arrays have a leading axis of two."""
    return jax.tree.map(lambda first, second: jnp.stack([first, second]), *OWN_MAKE_CRITICS(*arguments))


def stacked_q_values(stacked: Any, observation: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return both values out of one batched product for each layer."""
    inputs = jnp.concatenate([observation, action])
    values = jax.vmap(lambda critic: critic(inputs)[0])(stacked)
    return values[0], values[1]


def bfloat16_call(self: networks.MLP, inputs: jax.Array) -> jax.Array:
    """Run the network with bfloat16 operands in its hidden products, summed in float32; gradients stay in float32."""
    for number, layer in enumerate(self.layers):
        if min(layer.weight.shape) >= 128:
            left, right = inputs.astype(jnp.bfloat16), layer.weight.astype(jnp.bfloat16)
            inputs = jax.lax.dot(left, right, preferred_element_type=jnp.float32) + layer.bias
        else:
            inputs = inputs @ layer.weight + layer.bias
        if number < len(self.layers) - 1:
            inputs = jax.nn.relu(inputs)
    return inputs


def kept_normal(key: jax.Array, shape: tuple[int, ...] = (), *_: Any) -> jax.Array:
    """Return normal numbers computed once: XLA computes them again in every operation that uses them, but no product.

    `jax.lax.optimization_barrier` does not keep it from that: for the CPU it is taken out before operations are fused.
    """
    noise = OWN_NORMAL(key, shape)
    return jnp.matmul(noise, jnp.eye(shape[-1]), precision="highest") if len(shape) > 1 else noise


@contextmanager
def patched(**functions: Callable) -> Iterator[None]:
    """Replace functions wherever the algorithms have imported them."""
    modules = [importlib.import_module(f"csac.algorithms.{name}") for name in ("critics", "csac", "sac", "td3", "sd3")]
    before = [
        (module, name, getattr(module, name)) for module in modules for name in functions if hasattr(module, name)
    ]
    for module, name, _ in before:
        setattr(module, name, functions[name])
    try:
        yield
    finally:
        for module, name, function in before:
            setattr(module, name, function)


@contextmanager
def with_attribute(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Replace one attribute."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


TRIALS: dict[str, tuple[Callable, dict[str, Any]]] = {
    "csac's own": (patched, {}),
    "10 updates in one dispatch": (patched, {"update_interval": 10}),
    "both critics in one batched product": (
        lambda: patched(make_critics=stacked_make_critics, q_values=stacked_q_values),
        {},
    ),
    "bfloat16 operands in forward products": (lambda: with_attribute(networks.MLP, "__call__", bfloat16_call), {}),
    "noise computed once": (lambda: with_attribute(jax.random, "normal", kept_normal), {}),
    "a buffer for every array": (lambda: with_attribute(learner, "SMALL", 0), {}),
}


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithm", choices=("csac", "sac", "td3"), default="csac")
    parser.add_argument("--seconds", type=float, default=60.0, help="for all variants together")
    arguments = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    drivers = {}
    for name, (patch, changes) in TRIALS.items():
        with patch():
            drivers[name] = Driver(make_learner(arguments.algorithm, Spec(17, 6), replay_size=100_000, **changes))
            drivers[name].run(0.2)  # traced and compiled while the patch holds
    speeds: dict[str, list[float]] = {name: [] for name in TRIALS}
    until = time.monotonic() + arguments.seconds
    while time.monotonic() < until:
        for name, driver in drivers.items():
            speeds[name].append(driver.run(0.2))
    own = speeds["csac's own"]
    rows = []
    for name, mine in speeds.items():
        ratios = sorted(ours / base for ours, base in zip(mine, own, strict=True))
        quarter = len(ratios) // 4
        rows.append(
            [
                name,
                f"{statistics.median(mine):.0f}",
                f"{statistics.median(ratios):.2f} ({ratios[quarter]:.2f} to {ratios[-1 - quarter]:.2f})",
            ]
        )
    print(table([f"{arguments.algorithm}, {_cores()}", "updates/s", "to csac's own (middle half)"], rows))


def _cores() -> str:
    count = len(os.sched_getaffinity(0))
    return "1 core" if count == 1 else f"{count} cores"


if __name__ == "__main__":
    main()
