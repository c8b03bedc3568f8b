"""Multilayer perceptrons, and the few things that every actor-critic does with parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

from csac.types import Layer

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


class MLP(eqx.Module):
    """A multilayer perceptron with ReLU or tanh between its layers, for one example."""

    layers: tuple[Layer, ...]
    activation: Literal["relu", "tanh"] = eqx.field(static=True, default="relu")

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Map [in] to [out]."""
        activate = jax.nn.relu if self.activation == "relu" else jnp.tanh
        for layer in self.layers[:-1]:
            inputs = activate(inputs @ layer.weight + layer.bias)
        return inputs @ self.layers[-1].weight + self.layers[-1].bias


def make_mlp(key: jax.Array, input_size: int, hidden_sizes: Sequence[int], output_size: int) -> MLP:
    """Return an MLP with weights and biases uniform in ±1/sqrt(inputs), as PyTorch (and so SB3) draws them."""
    sizes = (input_size, *hidden_sizes, output_size)
    keys = jax.random.split(key, len(sizes) - 1)
    return MLP(tuple(_make_layer(k, n_in, n_out) for k, n_in, n_out in zip(keys, sizes[:-1], sizes[1:], strict=True)))


def _make_layer(key: jax.Array, n_in: int, n_out: int) -> Layer:
    weight_key, bias_key = jax.random.split(key)
    bound = 1.0 / n_in**0.5
    weight = jax.random.uniform(weight_key, (n_in, n_out), minval=-bound, maxval=bound)
    return Layer(weight, jax.random.uniform(bias_key, (n_out,), minval=-bound, maxval=bound))


def make_orthogonal_mlp(
    key: jax.Array, input_size: int, hidden_sizes: Sequence[int], output_size: int, output_gain: float
) -> MLP:
    """Return an MLP with tanh, orthogonal weights of gain √2 (`output_gain` in the last layer) and no biases yet."""
    sizes = (input_size, *hidden_sizes, output_size)
    gains = (2.0**0.5,) * len(hidden_sizes) + (output_gain,)
    keys = jax.random.split(key, len(gains))
    layers = [
        Layer(jax.nn.initializers.orthogonal(gain)(k, (n_in, n_out)), jnp.zeros(n_out))
        for k, gain, n_in, n_out in zip(keys, gains, sizes[:-1], sizes[1:], strict=True)
    ]
    return MLP(tuple(layers), activation="tanh")


def make_critics(
    key: jax.Array, observation_size: int, action_size: int, hidden_sizes: Sequence[int]
) -> tuple[MLP, MLP]:
    """Return two independent critics Q(observation, action)."""
    first, second = jax.random.split(key)
    size = observation_size + action_size
    return make_mlp(first, size, hidden_sizes, 1), make_mlp(second, size, hidden_sizes, 1)


def q_values(critics: tuple[MLP, MLP], observation: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return both critics' values of one pair. Two products side by side beat one batched product on a CPU."""
    inputs = jnp.concatenate([observation, action])
    return critics[0](inputs)[0], critics[1](inputs)[0]


def polyak(targets: Any, sources: Any, rate: float) -> Any:
    """Return targets + rate (sources - targets), leaf by leaf."""
    return jax.tree.map(lambda target, source: target + rate * (source - target), targets, sources)


def copy_tree(tree: Any) -> Any:
    """Return the same values in buffers of their own: donated buffers may not alias."""
    return jax.tree.map(jnp.copy, tree)


def make_optimiser(
    learning_rate: float | jax.Array, max_gradient_norm: float = 0.0, epsilon: float = 1e-8
) -> optax.GradientTransformation:
    """Return Adam, after clipping by the global norm of the gradient where a positive bound is given."""
    adam = optax.adam(learning_rate, eps=epsilon)
    if max_gradient_norm > 0:
        return optax.chain(optax.clip_by_global_norm(max_gradient_norm), adam)
    return adam


def begin_descent(optimiser: optax.GradientTransformation, parameters: Any) -> Any:
    """Return the optimiser's first state."""
    return optimiser.init(parameters)


def descend(
    optimiser: optax.GradientTransformation, loss: Callable, parameters: Any, optimiser_state: Any
) -> tuple[Any, Any, Any]:
    """Return (parameters, optimiser state, metrics) after one step down `loss(parameters) -> (scalar, metrics)`."""
    gradients, metrics = jax.grad(loss, has_aux=True)(parameters)
    updates, optimiser_state = optimiser.update(gradients, optimiser_state, parameters)
    return optax.apply_updates(parameters, updates), optimiser_state, metrics
