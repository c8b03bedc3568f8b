"""An environment that does not return is told of, with the place in the user's code."""

import threading

import numpy as np
from probes import Probe

from csac.tasks.environment import Environment
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
