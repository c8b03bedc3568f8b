"""Multilayer perceptrons, and the optimiser, schedules and gradient step that all algorithms use."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from csac.algorithms.shapes import Count, Key, Scalar
from csac.types import LAYER_NORM_EPSILON, Activation, InputError, Layer, Metrics

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

BATCH = "batch"  # name of the batch axis, for losses that use statistics of the whole batch

ACTIVATIONS = {
    "relu": jax.nn.relu,
    "tanh": jnp.tanh,
    "elu": jax.nn.elu,
    "silu": jax.nn.silu,
    "gelu": partial(jax.nn.gelu, approximate=True),
}

Schedule: TypeAlias = Literal["constant", "linear", "cosine"]


class Hidden(NamedTuple):
    """What a hidden layer applies to its affine outputs: layer norm, if any, then the activation."""

    activation: Activation = "relu"
    layer_norm: bool = False


PLAIN = Hidden()


@dataclass(frozen=True)
class Architecture:
    """Activation and layer norm of the hidden layers of actor and critics."""

    activation: Activation = "relu"
    """Activation of the hidden layers."""
    layer_norm: bool = False
    """Whether hidden layers are normalised over their outputs before the activation."""
    actor_activation: Activation | None = None
    """Activation of the actor, if it differs from `activation`."""
    critic_activation: Activation | None = None
    """Activation of the critics, if it differs from `activation`."""
    actor_layer_norm: bool | None = None
    """Whether the actor has layer norm, if it differs from `layer_norm`."""
    critic_layer_norm: bool | None = None
    """Whether the critics have layer norm, if it differs from `layer_norm`."""

    @property
    def actor_hidden(self) -> Hidden:
        """Activation and layer norm of the actor's hidden layers."""
        return self._hidden(self.actor_activation, self.actor_layer_norm)

    @property
    def critic_hidden(self) -> Hidden:
        """Activation and layer norm of each critic's hidden layers."""
        return self._hidden(self.critic_activation, self.critic_layer_norm)

    def _hidden(self, activation: Activation | None, layer_norm: bool | None) -> Hidden:
        return Hidden(activation or self.activation, self.layer_norm if layer_norm is None else layer_norm)


class MLP(eqx.Module):
    """A multilayer perceptron for one example."""

    layers: tuple[Layer, ...]
    activation: Activation = eqx.field(static=True, default="relu")

    def __call__(self, inputs: Float[Array, " in"]) -> Float[Array, " out"]:
        """Return the last layer's outputs, which have no activation."""
        for layer in self.layers[:-1]:
            inputs = self.activate(layer, inputs @ layer.weight + layer.bias)
        return inputs @ self.layers[-1].weight + self.layers[-1].bias

    def activate(self, layer: Layer, values: Float[Array, " width"]) -> Float[Array, " width"]:
        """Return a hidden layer's outputs, given its affine ones: layer norm, if it has one, then the activation."""
        if layer.scale is not None:
            centred = values - jnp.mean(values)
            values = centred / jnp.sqrt(jnp.mean(centred**2) + LAYER_NORM_EPSILON) * layer.scale + layer.shift
        return ACTIVATIONS[self.activation](values)


def make_mlp(key: Key, input_size: int, hidden_sizes: Sequence[int], output_size: int, hidden: Hidden = PLAIN) -> MLP:
    """Return an MLP with weights and biases uniform in ±1/sqrt(inputs), as PyTorch (and so SB3) draws them."""
    sizes = (input_size, *hidden_sizes, output_size)
    layers = []
    for layer_key, n_in, n_out in zip(jax.random.split(key, len(sizes) - 1), sizes[:-1], sizes[1:], strict=True):
        bound = 1.0 / n_in**0.5
        uniform = partial(jax.random.uniform, minval=-bound, maxval=bound)
        weight_key, bias_key = jax.random.split(layer_key)
        layers.append(Layer(uniform(weight_key, (n_in, n_out)), uniform(bias_key, (n_out,))))
    return _with_hidden(layers, hidden)


def _with_hidden(layers: list[Layer], hidden: Hidden) -> MLP:
    """Return the MLP of these affine layers, with `hidden`'s activation and layer norm, if any, between them."""
    if hidden.layer_norm:
        normed = [one._replace(scale=jnp.ones_like(one.bias), shift=jnp.zeros_like(one.bias)) for one in layers[:-1]]
        layers = [*normed, layers[-1]]
    return MLP(tuple(layers), hidden.activation)


def make_orthogonal_mlp(
    key: Key, input_size: int, hidden_sizes: Sequence[int], output_size: int, hidden: Hidden, output_gain: float
) -> MLP:
    """Return an MLP with orthogonal weights of gain √2 (`output_gain` in the last layer) and zero biases."""
    sizes = (input_size, *hidden_sizes, output_size)
    gains = (2.0**0.5,) * len(hidden_sizes) + (output_gain,)
    keys = jax.random.split(key, len(gains))
    layers = [
        Layer(jax.nn.initializers.orthogonal(gain)(k, (n_in, n_out)), jnp.zeros(n_out))
        for k, gain, n_in, n_out in zip(keys, gains, sizes[:-1], sizes[1:], strict=True)
    ]
    return _with_hidden(layers, hidden)


