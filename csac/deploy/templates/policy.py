"""A trained controller on NumPy alone. Copy this file with policy.safetensors and contract.json, which lie beside it.

    policy = Policy("the/folder")
    action = policy.act(observation)

An observation is float32 [observation], flat in the order that contract.json lists; the action, float32 [action], is
on the environment's own scale and within its bounds. Call `reset()` where an episode begins: guards remember.
"""

import hashlib
import json
from pathlib import Path

import numpy as np


class Policy:
    """The controller in a folder. Raises ValueError if its files do not belong together."""

    def __init__(self, folder=Path(__file__).parent):
        self.contract = json.loads(Path(folder, "contract.json").read_text(encoding="utf-8"))
        content = Path(folder, "policy.safetensors").read_bytes()
        if hashlib.sha256(content).hexdigest() not in self.contract["sha256"]["policy.safetensors"]:
            raise ValueError(f"{folder}: policy.safetensors does not match its checksum in contract.json")
        self.tensors = _tensors(content)
        self.low, self.high = (np.array(self.contract[name], np.float32) for name in ("action_low", "action_high"))
        self.half, self.centre = 0.5 * self.high - 0.5 * self.low, 0.5 * self.high + 0.5 * self.low
        self.activate = _ACTIVATIONS[self.contract["activation"]]
        self.activate_critic = _ACTIVATIONS[self.contract.get("critic_activation", "relu")]
        self.guards = {key: np.array(v, np.float32) for key, v in self.contract["guards"].items() if v is not None}
        self.reset()

    def reset(self):
        """Forget the action before."""
        self.last = None

    def act(self, observation):
        """Return the action."""
        observation = np.asarray(observation, np.float32)
        if observation.shape != (size := (self.contract["observation_size"],)):
            raise ValueError(f"an observation has the shape {size}, one at a time, not {observation.shape}")
        with np.errstate(over="ignore", invalid="ignore"):
            action = self._action(observation) * self.half + self.centre
            action = np.minimum(np.maximum(action, self.low), self.high)
        if "fallback" in self.guards and not (np.isfinite(observation).all() and np.isfinite(action).all()):
            repeats = self.guards["repeats_last"] and self.last is not None
            action = self.last if repeats else self.guards["fallback"]
        if "largest_change" in self.guards and self.last is not None:
            least, most = self.last - self.guards["largest_change"], self.last + self.guards["largest_change"]
            action = np.minimum(np.maximum(np.minimum(np.maximum(action, least), most), self.low), self.high)
        self.last = np.array(action)
        return np.array(action)  # the caller's own: to change it must not change the fallback

    def _action(self, inputs):
        """Return the action in [-1, 1]; of several, the first of those that their own critics value most."""
        if "normaliser.mean" in self.tensors:
            mean, std, limit = (self.tensors["normaliser." + name] for name in ("mean", "std", "limit"))
            inputs = np.minimum(np.maximum((inputs - mean) / std, -limit), limit)
        head = np.tanh if self.contract["head"] != "clipped_gaussian" else lambda x: np.minimum(np.maximum(x, -1), 1)
        actions, values = [], []
        while f"actor.{len(actions)}.0.weight" in self.tensors:
            output = self._outputs(f"actor.{len(actions)}", inputs, self.activate)[: len(self.low)]
            actions.append(head(output))
        if len(actions) > 1:
            seen = [np.append(inputs, action) for action in actions]
            values = [self._outputs(f"critic.{i}", each, self.activate_critic)[0] for i, each in enumerate(seen)]
        return actions[np.argmax(values)] if values else actions[0]

    def _outputs(self, network, inputs, activate):
        """Return what the last layer of a network gives."""
        index = 0
        while f"{network}.{index}.weight" in self.tensors:
            inputs = inputs if index == 0 else activate(inputs)
            inputs = inputs @ self.tensors[f"{network}.{index}.weight"] + self.tensors[f"{network}.{index}.bias"]
            if f"{network}.{index}.scale" in self.tensors:  # layer norm
                inputs = (inputs - inputs.mean()) / np.sqrt(inputs.var() + 1e-5)
                inputs = inputs * self.tensors[f"{network}.{index}.scale"] + self.tensors[f"{network}.{index}.shift"]
            index += 1
        return inputs


_ACTIVATIONS = {
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(x)),
    "silu": lambda x: x / (1.0 + np.exp(-x)),
    "gelu": lambda x: 0.5 * x * (1.0 + np.tanh(0.7978845608028654 * (x + 0.044715 * x**3))),
}


def _tensors(content):
    """Return the arrays in a safetensors file: the length of its header, the header as JSON, the numbers."""
    start = 8 + int.from_bytes(content[:8], "little")
    entries = {name: entry for name, entry in json.loads(content[8:start]).items() if name != "__metadata__"}
    return {
        name: np.frombuffer(content, "<f4", np.prod(entry["shape"], dtype=int), start + entry["data_offsets"][0])
        .reshape(entry["shape"]) for name, entry in entries.items()
    }  # fmt: skip
