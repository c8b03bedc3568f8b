"""Export a policy as an ONNX graph, from the raw observation to the environment's action, built node by node."""

from __future__ import annotations

import importlib
import json
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.deploy.parameters import deterministic
from csac.deploy.policy import GELU_CUBE, GELU_SCALE
from csac.types import LAYER_NORM_EPSILON, InputError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from csac.deploy.contract import Contract
    from csac.deploy.guards import Guards
    from csac.deploy.policy import Policy
    from csac.types import Layer

OPSET = 17  # from 2022: every runtime in use supports it
IR_VERSION = 8  # the oldest that allows this opset


def model(policy: Policy, guards: Guards, fields: dict[str, Any]) -> bytes:
    """Return the content of an ONNX model file, with the contract as metadata. All numbers are float32.

    Inputs: `observation` [n, observation]; `state` [n, action + 1] if the guards remember the previous action: zeros at
    first and after a reset, then the last `next_state`. Outputs: `action` [n, action] on the environment's scale, and
    `next_state` if there is a `state`.
    """
    onnx = _package("onnx")
    helper = onnx.helper
    graph, (observation_size, action_size) = _Graph(), policy.contract.spec[:2]
    inputs, outputs = {"observation": observation_size}, {"action": action_size}
    if guards.has_state:
        inputs["state"] = outputs["next_state"] = action_size + 1
    graph.add("Identity", [_guarded(graph, guards, policy.contract, _action(graph, policy))], "action")

    def values(sizes: dict[str, int]) -> list[Any]:
        return [
            helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["n", size]) for name, size in sizes.items()
        ]

    nodes = [helper.make_node(kind, names, [output], output, **options) for kind, names, output, options in graph.nodes]
    constants = [onnx.numpy_helper.from_array(array, name) for name, array in graph.constants.items()]
    onnx_graph = helper.make_graph(nodes, "policy", values(inputs), values(outputs), constants)
    onnx_model = helper.make_model(
        onnx_graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="csac"
    )
    helper.set_model_props(onnx_model, {"contract": json.dumps(fields, allow_nan=False)})
    onnx.checker.check_model(onnx_model, full_check=True)
    return onnx_model.SerializeToString(deterministic=True)


