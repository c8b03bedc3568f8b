"""Gymnasium in, arrays out: flat observations, actions in [-1, 1], both end flags, the true final observation."""

from __future__ import annotations

import difflib
import importlib
import logging
import math
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from csac.deploy.policy import ActionBounds
from csac.training import tasks
from csac.training.perturb import NOISES, PHYSICS, Noise, Physics
from csac.training.silence import quietly
from csac.training.snapshots import Snapshot, restore, snapshot
from csac.types import InputError, Spec

Task = str | Callable[..., gymnasium.Env]
Parts = tuple[tuple[str | None, tuple[int, ...]], ...]

EVALUATION_SEED = 1_000_000
FRESH_EVALUATION_SEED = 2_000_000

_FIRST_TRAINING_SEED = 2**30  # above every evaluation seed, and with as many again still a C int
_FLOAT32_MAX = float(np.finfo(np.float32).max)

_log = logging.getLogger(__name__)


def training_seed(seed: int, episode: int) -> int:
    """Return the reset seed of a seed's training episode: its own, and never an evaluation episode's."""
    word = int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])
    return _FIRST_TRAINING_SEED + word % _FIRST_TRAINING_SEED


class EnvironmentFailure(RuntimeError):
    """An environment raised, or gave what is not a finite number of the right shape. The message is one line."""


class ContractParts(NamedTuple):
    """What a `Contract` records of an environment, in the order in which it takes them."""

    observation_parts: Parts
    action_shape: tuple[int, ...]
    action_low: np.ndarray  # [action] float32
    action_high: np.ndarray  # [action] float32


