"""Check spaces, and define the order of their parts in the flat vectors of `Environment` and `Contract`."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from csac.deploy.contract import FLOAT32_MAX
from csac.tasks.failures import EnvironmentFailure, one_line, raised
from csac.types import InputError

Parts = tuple[tuple[str | None, tuple[int, ...]], ...]


class ContractParts(NamedTuple):
    """The fields of a `Contract` that come from an environment, in its order."""

    observation_parts: Parts
    action_shape: tuple[int, ...]
    action_low: np.ndarray  # [action] float32
    action_high: np.ndarray  # [action] float32


def contract_parts(environment: gymnasium.Env) -> ContractParts:
    """Return the parts of an environment's spaces. Raise InputError for spaces that csac does not support."""
    try:
        observation, action = environment.observation_space, environment.action_space
    except Exception as error:
        raise InputError(f"the environment lacks a space: {raised(error)}") from None
    return ContractParts(observation_parts(observation), *action_parts(action))


def observation_parts(space: object) -> Parts:
    """Return the parts of a Box or Dict of Boxes in their flat order. Raise InputError for any other space."""
    named: dict[Any, object] = dict(space.spaces) if isinstance(space, spaces.Dict) else {None: space}
    parts = []
    for key, part in sorted(named.items(), key=lambda item: str(item[0])):
        name = "the observation" if key is None else f"observation[{key!r}]"
        if not isinstance(part, spaces.Box) or not isinstance(key, str | None):
            raise InputError(
                f"{name} is a {type(part).__module__}.{type(part).__name__}, and csac takes gymnasium's Box, or a Dict "
                "of Boxes with names: wrap the environment in gymnasium.wrappers.FlattenObservation"
            )
        if part.dtype == np.uint8 and len(part.shape) == 3:
            raise InputError(f"{name} is an image {part.shape}: csac learns from vectors of states")
        if not math.prod(part.shape):
            raise InputError(f"{name} is empty: its shape is {part.shape}")
        parts.append((key, tuple(part.shape)))
    if not parts:
        raise InputError("the observation is an empty Dict")
    return tuple(parts)


def action_parts(space: object) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
    """Return shape and flat float32 bounds of a bounded Box of floats. Raise InputError for any other space."""
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating) or not space.low.size:
        raise InputError(f"the action space is {space}, and csac takes continuous actions, gymnasium's Box of floats")
    low, high = _float32_within(space.low.reshape(-1), space.high.reshape(-1))
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise InputError(
            "the action space has infinite bounds: give it finite ones, as gymnasium.wrappers.TransformAction("
            f"environment, lambda action: action, gymnasium.spaces.Box(-1.0, 1.0, {space.shape})) does"
        )
    return space.low.shape, low, high


def _float32_within(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Round bounds inwards to float32, so that a float64 Box contains the actions sent to it.

    If no float32 lies between them, round both to the nearest.
    """
    with np.errstate(over="ignore"):
        nearest_low, nearest_high = low.astype(np.float32), high.astype(np.float32)
    inner_low = _moved(nearest_low, nearest_low < low, np.inf)
    inner_high = _moved(nearest_high, nearest_high > high, -np.inf)
    is_between = inner_low <= inner_high
    return np.where(is_between, inner_low, nearest_low), np.where(is_between, inner_high, nearest_high)


def _moved(rounded: np.ndarray, outside: np.ndarray, direction: float) -> np.ndarray:
    """Return float32 numbers, with finite ones that lie `outside` moved to the next float in `direction`."""
    return np.where(outside & np.isfinite(rounded), np.nextafter(rounded, np.float32(direction)), rounded)


def dict_part(observation: Any, key: str | None, shape: tuple[int, ...]) -> np.ndarray:
    """Return one part of a Dict observation, as `part` does. Raise EnvironmentFailure if it is missing or invalid."""
    if not isinstance(observation, dict) or key not in observation:
        raise EnvironmentFailure(f"observation has no {key!r}")
    return part(observation[key], shape, f"observation[{key!r}]")


def part(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Return a flat float32 copy of an array. Raise EnvironmentFailure if it is non-finite or has a wrong shape."""
    try:
        array = np.asarray(value)
        flat = array.reshape(-1)
        # One dot product detects nan, inf and float32 overflow in a third of the time of np.isfinite().all().
        if array.shape == shape and float(flat.dot(flat)) <= FLOAT32_MAX:
            return flat.astype(np.float32)
        with np.errstate(over="ignore"):
            flat = flat.astype(np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise EnvironmentFailure(f"{name} is not an array of numbers: {one_line(error)}") from error
    if array.shape != shape:
        raise EnvironmentFailure(f"{name} has shape {array.shape} where its space has {shape}")
    bad = np.flatnonzero(~np.isfinite(flat))
    if bad.size:
        place = ", ".join(str(i) for i in np.unravel_index(bad[0], shape))
        raise EnvironmentFailure(f"{name}{f'[{place}]' if place else ''} is {flat[bad[0]]}")
    return flat


def scalar(reward: Any) -> float:
    """Return a reward as a float. Raise EnvironmentFailure if it is not one finite number."""
    if isinstance(reward, np.ndarray) and reward.ndim:
        raise EnvironmentFailure(f"reward has shape {reward.shape} and is to be one number")
    try:
        reward = float(reward)
    except (TypeError, ValueError, OverflowError) as error:
        raise EnvironmentFailure(f"reward is not one number: {one_line(error)}") from None
    if not abs(reward) <= FLOAT32_MAX:
        raise EnvironmentFailure(f"reward is {reward}")
    return reward
