"""The environments of several seeds, stepped together, and which reset seed each of their episodes has."""

from __future__ import annotations

import traceback
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from csac.tasks.environment import Environment
from csac.tasks.failures import EnvironmentFailure
from csac.tasks.registry import Task
from csac.types import Snapshot

# What episode 0 of an evaluation is reset with; the next ones with the numbers after it.
EVALUATION_SEED = 1_000_000  # in training: the curves
FRESH_EVALUATION_SEED = 2_000_000  # of finished policies: what nothing was chosen by
TUNING_EVALUATION_SEED = 3_000_000  # in training for `csac tune`: what hyperparameters are chosen by

FIRST_TRAINING_SEED = 2**30  # above every evaluation seed, and with as many again still a C int


def training_seed(seed: int, episode: int) -> int:
    """Return the reset seed of a seed's training episode: its own, and never an evaluation episode's."""
    word = int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])
    return FIRST_TRAINING_SEED + word % FIRST_TRAINING_SEED


class FinishedEpisode(NamedTuple):
    """A training episode that ended; `place` is the seed's place in the group."""

    place: int
    episode_return: float
    length: int


class Failure(NamedTuple):
    """A seed whose environment failed: why in one line, and the traceback where something raised."""

    place: int
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
        self.refused: dict[int, str] = {}  # why the episode saved of the seed at this place was not restored

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
            self._reset(episode.place)
        failures, self._failures = self._failures, []
        for failure in failures:
            self.alive[failure.place] = False
        return Steps(next_observation, reward, terminated, truncated, self._observation, episodes, failures)

    def stop(self, index: int) -> None:
        """Step the seed at this place in the group no more."""
        self.alive[index] = False
        self._running = [other for other in self._running if other != index]

    def save(self, index: int) -> Snapshot:
        """Return what the seed at this place needs to go on; unless "exact", from the start of its episode.

        "problem" says what is wrong with an environment that offers to be saved and cannot.
        """
        inner, problem = None, ""
        try:
            inner = self.environments[index].snapshot() if self.alive[index] else None
        except EnvironmentFailure as error:
            problem = str(error)
        arrays = {"observation": self._observation[index].copy(), **(inner.arrays if inner else {})}
        values = {
            "alive": bool(self.alive[index]),
            "reward": float(self._reward[index]),
            "episodes_begun": self._begun[index],
            "episode_return": self._returns[index],
            "episode_length": self._lengths[index],
            "exact": inner is not None,
            "problem": problem,
            "environment": inner.values if inner else {},
        }
        return Snapshot(arrays, values)

    def restore(self, index: int, saved: Snapshot) -> bool:
        """Let the seed at this place go on from `save`; return false where its episode had to start anew.

        That is so as well where the environment does not take the snapshot, which `refused` then says. A seed whose
        environment cannot be reset either is reported by the next `step`. Raises KeyError or ValueError where this is
        not what `save` returns.
        """
        arrays, values = dict(saved.arrays), saved.values
        _check_saved(values)
        observation = arrays.pop("observation")
        if observation.shape != self._observation[index].shape:
            raise ValueError(f"an observation has shape {observation.shape}")
        self._begun[index] = values["episodes_begun"]
        self._observation, self._reward = self._observation.copy(), self._reward.copy()
        self._observation[index], self._reward[index] = observation, values["reward"]
        if not values["alive"]:
            self.stop(index)
        elif values["exact"] and self._is_restored(index, Snapshot(arrays, values["environment"])):
            self._returns[index], self._lengths[index] = values["episode_return"], values["episode_length"]
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

    def _is_restored(self, index: int, saved: Snapshot) -> bool:
        """Return whether the environment goes on with its episode; one that was saved by another task may not."""
        try:
            self.environments[index].restore(training_seed(self.seeds[index], self._begun[index] - 1), saved)
        except EnvironmentFailure as error:
            self.refused[index] = str(error)
            return False
        return True

    def _fail(self, index: int, error: EnvironmentFailure) -> None:
        self._running = [other for other in self._running if other != index]
        details = "".join(traceback.format_exception(error)) if error.__cause__ else ""
        self._failures.append(Failure(index, str(error), details))


def _check_saved(values: Mapping[str, Any]) -> None:
    """Raise KeyError or ValueError where values are not of the kinds that `SeedEnvironments.save` gives."""
    flags, counts = ("alive", "exact"), ("episodes_begun", "episode_length")
    wrong = [name for name in flags if type(values[name]) is not bool]
    wrong += [name for name in counts if type(values[name]) is not int or not 0 <= values[name] < 2**53]
    wrong += [name for name in ("reward", "episode_return") if type(values[name]) is not float]
    if wrong or not isinstance(values["environment"], dict) or (values["exact"] and not values["episodes_begun"]):
        raise ValueError(f"{' and '.join(wrong) or 'the environment'} cannot be what was saved")