class Environment:
    """One Gymnasium environment with flat float32 observations and actions in [-1, 1].

    Args:
        task: a Gymnasium id, `module:Id` (the module is imported first), or a callable that makes an environment.
        environment_arguments: keyword arguments for the environment.
        render_mode: Gymnasium's; None where nothing is drawn.

    Raises:
        InputError: no such task, arguments that it refuses, or observations or actions that csac cannot learn.
    """

    def __init__(
        self, task: Task, environment_arguments: dict[str, Any] | None = None, render_mode: str | None = None
    ) -> None:
        arguments = dict(environment_arguments or {})
        if render_mode is not None:
            arguments["render_mode"] = render_mode
        self.raw = _make(task, arguments)
        self.task_name = _task_name(task, self.raw)
        self._quietly = quietly if tasks.is_pybullet(self.raw) else nullcontext
        self.has_memory = tasks.has_memory(task, self.raw)
        try:
            _check_render_mode(self.raw, render_mode)
            parts = _observation_parts(self.raw.observation_space)
            self.contract_parts = ContractParts(parts, *_action_parts(self.raw.action_space))
        except InputError as error:
            self.close()
            raise InputError(f"{self.task_name}: {error}") from None
        self.spec = Spec(_size(parts), math.prod(self.contract_parts.action_shape))
        self.bounds = ActionBounds(self.contract_parts.action_low, self.contract_parts.action_high)
        self.raw_observation: Any = None  # the last one, as the environment gave it
        self._parts = parts
        self._action_shape = self.contract_parts.action_shape
        self._physics: Physics | None = None
        self._noise: Noise | None = None
        self._seed: int | None = None  # of the last reset

    def perturb(self, values: Mapping[str, float]) -> None:
        """Change the task from its next step on, for good: a value for each kind of `perturb.KINDS`, 1 or 0 for none.

        Raises:
            InputError: the task has no such physics.
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

        Raises:
            EnvironmentFailure: the environment raised, or the observation is not finite or misshapen.
        """
        self._seed = seed
        if self._noise:
            self._noise.begin(seed)
        try:
            with self._quietly():
                observation, _ = self.raw.reset(seed=seed)
        except Exception as error:
            raise EnvironmentFailure(f"reset raised {_one_line(error)}") from error
        try:
            return self._flatten(observation)
        except EnvironmentFailure as error:
            raise EnvironmentFailure(f"{error} after reset") from error.__cause__

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply an action in [-1, 1], [action]: observation [observation], reward, terminated, truncated, info.

        Raises:
            EnvironmentFailure: as `step_environment_scale`.
        """
        return self.step_environment_scale(self.bounds.scale(action).reshape(self._action_shape))

    def step_environment_scale(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply an action of the environment's own shape and scale; returns the same as `step`.

        `info` is a copy: PyFlyt gives the same dict at every step of an episode.

        Raises:
            EnvironmentFailure: the environment raised, or action, observation or reward is not finite or misshapen.
        """
        action = _part(action, self._action_shape, "action")
        if self._noise:
            action = self._noise.on_action(action, self.contract_parts.action_low, self.contract_parts.action_high)
        action = action.reshape(self._action_shape)
        try:
            observation, reward, terminated, truncated, info = self.raw.step(action)
            terminated, truncated, info = bool(terminated), bool(truncated), dict(info)
        except Exception as error:
            raise EnvironmentFailure(f"step raised {_one_line(error)}") from error
        return self._flatten(observation), _scalar(reward), terminated, truncated, info

    def snapshot(self) -> Snapshot | None:
        """Return what the episode in progress needs to go on exactly, or None where the environment cannot tell."""
        saved = snapshot(self.raw)
        if saved and self._noise:
            saved.values["noise"] = self._noise.state()
        return saved

    def restore(self, seed: int, saved: Snapshot) -> None:
        """Go on where `saved` was taken, in an episode that was reset with `seed`.

        Raises:
            EnvironmentFailure: the environment does not take it back.
        """
        self.reset(seed)
        try:
            restore(self.raw, saved)
            if self._noise:
                self._noise.take_back(saved.values.get("noise", {}))
        except Exception as error:
            raise EnvironmentFailure(f"the environment does not take its snapshot back: {_one_line(error)}") from error

    def close(self) -> None:
        """Close the Gymnasium environment."""
        with self._quietly():
            self.raw.close()

    def _flatten(self, observation: Any) -> np.ndarray:
        """Copy the observation, since environments may reuse their array."""
        self.raw_observation = observation
        key, shape = self._parts[0]
        if key is None:
            flat = _part(observation, shape, "observation")
        else:
            flat = np.concatenate([_dict_part(observation, key, shape) for key, shape in self._parts])
        return self._with_noise(flat) if self._noise else flat

    def _with_noise(self, flat: np.ndarray) -> np.ndarray:
        """Return the flat observation with its noise, and let `raw_observation` be the same in the task's own shape."""
        assert self._noise
        noisy = self._noise.on_observation(flat)
        _check_finite(noisy, noisy.shape, "the observation with its noise")
        ends = np.cumsum([math.prod(shape) for _, shape in self._parts])[:-1]
        raw = {key: part.reshape(shape) for (key, shape), part in zip(self._parts, np.split(noisy, ends), strict=True)}
        self.raw_observation = raw.get(None, raw)
        return noisy


class FinishedEpisode(NamedTuple):
    """A training episode that ended; `index` is the seed's place in the group."""

    index: int
    episode_return: float
    length: int


class Failure(NamedTuple):
    """A seed whose environment failed: why in one line, and the traceback where something raised."""

    index: int
    reason: str
    details: str


class Steps(NamedTuple):
    """One step of every seed, in new arrays to be read only; a failed seed's rows stay at its last good values."""

    next_observation: np.ndarray  # [seed, observation] what the step gave, also where the episode ended
    reward: np.ndarray  # [seed] float32
    terminated: np.ndarray  # [seed] bool
    truncated: np.ndarray  # [seed] bool
    observation: np.ndarray  # [seed, observation] what to act on next: a first observation where an episode ended
    episodes: list[FinishedEpisode]
    failures: list[Failure]


