"""Tasks that write time stamps, so that every library can be timed from outside.

`csac train benchmarks.stamps:Stamped/HalfCheetah-v4` and the peers' script write a line "steps seconds" every
`STAMP_EVERY` steps, into one file per environment in the folder `STAMPS`. A step, including its update, ends when the
next one begins. csac is not installed for the peers, so this module imports only Gymnasium, and for the slow task
PyFlyt and a csac file that needs nothing else.
"""

from __future__ import annotations

import itertools
import os
import time
from pathlib import Path
from typing import Any

import gymnasium

BASE = "HalfCheetah-v4"
TASK = f"benchmarks.stamps:Stamped/{BASE}"
WAYPOINTS = "benchmarks.stamps:Stamped/QuadX-Waypoints-v1"
FOLDER, EVERY = "STAMPS", "STAMP_EVERY"  # environment variables

_numbers = itertools.count()


class Stamped(gymnasium.Wrapper):
    """Write a time stamp every `STAMP_EVERY` steps."""

    def __init__(self, environment: gymnasium.Env) -> None:
        super().__init__(environment)
        self._path = Path(os.environ[FOLDER], f"{os.getpid()}-{next(_numbers)}")
        self._every, self._steps = int(os.environ[EVERY]), 0

    def step(self, action: Any) -> Any:
        """Step the environment."""
        if self._steps and self._steps % self._every == 0:
            with self._path.open("a") as file:
                file.write(f"{self._steps} {time.monotonic()}\n")
        self._steps += 1
        return super().step(action)


def make(**arguments: Any) -> gymnasium.Env:
    """Return a new environment that writes time stamps."""
    return Stamped(gymnasium.make(BASE, **arguments))


def make_waypoints(**arguments: Any) -> gymnasium.Env:
    """Return a new slow environment with flat observations that writes time stamps."""
    import PyFlyt.gym_envs  # noqa: F401

    from csac.tasks.pybullet import FlatWaypoints

    return Stamped(FlatWaypoints(gymnasium.make("PyFlyt/QuadX-Waypoints-v1", **arguments)))


gymnasium.register(f"Stamped/{BASE}", entry_point="benchmarks.stamps:make")
gymnasium.register("Stamped/QuadX-Waypoints-v1", entry_point="benchmarks.stamps:make_waypoints")