def learnable(network: Any, inputs: int, outputs: int) -> Any:
    """Return the network. Raises InputError if a leaf is no array, or if it does not map [inputs] to [outputs]."""
    kind = type(network).__name__
    for leaf in jax.tree.leaves(network):
        if not eqx.is_array(leaf):
            raise InputError(
                f"{kind} has {leaf!r:.40}, which cannot be learnt: make its field eqx.field(static=True); instead of "
                "eqx.nn.MLP or eqx.nn.Lambda, which hold a function, write a module of eqx.nn.Linear layers"
            )
    try:
        found = jax.eval_shape(network, jax.ShapeDtypeStruct((inputs,), jnp.float32))
    except Exception as error:
        raise InputError(f"{kind} cannot be called with {inputs} numbers: {error}".partition("\n")[0]) from error
    if (shape := getattr(found, "shape", None)) != (outputs,):
        raise InputError(f"{kind} returns an array of shape {shape}, not ({outputs},)")
    return network


def plain_layers(network: Any) -> tuple[Layer, ...]:
    """Return an MLP's layers for the exported policy. Raises InputError for any other network."""
    if isinstance(network, MLP):
        return network.layers
    kind = type(network).__name__
    raise InputError(f"{kind} is no MLP, but policies are exported as plain layers: override `policy` or use an MLP")


def polyak(targets: Any, sources: Any, rate: float | Scalar) -> Any:
    """Return targets + rate (sources - targets), leaf by leaf; None if `targets` is None."""
    if targets is None:
        return None
    return jax.tree.map(lambda target, source: target + rate * (source - target), targets, sources)


def copy_tree(tree: Any) -> Any:
    """Return a copy in separate buffers: donated buffers must not alias."""
    return jax.tree.map(jnp.copy, tree)


def make_optimiser(
    learning_rate: float | Scalar, max_gradient_norm: float = 0.0, *, epsilon: float = 1e-8, momentum: float = 0.9
) -> optax.GradientTransformation:
    """Return Adam, preceded by clipping of the gradient's global norm if `max_gradient_norm` is positive.

    `momentum` is Adam's β₁, the decay of its average gradient.
    """
    adam = optax.adam(learning_rate, b1=momentum, eps=epsilon)
    if max_gradient_norm > 0:
        return optax.chain(optax.clip_by_global_norm(max_gradient_norm), adam)
    return adam


class Progress(NamedTuple):
    """Number of steps an optimiser has made, and number of steps its schedule is for."""

    done: Count
    planned: Scalar


def scheduled(schedule: Schedule, progress: Scalar) -> Scalar | float:
    """Return the factor of the initial learning rate after a fraction p of the run: 1, 1 - p or ½ (1 + cos πp).

    The cosine is that of SGDR without restarts (Loshchilov and Hutter 2017, Eq. 5).
    """
    match schedule:
        case "linear":
            return 1.0 - progress
        case "cosine":
            return 0.5 * (1.0 + jnp.cos(jnp.pi * progress))
    return 1.0


def apply_schedule(schedule: Schedule, planned: int) -> optax.GradientTransformation:
    """Return a transformation that scales an optimiser's steps by a schedule; its state has how many are `planned`."""

    def init(parameters: Any) -> Progress:
        return Progress(jnp.int32(0), jnp.float32(max(planned, 1)))

    def update(steps: Any, state: Progress, parameters: Any = None) -> tuple[Any, Progress]:
        share = scheduled(schedule, jnp.minimum(state.done / state.planned, 1.0))
        return jax.tree.map(lambda step: share * step, steps), Progress(state.done + 1, state.planned)

    return optax.GradientTransformation(init, update)  # pyright: ignore[reportArgumentType]


def init_optimiser(optimiser: optax.GradientTransformation, parameters: Any) -> Any:
    """Return the optimiser's initial state for these parameters, typed Any: Optax's types exclude Equinox modules."""
    return optimiser.init(parameters)


def gradient_step(
    optimiser: optax.GradientTransformation, loss: Callable, parameters: Any, optimiser_state: Any, *examples: Any
) -> tuple[Any, Any, Metrics]:
    """Return (parameters, optimiser state, mean metrics) after one gradient step on the mean loss over examples.

    `loss(parameters, *example) -> (scalar, metrics)` takes one example. The leaves of `examples` have a leading batch
    axis, which the loss may use by its name, `BATCH`.
    """

    def mean_loss(parameters: Any) -> tuple[Scalar, Metrics]:
        in_axes = (None, *(0 for _ in examples))
        losses, metrics = jax.vmap(loss, in_axes, axis_name=BATCH)(parameters, *examples)
        return jnp.mean(losses), jax.tree.map(partial(jnp.mean, axis=0), metrics)

    gradients, metrics = jax.grad(mean_loss, has_aux=True)(parameters)
    updates, optimiser_state = optimiser.update(gradients, optimiser_state, parameters)
    return optax.apply_updates(parameters, updates), optimiser_state, metrics