class SeedEnvironments:
    """One environment per seed, reset by itself where an episode ends, each episode with its own derived seed.

    A seed fails alone: where its environment raises or gives what is not finite, it is reported once and never stepped
    again. `alive` [seed] says which seeds still step; it turns false with the report.

    Raises:
        InputError: as `Environment`.
    """

    def __init__(self, task: Task, environment_arguments: dict[str, Any] | None, seeds: Sequence[int]) -> None:
        self.environments = [Environment(task, environment_arguments) for _ in seeds]
        first = self.environments[0]
        self.spec, self.contract_parts, self.task_name = first.spec, first.contract_parts, first.task_name
        self.seeds = tuple(seeds)
        self.alive = np.ones(len(seeds), bool)
        self._running = list(range(len(seeds)))
        self._bounds = first.bounds
        self._action_shape = first.contract_parts.action_shape
        self._observation = np.zeros((len(seeds), self.spec.observation_size), np.float32)
        self._reward = np.zeros(len(seeds), np.float32)
        self._begun = [0] * len(seeds)
        self._returns = [0.0] * len(seeds)
        self._lengths = [0] * len(seeds)
        self._failures: list[Failure] = []

    def reset(self) -> np.ndarray:
        """Start the next episode of every seed: observations [seed, observation].

        A seed that fails here is reported by the next `step`.
        """
        self._observation = self._observation.copy()
        for index in self._running:
            self._reset(index)
        return self._observation

    def perturb(self, values: Mapping[str, float]) -> None:
        """Change every seed's task, as `Environment.perturb`."""
        for environment in self.environments:
            environment.perturb(values)

    def step(self, actions: np.ndarray) -> Steps:
        """Step every seed that is alive with its action in [-1, 1], [seed, action]."""
        scaled = self._bounds.scale(actions).reshape(-1, *self._action_shape)
        next_observation, reward = self._observation.copy(), self._reward.copy()
        terminated, truncated = np.zeros(len(reward), bool), np.zeros(len(reward), bool)
        episodes: list[FinishedEpisode] = []
        for index in self._running:
            try:
                step = self.environments[index].step_environment_scale(scaled[index])
            except EnvironmentFailure as error:
                self._fail(index, error)
                continue
            next_observation[index], reward[index], terminated[index], truncated[index], _ = step
            self._returns[index] += step[1]
            self._lengths[index] += 1
            if step[2] or step[3]:
                episodes.append(FinishedEpisode(index, self._returns[index], self._lengths[index]))
        self._observation, self._reward = next_observation.copy(), reward
        for episode in episodes:
            self._reset(episode.index)
        failures, self._failures = self._failures, []
        for failure in failures:
            self.alive[failure.index] = False
        return Steps(next_observation, reward, terminated, truncated, self._observation, episodes, failures)

    def stop(self, index: int) -> None:
        """Step the seed at this place in the group no more."""
        self.alive[index] = False
        self._rest(index)

    def save(self, index: int) -> Snapshot:
        """Return what the seed at this place needs to go on; without "exact", from the start of its episode."""
        inner = self.environments[index].snapshot() if self.alive[index] else None
        arrays = {"observation": self._observation[index].copy(), **(inner.arrays if inner else {})}
        values = {
            "alive": bool(self.alive[index]),
            "reward": float(self._reward[index]),
            "episodes_begun": self._begun[index],
            "episode_return": self._returns[index],
            "episode_length": self._lengths[index],
            "exact": inner is not None,
            "environment": inner.values if inner else {},
        }
        return Snapshot(arrays, values)

    def take_back(self, index: int, saved: Snapshot) -> bool:
        """Let the seed at this place go on from `save`; return false where its episode had to start anew.

        A seed whose environment fails here is reported by the next `step`.
        """
        arrays, values = dict(saved.arrays), saved.values
        self._begun[index] = values["episodes_begun"]
        self._observation, self._reward = self._observation.copy(), self._reward.copy()
        self._observation[index], self._reward[index] = arrays.pop("observation"), values["reward"]
        if not values["alive"]:
            self.stop(index)
        elif values["exact"]:
            self._returns[index], self._lengths[index] = values["episode_return"], values["episode_length"]
            seed = training_seed(self.seeds[index], self._begun[index] - 1)
            try:
                self.environments[index].restore(seed, Snapshot(arrays, values["environment"]))
            except EnvironmentFailure as error:
                self._fail(index, error)
        else:
            self._begun[index] -= 1
            self._reset(index)
            return False
        return True

    @property
    def is_any_alive(self) -> bool:
        """Whether a seed still steps, or its failure is yet to be reported."""
        return bool(self._running or self._failures)

    @property
    def observations(self) -> np.ndarray:
        """What to act on next: [seed, observation]."""
        return self._observation

    def close(self) -> None:
        """Close every environment."""
        for environment in self.environments:
            environment.close()

    def _reset(self, index: int) -> None:
        self._returns[index], self._lengths[index] = 0.0, 0
        seed = training_seed(self.seeds[index], self._begun[index])
        self._begun[index] += 1
        try:
            self._observation[index] = self.environments[index].reset(seed)
        except EnvironmentFailure as error:
            self._fail(index, error)

    def _rest(self, index: int) -> None:
        self._running = [other for other in self._running if other != index]

    def _fail(self, index: int, error: EnvironmentFailure) -> None:
        self._rest(index)
        details = "".join(traceback.format_exception(error)) if error.__cause__ else ""
        self._failures.append(Failure(index, str(error), details))


