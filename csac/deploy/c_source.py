"""A policy as one C99 header: templates/policy.h.jinja with the arrays of its layers."""

from __future__ import annotations

import hashlib
import math
import re
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from csac.deploy.parameters import check_network
from csac.deploy.templates import template
from csac.types import InputError, Layer, Normaliser, PolicyNetwork, PolicyParameters

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from csac.deploy.artefact_contract import ArtefactContract, Weights

BLOCK = 16  # outputs of a layer that are summed side by side: as many as the registers of a Cortex-M4 hold well
LARGEST_HALF = 65504.0
LARGEST_INT8 = 127
NOISE_INCREMENT = 109  # of PCG32: the stream 54 of its authors' examples

_C_TYPES: dict[str, str] = {"float32": "float", "float16": "uint16_t", "int8": "int8_t"}
_MULTIPLIER = 6364136223846793005  # of PCG32
_WIDTH = 120
_ARRAY = re.compile(r"static const \w+ csac_(\w+)\[(\d+)\] = \{")
_NUMBERS = re.compile(r"(?<=\] = \{)[-+0-9.ef,\s]*(?=\};)|(?<=\bCSAC_POLICY_)[0-9a-f]{16}\b")


def c_header(network: PolicyNetwork, contract: ArtefactContract) -> str:
    """Return the header that runs a policy, with its weights in the numbers that the contract asks for.

    Raises:
        InputError: weights that half precision cannot hold.
    """
    policy, guards, parameters = contract.policy, contract.guards, network.parameters
    has_noise = contract.noise_seed is not None
    arrays = _Arrays(contract.weights)
    networks = [
        _described(arrays, f"actor_{number}", layers, network, policy.spec.action_size, has_noise)
        for number, layers in enumerate(parameters.actors)
    ]
    networks += [
        _described(arrays, f"critic_{number}", layers, network, 0, False)
        for number, layers in enumerate(parameters.critics)
    ]
    if parameters.normaliser is not None:
        mean, std, limit = parameters.normaliser
        arrays.add("observation_mean", mean)
        arrays.add("observation_std", std)
        arrays.add("observation_limit", limit)
    if has_noise and parameters.log_std is not None:
        arrays.add("std", np.exp(parameters.log_std))
    low, high = policy.action_low, policy.action_high
    for name, array in (
        ("low", low),
        ("high", high),
        ("half", 0.5 * high - 0.5 * low),
        ("centre", 0.5 * high + 0.5 * low),
        ("least", guards.observation_low),
        ("most", guards.observation_high),
        ("fallback", guards.fallback_action),
        ("change", guards.largest_change),
    ):
        if array is not None:
            arrays.add(name, array)
    told = f"{contract.weights} {contract.noise_seed} {network.head} {guards.fallback} {guards.watchdog}"
    return template("policy.h.jinja").render(
        identity=f"CSAC_POLICY_{hashlib.sha256(''.join([told, *arrays.written]).encode()).hexdigest()[:16]}",
        task=_in_comment(policy.task or "a task of its own"),
        algorithm=_in_comment(policy.algorithm),
        weights=contract.weights,
        c_type=_C_TYPES[contract.weights],
        head=network.head,
        guards=guards,
        observations=policy.spec.observation_size,
        actions=policy.spec.action_size,
        control_rate=None if contract.control_rate is None else _number(contract.control_rate),
        block=BLOCK,
        arrays=arrays.written,
        networks=networks,
        activations=sorted({layer.activation for described in networks for layer in described.layers} - {""}),
        has_noise=has_noise,
        noise_state=f"{noise_state(contract.noise_seed or 0)}u",
        noise_increment=NOISE_INCREMENT,
        has_normaliser=parameters.normaliser is not None,
        critics=len(parameters.critics),
    )


def _in_comment(text: str) -> str:
    """Return a text that cannot end the comment that it stands in: a contract may be anybody's."""
    return re.sub(r"[^\w.:/ -]", "_", text)


def is_header(text: str, contract: ArtefactContract) -> bool:
    """Whether a header is what `c_header` writes for this contract, but for the numbers of its arrays and of its guard.

    So it can be compiled and run without running anybody else's code, and reads no number beyond an array.
    """
    try:
        sizes = {name: int(size) for name, size in _ARRAY.findall(text)}
        if sum(sizes.values()) > len(text):  # each number takes a letter at least
            return False
        network = _network_of_zeros(sizes, contract)
        check_network(network, contract.policy)
        expected = c_header(network, contract)
    except (KeyError, ValueError, ArithmeticError):  # sizes or arrays that no network has
        return False
    return _NUMBERS.sub("", text) == _NUMBERS.sub("", expected)


