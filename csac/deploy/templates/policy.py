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
    """The controller in a folder. Raises ValueError where its files do not belong together."""

    def __init__(self, folder=Path(__file__).parent):
        self.contract = json.loads(Path(folder, "contract.json").read_text(encoding="utf-8"))
        content = Path(folder, "policy.safetensors").read_bytes()
        if hashlib.sha256(content).hexdigest() != self.contract["sha256"]:
            raise ValueError(f"{folder}: policy.safetensors is not the file that contract.json was written for")
        start, self.tensors = 8 + int.from_bytes(content[:8], "little"), {}
        for name, entry in json.loads(content[8:start]).items():
            begin, end = (start + offset for offset in entry["data_offsets"])
            self.tensors[name] = np.frombuffer(content[begin:end], "<f4").reshape(entry["shape"])
        self.low, self.high = (np.array(self.contract[name], np.float32) for name in ("action_low", "action_high"))
        self.half, self.centre = 0.5 * self.high - 0.5 * self.low, 0.5 * self.high + 0.5 * self.low
        self.activate = {"tanh": np.tanh, "relu": _relu}[self.contract["activation"]]
        self.actors, self.critics = self._networks("actor"), self._networks("critic")
        self.guards = {name: _array(value) for name, value in self.contract["guards"].items()}
        seed = self.contract["noise_seed"]
        sequence = np.random.SeedSequence(seed or 0, spawn_key=(0x706F6C69,))  # far from a simulation's own chances
        self.generator = None if seed is None else np.random.default_rng(sequence)
        self.reset()

    def reset(self):
        """Forget the action before and the bad observations. Noise goes on."""
        self.last, self.bad = None, 0

    def act(self, observation, noise=None):
        """Return the action. `noise`, standard normal [action], is drawn where the policy was exported with a seed."""
        if noise is None and self.generator:
            noise = self.generator.standard_normal(len(self.low), dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            inputs = observation = np.asarray(observation, np.float32)
            if observation.shape != (size := (self.contract["observation_size"],)):
                raise ValueError(f"an observation has the shape {size}, one at a time, not {observation.shape}")
            if "normaliser.mean" in self.tensors:
                mean, std, limit = (self.tensors["normaliser." + name] for name in ("mean", "std", "limit"))
                inputs = np.minimum(np.maximum((inputs - mean) / std, -limit), limit)
            actions = [self._action(actor, inputs, noise) for actor in self.actors]
            action = actions[0]
            if self.critics:  # the action that its own critic values most, the first of equals
                pairs = zip(self.critics, actions, strict=True)
                values = [_outputs(critic, np.append(inputs, action), _relu) for critic, action in pairs]
                action = actions[np.argmax(values)]
            action = np.minimum(np.maximum(action * self.half + self.centre, self.low), self.high)
            return self._guarded(observation, action)

    def _action(self, actor, inputs, noise):
        """Return an actor's action in [-1, 1]."""
        output, log_std = _outputs(actor, inputs, self.activate), self.tensors.get("log_std")
        if self.contract["head"] == "tanh_gaussian":
            output, log_std = output[: len(self.low)], np.clip(output[len(self.low) :], -20.0, 2.0)
        if noise is not None and log_std is not None:
            output = output + np.exp(log_std) * noise
        is_clipped = self.contract["head"] == "clipped_gaussian"
        return np.minimum(np.maximum(output, -1.0), 1.0) if is_clipped else np.tanh(output)

    def _guarded(self, observation, action):
        """Return what leaves instead of the policy's action."""
        guards = self.guards
        if not guards["fallback"]:
            return action
        inside = (observation >= guards["observation_low"]) & (observation <= guards["observation_high"])
        bad = not (inside.all() and np.isfinite(action).all())
        if self.bad < guards["watchdog"]:
            self.bad = self.bad + 1 if bad else 0
        if bad or 0 < guards["watchdog"] <= self.bad:
            repeats = guards["fallback"] == "last" and self.last is not None
            action = self.last if repeats else guards["fallback_action"]
        if guards["largest_change"] is not None and self.last is not None:
            low, high = self.last - guards["largest_change"], self.last + guards["largest_change"]
            action = np.minimum(np.maximum(action, low), high)
            action = np.minimum(np.maximum(action, self.low), self.high)
        self.last = np.array(action)
        return np.array(action)  # the caller's own: to change it must not change the fallback

    def _networks(self, kind):
        """Return the layers of each actor or critic, in order: weight [in, out] and bias [out]."""
        names = sorted((name.split(".") for name in self.tensors if name.startswith(kind)), key=lambda n: int(n[2]))
        networks = [[] for _ in {name[1] for name in names}]
        for _, number, index, part in names:
            if part == "weight":
                bias = self.tensors[f"{kind}.{number}.{index}.bias"]
                networks[int(number)].append((self.tensors[f"{kind}.{number}.{index}.weight"], bias))
        return networks


def _outputs(layers, inputs, activate):
    """Return what the last layer gives."""
    for weight, bias in layers[:-1]:
        inputs = activate(inputs @ weight + bias)
    return inputs @ layers[-1][0] + layers[-1][1]


def _relu(x):
    return np.maximum(x, 0.0)


def _array(value):
    return np.array(value, np.float32) if isinstance(value, list) else value