def _make(task: Task, arguments: dict[str, Any]) -> gymnasium.Env:
    name = task if isinstance(task, str) else _name_of(task) or "the task"
    adapter = tasks.adapter_of(task)
    _silence_mujoco()
    with _gymnasium_silenced(), quietly() if adapter or "pybullet" in sys.modules else nullcontext():
        registered = _registered(task) if isinstance(task, str) else None
        try:
            if registered is not None:
                environment = gymnasium.make(registered, disable_env_checker=True, **arguments)
                environment = adapter.wrap(environment) if adapter and adapter.wrap else environment
            else:
                environment = task(**arguments)  # pyright: ignore[reportCallIssue]
        except (gymnasium.error.DependencyNotInstalled, ImportError) as error:
            if adapter:
                raise InputError(tasks.missing(name, error)) from error
            raise InputError(f"{name} needs a package that is not installed: {_message(error)}") from error
        except Exception as error:
            given = f" with the arguments {arguments}" if arguments else ""
            raise InputError(f"{name} could not be made{given}: {_one_line(error)}") from error
    if not isinstance(environment, gymnasium.Env):
        raise InputError(f"{name} gave a {type(environment).__name__}: a task's callable returns a gymnasium.Env")
    return environment


def _registered(task: str) -> str:
    """Return the registered id, after importing its module where one is named."""
    module, _, name = task.rpartition(":")
    if module:
        try:
            importlib.import_module(module)
        except Exception as error:
            raise InputError(f"{task}: the module {module} cannot be imported: {_one_line(error)}") from error
    tasks.register(name)
    if name in gymnasium.registry and not _is_gone(gymnasium.registry[name]):
        return name
    known = sorted({*tasks.ADAPTERS, *(id for id, spec in gymnasium.registry.items() if not _is_gone(spec))})
    family = name.rpartition("-v")[0] or name
    versions = [id for id in known if id.rpartition("-v")[0] == family]
    lower = {id.lower(): id for id in known}
    nearest = versions or [lower[match] for match in difflib.get_close_matches(name.lower(), lower)]
    hint = f"did you mean {' or '.join(nearest)}?" if nearest else "write module:Id for one that a module registers"
    raise InputError(f"no task is called {task}: {hint}")


def _is_gone(spec: Any) -> bool:
    """Whether Gymnasium registers the id only to say that it has moved (MuJoCo's v2 and v3)."""
    return getattr(spec.entry_point, "__name__", "") == "_raise_mujoco_py_error"


def _silence_mujoco() -> None:
    """Send MuJoCo's warnings to the log: by itself it prints them, and writes MUJOCO_LOG.TXT where the user works."""
    try:
        mujoco = importlib.import_module("mujoco")
    except Exception:  # a task that needs it says so
        return
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_log.info)