def _network_of_zeros(sizes: Mapping[str, int], contract: ArtefactContract) -> PolicyNetwork:
    """Return a network whose header has arrays of these sizes; its own take no memory, whatever sizes they claim."""
    observation_size, action_size = contract.policy.spec

    def filled(number: float, *shape: int) -> np.ndarray:
        return np.broadcast_to(np.float32(number), shape)

    def networks(kind: str, outputs: int) -> tuple[tuple[Layer, ...], ...]:
        found: list[tuple[Layer, ...]] = []
        while f"{kind}_{len(found)}_0_bias" in sizes:
            prefix, layers = f"{kind}_{len(found)}", []
            while (name := f"{prefix}_{len(layers)}") + "_bias" in sizes:
                width = sizes[name + "_bias"]
                layers.append(Layer(filled(0, sizes[name + "_weight"] // width, width), filled(0, width)))
            last = filled(0, len(layers[-1].weight), outputs)
            found.append((*layers[:-1], Layer(last, filled(0, outputs))))
        return tuple(found)

    outputs = 2 * action_size if contract.policy.head == "tanh_gaussian" else action_size
    mean, std, limit = filled(0, observation_size), filled(1, observation_size), filled(1)
    parameters = PolicyParameters(
        networks("actor", outputs),
        networks("critic", 1),
        Normaliser(mean, std, limit) if "observation_mean" in sizes else None,
        filled(0, action_size) if contract.policy.head == "clipped_gaussian" else None,
    )
    return PolicyNetwork(parameters, contract.policy.activation, contract.policy.head)


def noise_state(seed: int) -> int:
    """Return the state that PCG32's own way of seeding gives, with the stream 54."""
    return ((NOISE_INCREMENT + seed) * _MULTIPLIER + NOISE_INCREMENT) % 2**64


class _Described(NamedTuple):
    """A network as the template writes it."""

    name: str
    is_actor: bool
    buffers: str
    layers: list[_DescribedLayer]


class _DescribedLayer(NamedTuple):
    arrays: str
    inputs: int
    outputs: int
    source: str
    target: str
    activation: str


def _described(
    arrays: _Arrays, name: str, layers: Sequence[Layer], network: PolicyNetwork, action_size: int, has_noise: bool
) -> _Described:
    """Add the layers of an actor, or of a critic where `action_size` is 0; a layer reads what the one before wrote."""
    activation = network.activation if action_size else "relu"
    source, described, widths = "input", [], [0, 0]
    for index, layer in enumerate(layers[:-1]):
        inputs, outputs = layer.weight.shape
        target = f"hidden_{index % 2}"
        widths[index % 2] = max(widths[index % 2], outputs)
        given = arrays.add_layer(f"{name}_{index}", layer)
        described.append(_DescribedLayer(given, inputs, outputs, source, target, activation))
        source = target
    weight, bias = layers[-1]
    outputs = action_size or 1
    buffers = [f"hidden_{index}[{width}]" for index, width in enumerate(widths) if width]
    given = arrays.add_layer(f"{name}_{len(layers) - 1}", (weight[:, :outputs], bias[:outputs]))
    described.append(_DescribedLayer(given, len(weight), outputs, source, "output", ""))
    if has_noise and network.head == "tanh_gaussian":
        buffers.append("log_std[CSAC_ACTIONS]")
        given = arrays.add_layer(f"{name}_log_std", (weight[:, outputs:], bias[outputs:]))
        described.append(_DescribedLayer(given, len(weight), outputs, source, "log_std", ""))
    return _Described(name, action_size > 0, ", ".join(buffers), described)


class _Arrays:
    """The constant arrays of a header, written out."""

    def __init__(self, weights: Weights) -> None:
        self.weights: Weights = weights
        self.written: list[str] = []

    def add(self, name: str, array: np.ndarray, c_type: str = "float") -> str:
        """Write an array; return what it is called in C."""
        array = np.atleast_1d(array).reshape(-1)
        words = [_number(number) + "f" for number in array] if c_type == "float" else [str(number) for number in array]
        lines, line = [], "   "
        for word in words:
            if len(line) + len(word) + 2 > _WIDTH:
                lines.append(line)
                line = "   "
            line += f" {word},"
        self.written.append("\n".join([f"static const {c_type} csac_{name}[{len(array)}] = {{", *lines, line, "};"]))
        return f"csac_{name}"

    def add_layer(self, name: str, layer: Sequence[np.ndarray]) -> str:
        """Write a layer; return the first arguments of csac_layer."""
        weight, bias = layer
        scale = None
        if self.weights == "float16":
            if not (np.abs(weight) <= LARGEST_HALF).all():
                raise InputError("the weights are too large for float16: export float32 or int8")
            weight = weight.astype(np.float16).view(np.uint16)
        elif self.weights == "int8":
            weight, scale = quantised(weight)
        given = [self.add(f"{name}_weight", _in_blocks(weight), _C_TYPES[self.weights]), self.add(f"{name}_bias", bias)]
        if scale is not None:
            given.append(self.add(f"{name}_scale", scale))
        return ", ".join(given)


def quantised(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return whole numbers, int8 [in, out], and what each output's are to be multiplied by, float32 [out]."""
    largest = np.abs(weight).max(axis=0)
    scale = np.where(largest > 0, largest / LARGEST_INT8, 1.0).astype(np.float32)
    return np.rint(weight / scale).clip(-LARGEST_INT8, LARGEST_INT8).astype(np.int8), scale


def _in_blocks(weight: np.ndarray) -> np.ndarray:
    """Return weights [in, out] in the order in which csac_layer reads them."""
    whole = weight.shape[1] - weight.shape[1] % BLOCK
    blocks = [weight[:, first : first + BLOCK].reshape(-1) for first in range(0, whole, BLOCK)]
    return np.concatenate([*blocks, weight[:, whole:].T.reshape(-1)])


def _number(number: float) -> str:
    """Return a float32 number so that C reads the same one."""
    if not math.isfinite(number):
        raise ValueError(f"{number} cannot be written in C")
    text = f"{number:.9g}"
    return text if "." in text or "e" in text else text + ".0"
