"""Commands as they are typed, what they meet, and what they call."""

from __future__ import annotations

import inspect
import shlex
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
from policies import contract
from shown import make_set

from csac.cli import main
from csac.deploy.policy import Policy
from csac.types import Layer, PolicyNetwork, PolicyParameters

SUPPORT = Path(__file__).parent
COMMANDS = ("train", "resume", "evaluate", "play", "export", "latency", "runs", "report", "study", "tune")
TINY = "--batch-size 8 --actor-hidden-sizes 8 --critic-hidden-sizes 8"


def csac(line):
    """Type `csac line` and return the exit code."""
    return main(shlex.split(line))


class Pictures(gymnasium.Env):
    """Five steps of the same reward, and a picture of each."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-2, 2, (1,), np.float32)

    def __init__(self, render_mode=None, reward=1.0):
        self.render_mode, self.reward, self.steps = render_mode, reward, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(3, np.float32), self.reward, self.steps == 5, False, {}

    def render(self):
        return np.full((34, 48, 3), 40 * self.steps, np.uint8)


if "Pictures-v0" not in gymnasium.registry:
    gymnasium.register("Pictures-v0", entry_point=f"{__name__}:Pictures")


def calls_of(monkeypatch, module, name, result=()):
    """What a command calls a function with, by the names of its arguments, instead of running it."""
    calls, signature = [], inspect.signature(getattr(module, name))

    def called(*given, **named):
        arguments = signature.bind(*given, **named).arguments
        arguments |= arguments.pop("options", {})
        calls.append({name: value for name, value in arguments.items() if name != "on_progress"})
        return result

    monkeypatch.setattr(module, name, called)
    return calls


def make_runs(path, task="Pictures-v0", size=3, low=-2.0, high=2.0, **values):
    """Two finished runs, each with a random linear policy; the second has the better return."""
    runs = make_set(Path(path), [[0.0], [1.0]], task=task, steps_done=100, **{"steps": 100, **values})
    agreement = replace(contract(((None, (size,)),), (1,), low, high), task=task)
    generator = np.random.default_rng(0)
    for run in runs.runs:
        weight = generator.normal(size=(size, 2)).astype(np.float32)
        network = PolicyNetwork(PolicyParameters(((Layer(weight, np.zeros(2, np.float32)),),)))
        for which in ("last", "best"):
            Policy(network, agreement, step=100).write(run.policy_file(which))
    return runs


def words(text):
    return [" ".join(line.split()) for line in text.splitlines() if line.strip(" ─")]