@contextmanager
def _gymnasium_silenced() -> Iterator[None]:
    """Hide Gymnasium's own warnings, such as that an id has a newer version, and nobody else's."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r".*WARN: ")
        yield


def _name_of(task: Callable[..., gymnasium.Env]) -> str:
    name = getattr(task, "__name__", "")
    return "" if name == "<lambda>" else name


def _task_name(task: Task, environment: gymnasium.Env) -> str:
    if isinstance(task, str):
        return task
    return _name_of(task) or (environment.spec.id if environment.spec else type(environment.unwrapped).__name__)


def _check_render_mode(environment: gymnasium.Env, render_mode: str | None) -> None:
    known = environment.metadata.get("render_modes", [])
    if render_mode is not None and render_mode not in known:
        raise InputError(f"no render mode {render_mode!r}: it has {', '.join(known) or 'none'}")


def _observation_parts(space: spaces.Space) -> Parts:
    named = sorted(space.spaces.items()) if isinstance(space, spaces.Dict) else [(None, space)]
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
    parts = tuple((key, tuple(part.shape or ())) for key, part in named)
    if not _size(parts):
        raise InputError("the observation is empty: there is nothing to learn from")
    return parts


def _action_parts(space: spaces.Space) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise InputError(f"the action space is {space} and csac takes continuous actions, a Box of floats")
    low, high = _inner_float32(space.low, 1), _inner_float32(space.high, -1)
    if not low.size:
        raise InputError("the action space is empty: there is nothing to learn")
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise InputError("the action space has no bounds: wrap the environment in gymnasium.wrappers.RescaleAction")
    return space.low.shape, low, high


def _inner_float32(bound: np.ndarray, direction: int) -> np.ndarray:
    """Round a bound to float32 towards the inside, so that a float64 Box holds what we send."""
    exact = bound.reshape(-1)
    with np.errstate(over="ignore"):
        rounded = exact.astype(np.float32)
    outside = rounded < exact if direction > 0 else rounded > exact
    return np.where(outside & np.isfinite(rounded), np.nextafter(rounded, np.float32(direction * np.inf)), rounded)


def _size(parts: Parts) -> int:
    return sum(math.prod(shape) for _, shape in parts)


def _dict_part(observation: Any, key: str | None, shape: tuple[int, ...]) -> np.ndarray:
    if not isinstance(observation, dict) or key not in observation:
        raise EnvironmentFailure(f"observation has no {key!r}")
    return _part(observation[key], shape, f"observation[{key!r}]")


def _part(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Return a float32 copy of one part of an observation, flat and finite."""
    try:
        array = np.asarray(value)
        flat = array.reshape(-1)
        # One product finds a nan, an inf or what float32 cannot hold in a third of the time of np.isfinite().all().
        if array.shape == shape and float(flat.dot(flat)) <= _FLOAT32_MAX:
            return flat.astype(np.float32)
        with np.errstate(over="ignore"):
            flat = flat.astype(np.float32)
    except (TypeError, ValueError) as error:
        raise EnvironmentFailure(f"{name} is not an array of numbers: {_one_line(error)}") from error
    if array.shape != shape:
        raise EnvironmentFailure(f"{name} has shape {array.shape} where its space has {shape}")
    _check_finite(flat, shape, name)
    return flat


def _check_finite(flat: np.ndarray, shape: tuple[int, ...], name: str) -> None:
    bad = np.flatnonzero(~np.isfinite(flat))
    if bad.size:
        place = ", ".join(str(i) for i in np.unravel_index(bad[0], shape))
        raise EnvironmentFailure(f"{name}{f'[{place}]' if place else ''} is {flat[bad[0]]}")


def _scalar(reward: Any) -> float:
    if isinstance(reward, np.ndarray) and reward.ndim:
        raise EnvironmentFailure(f"reward has shape {reward.shape} and is to be one number")
    try:
        reward = float(reward)
    except (TypeError, ValueError):
        raise EnvironmentFailure(f"reward is a {type(reward).__name__} and is to be one number") from None
    if not abs(reward) <= _FLOAT32_MAX:
        raise EnvironmentFailure(f"reward is {reward}")
    return reward


def _message(error: Exception) -> str:
    return " ".join(str(error).split())


def _one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {_message(error)}" if str(error) else type(error).__name__
