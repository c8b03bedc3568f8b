"""What is looked at once before a run begins: the API, seeds, wrappers."""

from __future__ import annotations

import random
from typing import Any

import gymnasium
import numpy as np
import probes
import pytest

from csac.tasks.environment import Environment
from csac.tasks.preflight import (
    limit_warning,
    seed_globals,
    seed_warning,
    try_task,
    wrapper_warnings,
)
from csac.types import InputError


class Seedless(probes.Endless):
    def reset(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return np.zeros(1, np.float32), {}


class OldReset(probes.Endless):
    def reset(self, *, seed=None, options=None):  # pyright: ignore[reportIncompatibleMethodOverride]
        return np.zeros(3, np.float32)


class OldStep(probes.Endless):
    def step(self, action):  # pyright: ignore[reportIncompatibleMethodOverride]
        return super().step(action)[1:]


@pytest.mark.parametrize(
    ("task", "arguments", "name"),
    [(Seedless, {}, "seed"), (OldReset, {}, "reset"), (OldStep, {}, "step"), (probes.Endless, {"length": []}, "step")],
)
def test_a_task_of_another_api_is_refused_in_one_line(task, arguments, name):
    class Adds(task):
        def step(self, action):
            assert self.length + 1
            return super().step(action)

    with pytest.raises(InputError, match=f"^Adds does not work.*: .*{name}") as refusal:
        try_task(Environment(Adds, arguments), arguments)
    assert "\n" not in str(refusal.value)


def test_a_simulator_that_breaks_is_left_to_the_run():
    try_task(Environment("probes:Failing-v0"))


class Careless(probes.Probe):
    """Draws its start from NumPy's global generator, or has always the same."""

    def __init__(self, draws: bool) -> None:
        super().__init__()
        self.draws = draws

    def first_observation(self):
        return np.full(1, np.random.random() if self.draws else 0.0, np.float32)


def test_a_task_that_ignores_its_seed_is_told():
    assert "same seed" in str(seed_warning(Environment(Careless, {"draws": True})))
    assert "every seed" in str(seed_warning(Environment(Careless, {"draws": False})))
    for task in ("Hopper-v4", "probes:Failing-v0"):
        environment = Environment(task, {"where": "reset"} if "Failing" in task else None)
        assert seed_warning(environment) is None


def test_a_task_without_a_time_limit_is_told():
    limitless: dict[Any, str] = {probes.Endless: "gymnasium.wrappers.TimeLimit", "probes:Endless-v0": "--env-kwargs"}
    for task, how in limitless.items():
        assert f"({how}" in str(limit_warning(Environment(task), task, 9))
    limited: dict[Any, Any] = {
        "Hopper-v4": None,
        "probes:Endless-v0": {"max_episode_steps": 7},
        lambda: gymnasium.wrappers.TimeLimit(probes.Endless(), 9): None,
    }
    assert [limit_warning(Environment(task, given), task, 9) for task, given in limited.items()] == [None] * 3


def test_global_generators_are_seeded():
    def draws() -> tuple[float, float]:
        seed_globals(2**40 + 5)
        return random.random(), np.random.random()

    assert draws() == draws()


@pytest.mark.parametrize("wrapper", ["NormalizeObservation", "NormalizeReward"])
def test_a_wrapper_that_learns_by_itself_is_told(wrapper):
    def wrapped() -> gymnasium.Env:
        environment = getattr(gymnasium.wrappers, wrapper)(probes.Endless())
        return gymnasium.wrappers.TimeLimit(environment, 9)

    (line,) = wrapper_warnings(Environment(wrapped))
    assert line.startswith(f"wrapped: {wrapper} ")
    assert wrapper_warnings(Environment("Hopper-v4")) == []
