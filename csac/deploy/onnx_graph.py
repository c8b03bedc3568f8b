"""A policy as an ONNX graph, from the raw observation to the environment's action, built node by node."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.deploy.contract import FLOAT32_MAX
from csac.deploy.policy import LOG_STD_RANGE
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.deploy.artefact_contract import ArtefactContract
    from csac.deploy.guards import Guards
    from csac.types import Layer, PolicyNetwork

OPSET = 17  # of 2022: every runtime in use has it
IR_VERSION = 8  # the oldest that goes with it


def graph_sizes(contract: ArtefactContract) -> tuple[dict[str, int], dict[str, int]]:
    """Return how many numbers the inputs and the outputs of an artefact's graph have, by name."""
    spec = contract.policy.spec
    inputs, outputs = {"observation": spec.observation_size}, {"action": spec.action_size}
    if contract.noise_seed is not None:
        inputs["noise"] = spec.action_size
    if contract.guards.has_state:
        inputs["state"] = outputs["next_state"] = spec.action_size + 2
    return inputs, outputs


def onnx_model(network: PolicyNetwork, contract: ArtefactContract) -> bytes:
    """Return the file of an ONNX model.

    Inputs: `observation` [n, observation]; `noise` [n, action], standard normal, where it samples; `state`
    [n, action + 2], where its guards remember: zeros at first and after a reset, then what `next_state` gave.
    Outputs: `action` [n, action] on the environment's scale, and `next_state`. Everything is float32.

    Raises:
        InputError: the package onnx is not installed.
    """
    try:
        import onnx
        from onnx import TensorProto, checker, helper
    except ImportError:
        raise InputError("an ONNX artefact needs the package onnx: pip install '.[onnx]' in a clone of csac") from None
    graph, guards = _Graph(), contract.guards
    inputs, outputs = graph_sizes(contract)
    action = _policy(graph, network, contract)
    if guards.is_any:
        action = _guarded(graph, guards, contract, action)
    graph.add("Identity", [action], "action")

    def values(sizes: dict[str, int]) -> list[Any]:
        return [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", size]) for name, size in sizes.items()]

    nodes = [helper.make_node(kind, names, [output], output, **options) for kind, names, output, options in graph.nodes]
    constants = [onnx.numpy_helper.from_array(array, name) for name, array in graph.constants.items()]
    built = helper.make_graph(nodes, "policy", values(inputs), values(outputs), constants)
    model = helper.make_model(
        built, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="csac"
    )
    fields = {name: value for name, value in contract.fields().items() if name not in ("sha256", "verification")}
    helper.set_model_props(model, {"contract": json.dumps(fields, allow_nan=False)})
    checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


class _Graph:
    """Nodes in the order in which they run, and the arrays that they use."""

    def __init__(self) -> None:
        self.nodes: list[tuple[str, list[str], str, dict[str, Any]]] = []
        self.constants: dict[str, np.ndarray] = {}

    def add(self, kind: str, inputs: Sequence[str | np.ndarray | np.floating], output: str = "", **options: Any) -> str:
        """Add a node; return the name of its output. An array among the inputs becomes a constant."""
        output = output or f"{kind.lower()}_{len(self.nodes)}"
        names = [item if isinstance(item, str) else self.constant(item) for item in inputs]
        self.nodes.append((kind, names, output, options))
        return output

    def constant(self, array: Any) -> str:
        """Return the name of a constant; floating-point numbers become float32."""
        array = np.asarray(array)
        name = f"constant_{len(self.constants)}"
        self.constants[name] = np.ascontiguousarray(array, np.float32 if array.dtype.kind == "f" else array.dtype)
        return name

    def clip(self, name: str, low: Any, high: Any) -> str:
        """Return values within [low, high]; bounds may differ from number to number, and be computed."""
        return self.add("Min", [self.add("Max", [name, _input(low)]), _input(high)])


def _input(value: Any) -> str | np.ndarray:
    return value if isinstance(value, str) else np.asarray(value, np.float32)


def _policy(graph: _Graph, network: PolicyNetwork, contract: ArtefactContract) -> str:
    """Add everything from the observation to the action within its bounds; return the action's name."""
    parameters, inputs = network.parameters, "observation"
    if (normaliser := parameters.normaliser) is not None:
        inputs = graph.add("Div", [graph.add("Sub", [inputs, normaliser.mean]), normaliser.std])
        inputs = graph.clip(inputs, -normaliser.limit, normaliser.limit)
    actions = [_actor(graph, network, layers, inputs, contract) for layers in parameters.actors]
    action = actions[0]
    if len(actions) > 1:
        action = _most_valued(graph, parameters.critics, inputs, actions)
    low, high = contract.policy.action_low, contract.policy.action_high
    scaled = graph.add("Mul", [action, 0.5 * high - 0.5 * low])
    return graph.clip(graph.add("Add", [scaled, 0.5 * high + 0.5 * low]), low, high)


def _actor(
    graph: _Graph, network: PolicyNetwork, layers: tuple[Layer, ...], inputs: str, contract: ArtefactContract
) -> str:
    """Add an actor; return the name of its action in [-1, 1]."""
    size, is_noisy = contract.policy.spec.action_size, contract.noise_seed is not None
    activation = "Relu" if network.activation == "relu" else "Tanh"
    hidden = _hidden(graph, layers[:-1], inputs, activation)
    weight, bias = layers[-1]
    action = graph.add("Gemm", [hidden, weight[:, :size], bias[:size]])
    if is_noisy and network.head == "tanh_gaussian":
        log_std = graph.add("Gemm", [hidden, weight[:, size:], bias[size:]])
        spread = graph.add("Exp", [graph.clip(log_std, *LOG_STD_RANGE)])
        action = graph.add("Add", [action, graph.add("Mul", [spread, "noise"])])
    if (log_std := network.parameters.log_std) is None:
        return graph.add("Tanh", [action])
    if is_noisy:
        action = graph.add("Add", [action, graph.add("Mul", ["noise", np.exp(log_std)])])
    return graph.clip(action, -1.0, 1.0)


def _most_valued(graph: _Graph, critics: Any, inputs: str, actions: list[str]) -> str:
    """Add the critics; return the name of the action that its own critic values most, the first of equals.

    As for NumPy, a NaN is above all: what goes wrong is for the guards to see.
    """
    best, best_value = actions[0], ""
    for layers, action in zip(critics, actions, strict=True):
        both = graph.add("Concat", [inputs, action], axis=1)
        value = graph.add("Gemm", [_hidden(graph, layers[:-1], both, "Relu"), *layers[-1]])
        if not best_value:
            best_value = value
            continue
        is_first_nan = graph.add(
            "And", [graph.add("IsNaN", [value]), graph.add("Not", [graph.add("IsNaN", [best_value])])]
        )
        is_more = graph.add("Or", [graph.add("Greater", [value, best_value]), is_first_nan])
        best = graph.add("Where", [is_more, action, best])
        best_value = graph.add("Where", [is_more, value, best_value])
    return best


def _hidden(graph: _Graph, layers: tuple[Layer, ...], inputs: str, activation: str) -> str:
    for weight, bias in layers:
        inputs = graph.add(activation, [graph.add("Gemm", [inputs, weight, bias])])
    return inputs


def _guarded(graph: _Graph, guards: Guards, contract: ArtefactContract, action: str) -> str:
    """Add the guards, as `csac.deploy.guards` defines them; return the name of the action that leaves.

    The state holds the action before, 1 once there is one, and how many steps in a row were bad.
    """
    size = contract.policy.spec.action_size
    last = has_last = bad_before = ""
    if guards.has_state:
        last = graph.add("Slice", ["state", *map(np.array, ([0], [size], [1]))])
        has_last = graph.add("Slice", ["state", *map(np.array, ([size], [size + 1], [1]))])
        has_last = graph.add("Greater", [has_last, np.float32(0.5)])  # [n, 1]
        bad_before = graph.add("Slice", ["state", *map(np.array, ([size + 1], [size + 2], [1]))])
    is_good = graph.add(
        "And",
        [
            _all_within(graph, "observation", guards.observation_low, guards.observation_high),
            _all_within(graph, action, np.float32(-FLOAT32_MAX), np.float32(FLOAT32_MAX)),
        ],
    )
    takes_policy, bad_steps = is_good, bad_before
    if guards.watchdog:
        waits_for = np.float32(guards.watchdog)
        more = graph.add("Add", [bad_before, np.float32(1.0)])
        counted = graph.add("Where", [is_good, np.float32(0.0), more])
        has_tripped = graph.add("GreaterOrEqual", [bad_before, waits_for])
        bad_steps = graph.add("Where", [has_tripped, bad_before, counted])
        takes_policy = graph.add("And", [is_good, graph.add("Less", [bad_steps, waits_for])])
    fallback = graph.constant(guards.fallback_action)
    if guards.fallback == "last":
        fallback = graph.add("Where", [has_last, last, fallback])
    action = graph.add("Where", [takes_policy, action, fallback])
    if guards.largest_change is not None:
        least, most = (graph.add(kind, [last, guards.largest_change]) for kind in ("Sub", "Add"))
        limited = graph.clip(action, least, most)
        limited = graph.clip(limited, contract.policy.action_low, contract.policy.action_high)
        action = graph.add("Where", [has_last, limited, action])
    if guards.has_state:
        one = graph.add("Add", [graph.add("Mul", [bad_before, np.float32(0.0)]), np.float32(1.0)])  # [n, 1]
        graph.add("Concat", [action, one, bad_steps], "next_state", axis=1)
    return action


def _all_within(graph: _Graph, name: str, low: Any, high: Any) -> str:
    """Return whether all numbers of a row lie within bounds, which no NaN does: [n, 1]."""
    both = graph.add("And", [graph.add("GreaterOrEqual", [name, low]), graph.add("LessOrEqual", [name, high])])
    return graph.add(
        "Equal", [graph.add("ReduceMin", [graph.add("Cast", [both], to=1)], axes=[1], keepdims=1), np.float32(1.0)]
    )
