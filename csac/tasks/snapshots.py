"""Save and restore a Gymnasium environment in the middle of an episode, as named arrays and JSON values.

An environment supports this with `get_snapshot() -> (arrays, values)` and `set_snapshot(arrays, values)`, which is
called after a `reset` with the seed of the episode. For Gymnasium's own MuJoCo and classic-control tasks both are built
in. The time limit and the random generator are handled here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from csac.types import Snapshot

if TYPE_CHECKING:
    import gymnasium

# MuJoCo recomputes these in every step; their sizes depend on the current contacts.
_RECOMPUTED = ("efc_", "iefc_", "island_", "iacc", "ifrc_", "map_")
_KNOWN_WRAPPERS = (TimeLimit, OrderEnforcing, PassiveEnvChecker)


def snapshot(environment: gymnasium.Env) -> Snapshot | None:
    """Return the state of the episode in progress, or None if it cannot be saved completely."""
    inner = environment.unwrapped
    if _time_limits(environment) is None:
        return None
    if callable(getattr(inner, "get_snapshot", None)):
        arrays, values = inner.get_snapshot()  # pyright: ignore[reportAttributeAccessIssue]
        arrays = {f"own.{name}": np.array(array) for name, array in arrays.items()}
        values = {"own": values}
    elif _is_gymnasiums("classic_control", inner):
        arrays, values = {"state": np.array(inner.state)}, {}  # pyright: ignore[reportAttributeAccessIssue]
    elif _is_gymnasiums("mujoco", inner):
        arrays = {f"mujoco.{name}": array.copy() for name, array in _mujoco_arrays(inner).items()}
        values = {"mujoco_time": float(inner.data.time)}  # pyright: ignore[reportAttributeAccessIssue]
    else:
        return None
    elapsed = [limit._elapsed_steps for limit in _time_limits(environment) or ()]
    return Snapshot(arrays, {**values, "elapsed_steps": elapsed, "generator": inner.np_random.bit_generator.state})


def restore(environment: gymnasium.Env, saved: Snapshot) -> None:
    """Restore a snapshot in an environment that was just reset. Raise an exception if it does not fit."""
    inner, values = environment.unwrapped, saved.values
    if "own" in values:
        arrays = {name.removeprefix("own."): array for name, array in saved.arrays.items()}
        inner.set_snapshot(arrays, values["own"])  # pyright: ignore[reportAttributeAccessIssue]
    elif "state" in saved.arrays:
        inner.state = saved.arrays["state"]  # pyright: ignore[reportAttributeAccessIssue]
    else:
        _set_mujoco(inner, saved)
    for limit, elapsed in zip(_time_limits(environment) or (), values["elapsed_steps"], strict=True):
        limit._elapsed_steps = elapsed
    inner.np_random.bit_generator.state = values["generator"]


def _time_limits(environment: gymnasium.Env) -> list[TimeLimit] | None:
    """Return the time limits around an environment, or None if another wrapper may hold state of its own."""
    limits = []
    while environment is not environment.unwrapped:
        if type(environment) not in _KNOWN_WRAPPERS:
            return None
        if isinstance(environment, TimeLimit):
            limits.append(environment)
        environment = environment.env  # pyright: ignore[reportAttributeAccessIssue]
    return limits


def _is_gymnasiums(kind: str, environment: gymnasium.Env) -> bool:
    """Return whether this is one of Gymnasium's own tasks of a kind. A subclass may have more state."""
    return type(environment).__module__.startswith(f"gymnasium.envs.{kind}.")


def _mujoco_arrays(environment: Any) -> dict[str, np.ndarray]:
    """Return views of all arrays of MjData that persist from step to step.

    Positions and velocities are not enough: Ant's reward reads body positions of the previous step.
    """
    data = environment.data
    names = (name for name in dir(data) if not name.startswith(("_", *_RECOMPUTED)))
    arrays = ((name, getattr(data, name)) for name in names)
    return {name: array for name, array in arrays if isinstance(array, np.ndarray) and array.size}


def _set_mujoco(environment: Any, saved: Snapshot) -> None:
    arrays = _mujoco_arrays(environment)
    stored = {name.removeprefix("mujoco."): array for name, array in saved.arrays.items()}
    if {name: array.shape for name, array in arrays.items()} != {name: array.shape for name, array in stored.items()}:
        raise ValueError("its physics has other arrays: MuJoCo or the task has changed")
    for name, array in arrays.items():
        array[...] = stored[name]
    environment.data.time = saved.values["mujoco_time"]
