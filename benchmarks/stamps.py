"""Tasks with a clock: every library trains on them, and is timed from outside by what they write.

`csac train benchmarks.stamps:Stamped/HalfCheetah-v4` and the peers' script write a line "steps seconds" for every
`STAMP_EVERY` steps of an environment into a file of its own in the folder `STAMPS`. A step is over, and the update that
belongs to it, when the next one begins. The peers have no csac: only Gymnasium is imported here, and with the slow task
PyFlyt and a file of csac's that needs nothing else.
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
    """Write when each `STAMP_EVERY` steps were over."""

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
    """Return a new environment with a clock."""
    return Stamped(gymnasium.make(BASE, **arguments))


def make_waypoints(**arguments: Any) -> gymnasium.Env:
    """Return a new slow environment with a clock, its observation flat."""
    import PyFlyt.gym_envs  # noqa: F401

    from csac.tasks.pybullet import FlatWaypoints

    return Stamped(FlatWaypoints(gymnasium.make("PyFlyt/QuadX-Waypoints-v1", **arguments)))


gymnasium.register(f"Stamped/{BASE}", entry_point="benchmarks.stamps:make")
gymnasium.register("Stamped/QuadX-Waypoints-v1", entry_point="benchmarks.stamps:make_waypoints")
