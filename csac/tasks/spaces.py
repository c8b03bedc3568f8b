"""Which spaces are accepted, and the order of their parts in one vector, which `Environment` and `Contract` join."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from csac.types import InputError

Parts = tuple[tuple[str | None, tuple[int, ...]], ...]

FLOAT32_MAX = float(np.finfo(np.float32).max)


# What an environment may raise that is its own failure; a script that ends with `sys.exit` is one too.
RAISED = (Exception, SystemExit)


class EnvironmentFailure(RuntimeError):
    """An environment raised, or gave what is not a finite number of the right shape. The message is one line."""


class ContractParts(NamedTuple):
    """What a `Contract` records of an environment, in the order in which it takes them."""

    observation_parts: Parts
    action_shape: tuple[int, ...]
    action_low: np.ndarray  # [action] float32
    action_high: np.ndarray  # [action] float32


def observation_parts(space: spaces.Space) -> Parts:
    """Return the parts of a Box or Dict of Boxes in their flat order. Raises InputError for any other space."""
    keys = list(space.spaces) if isinstance(space, spaces.Dict) else []
    if unnamed := [key for key in keys if not isinstance(key, str)]:
        raise InputError(
            f"the observation has the key {unnamed[0]!r}, which is no text: give each part of the Dict a name"
        )
    named = [(key, space[key]) for key in sorted(keys)] if isinstance(space, spaces.Dict) else [(None, space)]
    for key, part in named:
        name = "the observation" if key is None else f"observation[{key!r}]"
        if not isinstance(part, spaces.Box):
            raise InputError(
                f"{name} is a {type(part).__name__} and csac takes Boxes, or one Dict of Boxes: "
                "wrap the environment in gymnasium.wrappers.FlattenObservation"
            )
        if part.dtype == np.uint8 and part.low.ndim == 3:
            raise InputError(
                f"{name} is an image {part.low.shape}, which csac does not learn from: choose a vector of states"
            )
        if key is not None and not part.low.size:
            raise InputError(f"{name} is empty, a Box of shape {part.shape}: leave it out")
    parts = tuple((key, tuple(part.shape or ())) for key, part in named)
    if not size(parts):
        raise InputError("the observation is empty: there is nothing to learn from")
    return parts


def action_parts(space: spaces.Space) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
    """Return shape and flat float32 bounds of a bounded Box of floats. Raises InputError for any other space."""
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise InputError(f"the action space is {space} and csac takes continuous actions, a Box of floats")
    low, high = _float32_within(space.low.reshape(-1), space.high.reshape(-1))
    if not low.size:
        raise InputError("the action space is empty: there is nothing to learn")
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise InputError(
            "the action space has infinite bounds: give it finite ones, as gymnasium.wrappers.TransformAction("
            f"environment, lambda action: action, gymnasium.spaces.Box(-1.0, 1.0, {space.shape})) does"
        )
    return space.low.shape, low, high


def _float32_within(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Round bounds to float32 towards the inside, so that a float64 Box holds what we send.

    Where no float32 lies between them, both are the nearest.
    """
    with np.errstate(over="ignore"):
        nearest_low, nearest_high = low.astype(np.float32), high.astype(np.float32)
    inner_low = _moved(nearest_low, nearest_low < low, np.inf)
    inner_high = _moved(nearest_high, nearest_high > high, -np.inf)
    is_between = inner_low <= inner_high
    return np.where(is_between, inner_low, nearest_low), np.where(is_between, inner_high, nearest_high)


def _moved(rounded: np.ndarray, outside: np.ndarray, direction: float) -> np.ndarray:
    """Return float32 numbers, those that lie outside as the next one in this direction."""
    return np.where(outside & np.isfinite(rounded), np.nextafter(rounded, np.float32(direction)), rounded)


def size(parts: Parts) -> int:
    """Return how many numbers all parts have together."""
    return sum(math.prod(shape) for _, shape in parts)


def dict_part(observation: Any, key: str | None, shape: tuple[int, ...]) -> np.ndarray:
    """Return one part of a Dict observation, as `part`. Raises EnvironmentFailure."""
    if not isinstance(observation, dict) or key not in observation:
        raise EnvironmentFailure(f"observation has no {key!r}")
    return part(observation[key], shape, f"observation[{key!r}]")


def part(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Return a float32 copy of one part of an observation, flat and finite. Raises EnvironmentFailure."""
    try:
        array = np.asarray(value)
        flat = array.reshape(-1)
        # One product finds a nan, an inf or what float32 cannot hold in a third of the time of np.isfinite().all().
        if array.shape == shape and float(flat.dot(flat)) <= FLOAT32_MAX:
            return flat.astype(np.float32)
        with np.errstate(over="ignore"):
            flat = flat.astype(np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise EnvironmentFailure(f"{name} is not an array of numbers: {one_line(error)}") from error
    if array.shape != shape:
        raise EnvironmentFailure(f"{name} has shape {array.shape} where its space has {shape}")
    check_finite(flat, shape, name)
    return flat


def check_finite(flat: np.ndarray, shape: tuple[int, ...], name: str) -> None:
    """Raise EnvironmentFailure, with its place in an array of this shape, for the first number that is not finite."""
    bad = np.flatnonzero(~np.isfinite(flat))
    if bad.size:
        place = ", ".join(str(i) for i in np.unravel_index(bad[0], shape))
        raise EnvironmentFailure(f"{name}{f'[{place}]' if place else ''} is {flat[bad[0]]}")


def scalar(reward: Any) -> float:
    """Return a reward as a float. Raises EnvironmentFailure where it is not one finite number."""
    if isinstance(reward, np.ndarray) and reward.ndim:
        raise EnvironmentFailure(f"reward has shape {reward.shape} and is to be one number")
    try:
        reward = float(reward)
    except (TypeError, ValueError):
        raise EnvironmentFailure(f"reward is a {type(reward).__name__} and is to be one number") from None
    except OverflowError:
        raise EnvironmentFailure("reward is a whole number that no float can hold") from None
    if not abs(reward) <= FLOAT32_MAX:
        raise EnvironmentFailure(f"reward is {reward}")
    return reward


def message(error: BaseException) -> str:
    """Return what an error says, in one line that every file and terminal takes."""
    try:
        text = str(error)
    except Exception as unsaid:
        text = f"(saying what it is raised {type(unsaid).__name__})"
    return " ".join(text.encode("utf-8", "backslashreplace").decode().split())


def one_line(error: BaseException) -> str:
    """Return an error's type and what it says, in one line."""
    told = message(error)
    return f"{type(error).__name__}: {told}" if told else type(error).__name__
