"""An environment that does not return is told of, with the place in the user's code."""

import os
import threading
from contextlib import closing
from pathlib import Path

import numpy as np
from probes import Probe

from csac.tasks.environment import Environment
from csac.tasks.vector import SeedEnvironments
from csac.training import stalls


class Waiting(Probe):
    """A task whose step waits until somebody has been told."""

    told = threading.Event()

    def step(self, action):
        assert self.told.wait(60)
        return super().step(action)


def test_an_environment_that_does_not_return_is_told_once_with_its_place(monkeypatch):
    monkeypatch.setattr(stalls, "SECONDS", 0.01)
    lines = []

    def note(line):
        lines.append(line)
        Waiting.told.set()

    environment = Environment(Waiting)
    environment.reset(0)
    with stalls.stalls_noted(lambda: 1_234, note, "seed 3"):
        environment.step(np.zeros(environment.spec.action_size))
    assert len(lines) == 1
    assert lines[0].startswith("seed 3: at step 1,234 for 0 minutes, inside the environment (test_stalls.py:")


class Held(Probe):
    """A task whose step waits until somebody writes into a pipe."""

    def __init__(self, pipe: str) -> None:
        super().__init__()
        self.pipe = pipe

    def step(self, action):
        Path(self.pipe).read_text()
        return super().step(action)


def test_an_environment_in_a_process_of_its_own_is_told_without_a_place(monkeypatch, tmp_path):
    monkeypatch.setattr(stalls, "SECONDS", 0.01)
    os.mkfifo(tmp_path / "pipe")
    lines = []

    def note(line):
        lines.append(line)
        (tmp_path / "pipe").write_text("go on")

    with closing(SeedEnvironments(Held, {"pipe": str(tmp_path / "pipe")}, [3], processes=1)) as environments:
        environments.reset()
        with stalls.stalls_noted(lambda: 1_234, note, "seed 3"):
            environments.step(np.zeros((1, 1), np.float32))
    assert lines == ["seed 3: at step 1,234 for 0 minutes, inside the environment"]
