"""How fast matrix products are on the processors that this process may use."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from benchmarks.operations import Product

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

TOGETHER = 20  # products in one dispatch: a single one would be over before the clock can tell
WINDOWS = 10


def measure(size: Sequence[int], seconds: float) -> dict[str, float]:
    """Return operations per second of a product of this size, measured for so long.

    It is a limit, so everything is in its favour: the same operands again and again, which stay in the caches, and of
    ten windows the best, for what one loses to others on a shared machine does not count.
    """
    product = Product(*size)
    multiply, windows = _multiplying(product), []
    for _ in range(WINDOWS):
        calls, began = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - began) < seconds / WINDOWS:
            multiply()
            calls += 1
        windows.append(calls * TOGETHER * product.operations / elapsed)
    return {"rate": max(windows)}


def _multiplying(size: Product) -> Callable[[], jax.Array]:
    """Return what multiplies so often in one dispatch; it is compiled."""
    left = jax.random.normal(jax.random.key(0), (size.rows, size.inner))
    right = jax.random.normal(jax.random.key(1), (size.inner, size.columns))

    @jax.jit
    def multiply(left: jax.Array, right: jax.Array) -> jax.Array:
        def again(_: int, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            operand, product = carry
            operand = operand.at[0, 0].set(product[0, 0])  # so that each has to wait for the one before it
            return operand, operand @ right

        return jax.lax.fori_loop(0, TOGETHER, again, (left, jnp.zeros((len(left), right.shape[1]))))[1]

    multiply(left, right)
    return lambda: multiply(left, right).block_until_ready()  # a call alone is only the dispatch
