"""Check a task once before a run: its API, seeds, time limit and wrappers. Seed the global generators."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.wrappers import NormalizeObservation, NormalizeReward, TimeLimit

from csac.tasks.failures import EnvironmentFailure
from csac.tasks.registry import adapter_of
from csac.types import InputError

if TYPE_CHECKING:
    from csac.tasks.environment import Environment
    from csac.tasks.registry import Task


def try_task(environment: Environment, arguments: Mapping[str, Any] | None = None) -> None:
    """Reset a task and make one step, to detect an incompatible API or an argument of a wrong type early.

    Raise InputError for a TypeError or ValueError; any other failure is left to the run, which logs the traceback.
    """
    try:
        environment.reset(0)
        environment.step(np.zeros(environment.spec.action_size, np.float32))
    except EnvironmentFailure as error:
        if isinstance(error.__cause__, TypeError | ValueError):
            given = f" with the arguments {dict(arguments)}" if arguments else ""
            raise InputError(f"{environment.task_name} does not work{given}: {error}") from error


def seed_warning(environment: Environment) -> str | None:
    """Return a warning if the reset seed does not determine the first observation, or never changes it; else None."""
    try:
        first, second, other = (environment.reset(seed) for seed in (1, 1, 2))
    except EnvironmentFailure:
        return None
    if not np.array_equal(first, second):
        problem = "gives other observations for the same seed: runs do not repeat"
    elif np.array_equal(first, other):
        problem = "gives the same observation for every seed: episodes may be one"
    else:
        return None
    return f"{environment.task_name}: reset(seed=...) {problem}"


def limit_warning(environment: Environment, task: Task, longest: int) -> str | None:
    """Return a warning if the task has no known time limit, so that an episode may take `longest` steps; else None."""
    spec, has_limit = environment.raw.spec, any(isinstance(one, TimeLimit) for one in _wrappers(environment))
    if has_limit or (spec and spec.max_episode_steps) or adapter_of(task):
        return None
    remedy = "--env-kwargs '{\"max_episode_steps\": 1000}'" if isinstance(task, str) else "gymnasium.wrappers.TimeLimit"
    return (
        f"{environment.task_name} has no time limit: an evaluation episode that does not end by itself takes "
        f"{longest:,} steps ({remedy} sets one)"
    )


def wrapper_warnings(environment: Environment) -> list[str]:
    """Return a warning for each wrapper that learns statistics, which csac neither saves nor exports."""
    return [
        f"{environment.task_name}: {type(wrapper).__name__} keeps statistics that are saved neither with the policy "
        "nor in checkpoints, and each environment has its own: leave it out, and use normalise_observations or "
        "normalise_rewards"
        for wrapper in _wrappers(environment)
        if isinstance(wrapper, NormalizeObservation | NormalizeReward)
    ]


def _wrappers(environment: Environment) -> Iterator[gymnasium.Wrapper]:
    wrapper = environment.raw
    while isinstance(wrapper, gymnasium.Wrapper):
        yield wrapper
        wrapper = wrapper.env


@contextmanager
def globals_seeded(seed: int) -> Iterator[None]:
    """Seed Python's and NumPy's global generators in this block, and restore their state afterwards."""
    states = random.getstate(), np.random.get_state()
    seed_globals(seed)
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])


def seed_globals(seed: int) -> None:
    """Seed Python's and NumPy's global generators, which some tasks draw from."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