def _package(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(
            f"an ONNX artefact needs the package {name}: pip install '.[onnx]' in a clone of csac"
        ) from None


class Session:
    """Run a graph with ONNX Runtime, in one thread: a controller shares its processor."""

    def __init__(self, path: Path, policy: Policy, guards: Guards) -> None:
        onnxruntime = _package("onnxruntime")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        self._zeros = np.zeros((1, policy.contract.spec.action_size + 1), np.float32) if guards.has_state else None
        self.reset()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the action for an observation."""
        inputs = {"observation": observation[None]}
        if self._state is not None:
            inputs["state"] = self._state
        outputs = self._session.run(None, inputs)
        if self._state is not None:
            self._state = outputs[1]
        return outputs[0][0]

    def reset(self) -> None:
        """Forget the previous action."""
        self._state = self._zeros


class _Graph:
    """Nodes in execution order, and the constant arrays that they use."""

    def __init__(self) -> None:
        self.nodes: list[tuple[str, list[str], str, dict[str, Any]]] = []
        self.constants: dict[str, np.ndarray] = {}

    def add(self, kind: str, inputs: Sequence[Any], output: str = "", **options: Any) -> str:
        """Add a node; return the name of its output. Arrays and numbers among the inputs become constants."""
        output = output or f"{kind.lower()}_{len(self.nodes)}"
        names = [item if isinstance(item, str) else self._constant(np.asarray(item)) for item in inputs]
        self.nodes.append((kind, names, output, options))
        return output

    def _constant(self, array: np.ndarray) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants[name] = np.ascontiguousarray(array, np.float32 if array.dtype.kind == "f" else array.dtype)
        return name

    def clip(self, name: str, low: Any, high: Any) -> str:
        """Clip values to [low, high]; return the output's name. Bounds may be arrays or names of other outputs."""
        return self.add("Min", [self.add("Max", [name, low]), high])

    def network(self, layers: tuple[Layer, ...], inputs: str, activation: str) -> str:
        """Add an MLP; return the name of its output."""
        for index, (weight, bias, scale, shift) in enumerate(layers):
            inputs = inputs if index == 0 else self.activated(inputs, activation)
            inputs = self.add("Gemm", [inputs, weight, bias])
            if scale is not None:
                inputs = self.add("LayerNormalization", [inputs, scale, shift], epsilon=LAYER_NORM_EPSILON)
        return inputs

    def activated(self, name: str, activation: str) -> str:
        """Add an activation; return the name of its output. This opset has no SiLU and no GELU."""
        match activation:
            case "silu":
                return self.add("Mul", [name, self.add("Sigmoid", [name])])
            case "gelu":
                cube = self.add("Mul", [self.add("Mul", [name, name]), self.add("Mul", [name, GELU_CUBE])])
                inner = self.add("Mul", [self.add("Add", [name, cube]), GELU_SCALE])
                return self.add(
                    "Mul", [self.add("Mul", [name, 0.5]), self.add("Add", [self.add("Tanh", [inner]), 1.0])]
                )
        return self.add(activation.capitalize(), [name])

    def is_finite(self, name: str) -> str:
        """Add a test whether all numbers of each row are finite; return the name of its output, [n, 1]."""
        zeros = self.add("Mul", [name, 0.0])  # NaN where not finite; a sum keeps NaN, a maximum may not
        return self.add("Equal", [self.add("ReduceSum", [zeros, np.array([1])], keepdims=1), 0.0])


def _action(graph: _Graph, policy: Policy) -> str:
    """Add all nodes from the observation to the action within its bounds; return the action's name."""
    contract, inputs = policy.contract, "observation"
    parameters = deterministic(policy.network.parameters, contract.spec.action_size)
    if (normaliser := parameters.normaliser) is not None:
        inputs = graph.add("Div", [graph.add("Sub", [inputs, normaliser.mean]), normaliser.std])
        inputs = graph.clip(inputs, -normaliser.limit, normaliser.limit)
    actions = [graph.network(layers, inputs, contract.activation) for layers in parameters.actors]
    is_clipped = contract.head == "clipped_gaussian"
    actions = [graph.clip(name, -1.0, 1.0) if is_clipped else graph.add("Tanh", [name]) for name in actions]
    action, best = actions[0], ""
    for layers, candidate in zip(parameters.critics, actions, strict=bool(parameters.critics)):
        value = graph.network(layers, graph.add("Concat", [inputs, candidate], axis=1), contract.critic_activation)
        if best:
            # As in NumPy's argmax, NaN counts as the highest value, so that the guards see it.
            is_first_nan = graph.add("And", [graph.add("IsNaN", [value]), graph.add("Equal", [best, best])])
            is_more = graph.add("Or", [graph.add("Greater", [value, best]), is_first_nan])
            action = graph.add("Where", [is_more, candidate, action])
            value = graph.add("Where", [is_more, value, best])
        best = value
    scaled = graph.add("Add", [graph.add("Mul", [action, contract.bounds.half]), contract.bounds.centre])
    return graph.clip(scaled, contract.action_low, contract.action_high)


def _guarded(graph: _Graph, guards: Guards, contract: Contract, action: str) -> str:
    """Add the guards, as `csac.deploy.guards` defines them; return the name of the action to send.

    The state holds the previous action, and a flag that is 1 once there is one.
    """
    if guards.fallback is None:
        return action
    size = contract.spec.action_size
    fallback: Any = guards.fallback
    last = flag = has_last = ""
    if guards.has_state:
        last = graph.add("Slice", ["state", *map(np.array, ([0], [size], [1]))])
        flag = graph.add("Slice", ["state", *map(np.array, ([size], [size + 1], [1]))])  # [n, 1]
        has_last = graph.add("Greater", [flag, 0.5])
    if guards.repeats_last:
        fallback = graph.add("Where", [has_last, last, fallback])
    is_good = graph.add("And", [graph.is_finite("observation"), graph.is_finite(action)])
    action = graph.add("Where", [is_good, action, fallback])
    if guards.largest_change is not None:
        least, most = (graph.add(kind, [last, guards.largest_change]) for kind in ("Sub", "Add"))
        limited = graph.clip(graph.clip(action, least, most), contract.action_low, contract.action_high)
        action = graph.add("Where", [has_last, limited, action])
    if guards.has_state:
        ones = graph.add("Add", [graph.add("Mul", [flag, 0.0]), 1.0])
        graph.add("Concat", [action, ones], "next_state", axis=1)
    return action
