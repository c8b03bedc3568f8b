"""The matrix products that one update needs, counted from the equations, and how fast this machine multiplies.

Counted are forward passes, gradients of weights, and gradients of inputs that something learns from. Counting the
operations of the compiled program instead would reward waste. Activations, Adam, noise and sampling from the replay are
not counted.
"""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    import jax

OBSERVATION, ACTION = 17, 6  # of HalfCheetah-v4
BATCH = 256
TOGETHER = 20  # products in one dispatch: a single one is too short to time
WINDOWS = 10


class Product(NamedTuple):
    """A matrix [rows, inner] times a matrix [inner, columns]."""

    rows: int
    inner: int
    columns: int

    @property
    def operations(self) -> int:
        """Multiplications and additions."""
        return 2 * self.rows * self.inner * self.columns


DOMINANT = Product(256, 256, 256)


class Network(NamedTuple):
    """A multilayer perceptron, given by its layer widths including inputs and outputs."""

    widths: tuple[int, ...]

    def forward(self, rows: int) -> Counter[Product]:
        """Count the products of a forward pass for `rows` examples."""
        return Counter(Product(rows, n_in, n_out) for n_in, n_out in self._layers())

    def weight_gradient(self, rows: int) -> Counter[Product]:
        """Count the products for the gradients of all weights, given the gradients of the layers' outputs."""
        return Counter(Product(n_in, rows, n_out) for n_in, n_out in self._layers())

    def input_gradient(self, rows: int, inputs: int = 0) -> Counter[Product]:
        """Count the products for the gradients of hidden layers' inputs and of the network's first `inputs` inputs."""
        wanted = [(inputs, self.widths[1]), *list(self._layers())[1:]]
        return Counter(Product(rows, n_out, n_in) for n_in, n_out in wanted if n_in)

    def learning(self, rows: int) -> Counter[Product]:
        """Count a forward pass and the full gradient with respect to the weights."""
        return self.forward(rows) + self.weight_gradient(rows) + self.input_gradient(rows)

    def _layers(self) -> Iterator[tuple[int, int]]:
        return zip(self.widths[:-1], self.widths[1:], strict=True)


def update_products(
    algorithm: str,
    hidden: tuple[int, ...] = (256, 256),
    batch: int = BATCH,
    observation: int = OBSERVATION,
    action: int = ACTION,
) -> dict[Product, float]:
    """Return how often one update needs each product: for TD3 the mean over its policy delay, for SD3 both pairs.

    CSAC is counted as the paper's Algorithm 1, whose reference is the actor itself, so it needs the same as SAC.
    """
    stochastic = Network((observation, *hidden, 2 * action))
    deterministic = Network((observation, *hidden, action))
    critic = Network((observation + action, *hidden, 1))
    through_critic = critic.forward(batch) + critic.input_gradient(batch, action)
    if algorithm in ("csac", "sac"):
        counts = stochastic.forward(batch) + _times(2, critic.forward(batch))  # the target
        counts += _times(2, critic.learning(batch))
        return dict(counts + stochastic.learning(batch) + _times(2, through_critic))
    if algorithm == "td3":
        always = deterministic.forward(batch) + _times(2, critic.forward(batch)) + _times(2, critic.learning(batch))
        delayed = deterministic.learning(batch) + through_critic
        return {product: always[product] + delayed[product] / 2 for product in always | delayed}
    if algorithm == "sd3":
        samples = 50
        pair = deterministic.forward(batch) + _times(2, critic.forward(samples * batch)) + critic.learning(batch)
        return dict(_times(2, pair + deterministic.learning(batch) + through_critic))
    raise ValueError(f"the products of {algorithm} are not counted")


def operations(counts: dict[Product, float]) -> float:
    """Return the floating-point operations of all these products."""
    return sum(product.operations * times for product, times in counts.items())


def _times(number: int, counts: Counter[Product]) -> Counter[Product]:
    return Counter({product: number * times for product, times in counts.items()})


def measure(size: Sequence[int], seconds: float) -> dict[str, float]:
    """Return operations per second of a product of this size in this process: the best of ten windows.

    As a limit it is measured under the best conditions: the operands stay in the caches, and windows slowed by other
    programs do not count.
    """
    product = Product(*size)
    multiply, rates = _multiplying(product), []
    for _ in range(WINDOWS):
        calls, began = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - began) < seconds / WINDOWS:
            multiply()
            calls += 1
        rates.append(calls * TOGETHER * product.operations / elapsed)
    return {"rate": max(rates)}


def _multiplying(size: Product) -> Callable[[], jax.Array]:
    """Return a compiled function that multiplies `TOGETHER` times."""
    import jax
    import jax.numpy as jnp

    left = jax.random.normal(jax.random.key(0), (size.rows, size.inner))
    right = jax.random.normal(jax.random.key(1), (size.inner, size.columns))

    @jax.jit
    def multiply(left: jax.Array, right: jax.Array) -> jax.Array:
        def again(_: int, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            operand, product = carry
            operand = operand.at[0, 0].set(product[0, 0])  # each product depends on the previous one
            return operand, operand @ right

        return jax.lax.fori_loop(0, TOGETHER, again, (left, jnp.zeros((len(left), right.shape[1]))))[1]

    multiply(left, right)
    return lambda: multiply(left, right).block_until_ready()
