"""Wrap a Gymnasium environment: flat observations, actions in [-1, 1], both end flags, true final observations."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

from csac.checks import check_arguments
from csac.deploy.contract import ActionBounds
from csac.tasks import snapshots
from csac.tasks.failures import EnvironmentFailure, failure_of, one_line, raise_interrupt
from csac.tasks.perturbations import NOISES, PHYSICS, Noise, Physics
from csac.tasks.pybullet import quietly
from csac.tasks.registry import Task, has_memory, is_pybullet, make, task_name
from csac.tasks.spaces import contract_parts, dict_part, part, scalar
from csac.types import InputError, Snapshot, Spec

_log = logging.getLogger(__name__)
_made: WeakValueDictionary[int, Any] = WeakValueDictionary()  # the environments that tasks have made, by their id


class Environment:
    """One Gymnasium environment with flat float32 observations and actions in [-1, 1].

    A task is a Gymnasium id, `module:Id` (the module is imported first), or a callable that returns an environment.
    Whatever an environment raises, even a panic of native code, becomes an EnvironmentFailure.
    """

    def __init__(
        self, task: Task, environment_arguments: dict[str, Any] | None = None, render_mode: str | None = None
    ) -> None:
        check_arguments("environment_arguments", environment_arguments)
        arguments = dict(environment_arguments or {})
        self.raw = make(task, arguments if render_mode is None else {**arguments, "render_mode": render_mode})
        self.task_name = task_name(task, self.raw)
        if id(self.raw.unwrapped) in _made:
            raise InputError(f"{self.task_name} returned the same environment again: make a new one in each call")
        _made[id(self.raw.unwrapped)] = self.raw.unwrapped
        self._quietly = quietly if is_pybullet(self.raw) else nullcontext
        self.has_memory = has_memory(task, self.raw)
        try:
            modes = self.raw.metadata.get("render_modes", [])
            if render_mode is not None and render_mode not in modes:
                raise InputError(f"no render mode {render_mode!r}: it has {', '.join(modes) or 'none'}")
            self.contract_parts = contract_parts(self.raw)
        except InputError as error:
            self.close()
            raise InputError(f"{self.task_name}: {error}") from None
        self._parts, self._action_shape, low, high = self.contract_parts
        self.spec = Spec(sum(math.prod(shape) for _, shape in self._parts), math.prod(self._action_shape))
        self.bounds = ActionBounds(low, high)
        self.raw_observation: Any = None  # the latest, as returned by the environment
        self._physics: Physics | None = None
        self._noise: Noise | None = None
        self._seed: int | None = None  # of the last reset

    def perturb(self, values: Mapping[str, float]) -> None:
        """Perturb the task from its next step on, permanently. `values` are by kind (`perturbations.KINDS`).

        A factor of 1, a noise of 0 and a missing kind mean none. Raise InputError if the task has no such physics.
        """
        physics = {kind: values[kind] for kind in PHYSICS if kind in values}
        noise = {kind: values[kind] for kind in NOISES if kind in values}
        if physics or self._physics:
            self._physics = self._physics or Physics(self.raw, self.task_name)
            self._physics.set(physics)
        if noise or self._noise:
            self._noise = self._noise or Noise()
            self._noise.set(noise, self._seed)

    def reset(self, seed: int) -> np.ndarray:
        """Start an episode and return its first observation, float32 [observation].

        Raise EnvironmentFailure also if it is non-finite or has a wrong shape, or if the reset undoes `perturb`.
        """
        self._seed = seed
        if self._noise:
            self._noise.begin(seed)
        try:
            with self._quietly():
                observation, _ = self.raw.reset(seed=seed)
        except BaseException as error:
            raise failure_of("reset", error) from error
        if self._physics and (undone := self._physics.undone()):
            raise EnvironmentFailure(undone)
        try:
            return self._flatten(observation)
        except EnvironmentFailure as error:
            raise EnvironmentFailure(f"{error} after reset") from error.__cause__

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply an action [action] in [-1, 1]; return observation [observation], reward, both end flags and `info`."""
        return self.step_environment_scale(self.bounds.scale(action).reshape(self._action_shape))

    def step_environment_scale(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply an action of the environment's own shape and scale; return the same as `step`.

        `info` is a copy: PyFlyt returns the same dict at every step of an episode. Raise EnvironmentFailure also if
        action, observation or reward is non-finite or has a wrong shape.
        """
        action = part(action, self._action_shape, "action")
        if self._noise:
            action = self._noise.on_action(action, self.contract_parts.action_low, self.contract_parts.action_high)
        action = action.reshape(self._action_shape)
        try:
            observation, reward, terminated, truncated, info = self.raw.step(action)
            terminated, truncated, info = bool(terminated), bool(truncated), dict(info)
        except BaseException as error:
            raise failure_of("step", error) from error
        return self._flatten(observation), scalar(reward), terminated, truncated, info

    def relabel(self, achieved: np.ndarray, desired: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the rewards [n] for flat achieved and desired goals [n, goal], and whether these terminate an episode.

        The latter is [n] bool, or None if the task has no `compute_terminated`. Both are computed one pair at a time,
        with an empty info, since not every task accepts batches.
        """
        shape = dict(self._parts)["achieved_goal"]
        pairs = [(a.reshape(shape), d.reshape(shape)) for a, d in zip(achieved, desired, strict=True)]
        try:
            reward_of, terminated = self.raw.get_wrapper_attr("compute_reward"), None
            rewards = [reward_of(*pair, {}) for pair in pairs]
            if self.raw.has_wrapper_attr("compute_terminated"):
                ends = self.raw.get_wrapper_attr("compute_terminated")
                terminated = np.array([bool(ends(*pair, {})) for pair in pairs], bool)
        except BaseException as error:
            raise failure_of("compute_reward", error) from error
        return np.array([scalar(reward) for reward in rewards], np.float32), terminated

    def snapshot(self) -> Snapshot | None:
        """Return the state of the episode in progress for an exact resume, or None if the environment has no snapshots.

        Raise EnvironmentFailure also if the snapshot cannot be saved.
        """
        try:
            saved = snapshots.snapshot(self.raw)
        except BaseException as error:
            raise failure_of("get_snapshot", error) from error
        if saved:
            _check_savable(saved)
        if saved and self._noise:
            saved.values["noise"] = self._noise.state()
        return saved

    def restore(self, seed: int, saved: Snapshot) -> None:
        """Continue from the snapshot `saved` of an episode that was reset with `seed`."""
        self.reset(seed)
        try:
            snapshots.restore(self.raw, saved)
            if self._noise:
                self._noise.restore(saved.values.get("noise", {}))
        except BaseException as error:
            raise failure_of("restoring its snapshot", error) from error

    def close(self) -> None:
        """Close the Gymnasium environment. Exceptions are only logged, since earlier results remain valid."""
        try:
            with self._quietly():
                self.raw.close()
        except BaseException as error:
            raise_interrupt(error)
            _log.warning("%s: close raised %s", self.task_name, one_line(error))

    def _flatten(self, observation: Any) -> np.ndarray:
        """Flatten an observation into a copy, since environments may reuse their array."""
        self.raw_observation = observation
        key, shape = self._parts[0]
        if key is None:
            flat = part(observation, shape, "observation")
        else:
            flat = np.concatenate([dict_part(observation, key, shape) for key, shape in self._parts])
        return self._with_noise(flat) if self._noise else flat

    def _with_noise(self, flat: np.ndarray) -> np.ndarray:
        """Return the flat observation with noise, and set `raw_observation` to the same in the task's own structure."""
        assert self._noise
        noisy = self._noise.on_observation(flat)
        ends = np.cumsum([math.prod(shape) for _, shape in self._parts])[:-1]
        raw = {key: part.reshape(shape) for (key, shape), part in zip(self._parts, np.split(noisy, ends), strict=True)}
        self.raw_observation = raw.get(None, raw)
        return noisy


def _check_savable(saved: Snapshot) -> None:
    """Raise EnvironmentFailure if a snapshot cannot be stored as numeric arrays and JSON."""
    for name, array in saved.arrays.items():
        if array.dtype.kind not in "biuf":
            raise EnvironmentFailure(f"get_snapshot gave {name.removeprefix('own.')!r}, which is no array of numbers")
    try:
        json.dumps(saved.values)
    except (TypeError, ValueError, RecursionError) as error:
        raise EnvironmentFailure(f"get_snapshot gave values that JSON cannot hold: {one_line(error)}") from error
