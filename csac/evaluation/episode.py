"""One evaluation episode: run it, and record its return, length, success and events."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from csac.deploy.policy import noise_generator
from csac.tasks.events import EpisodeEvents, numbers
from csac.tasks.failures import EnvironmentFailure
from csac.types import Failure

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from csac.tasks.environment import Environment


class EvaluationFailure(Failure):
    """An evaluation environment raised or returned a non-finite value. The one-line message names the episode."""


class NotMade(EvaluationFailure):
    """The task cannot be made in this process: a script registers it under its main guard, or it is gone."""


class EvaluationEpisode(NamedTuple):
    """One evaluation episode; `success` is 1 or 0 as reported by the task, or None if it reports nothing.

    `events` maps each requested name to its value in `info` (`csac.tasks.events`): a bool, a number, or None if it
    is neither.
    """

    episode: int
    episode_return: float
    length: int
    success: float | None
    events: Mapping[str, float | None] = MappingProxyType({})

    def row(self, seed: int, step: int) -> dict[str, Any]:
        """Return this episode's row of evaluations.csv; `step` is the training step of the seed's policy."""
        return {
            "seed": seed,
            "step": step,
            "episode": self.episode,
            "return": self.episode_return,
            "length": self.length,
            "success": self.success,
            **self.events,
        }


class RunningEpisode:
    """An evaluation episode in progress. Stochastic actions are drawn from `generator`."""

    def __init__(
        self, environment: Environment, number: int, seed: int, limit: int, events: Sequence[str] = ()
    ) -> None:
        self.environment, self.number, self._seed, self._limit = environment, number, seed, limit
        self.generator = noise_generator(seed)
        self.ended = False
        self._return, self.length = 0.0, 0
        self.last_info: dict[str, Any] = {}
        self._events = EpisodeEvents(events)

    def start(self) -> np.ndarray:
        """Reset the environment and return the first observation. Raise EvaluationFailure if it fails."""
        try:
            return self.environment.reset(self._seed)
        except EnvironmentFailure as error:
            raise self._failure(error) from error

    def step(self, action: np.ndarray) -> np.ndarray:
        """Apply an action on the environment's scale; return the observation. Raise EvaluationFailure if it fails."""
        try:
            observation, reward, terminated, truncated, self.last_info = self.environment.step_environment_scale(action)
        except EnvironmentFailure as error:
            raise self._failure(error) from error
        self._events.add(self.last_info)
        self._return += reward
        self.length += 1
        self.ended = terminated or truncated or self.length >= self._limit
        return observation

    def result(self) -> EvaluationEpisode:
        """Return the record of the finished episode."""
        events = self._events.of(self.last_info, self.length)
        return EvaluationEpisode(self.number, self._return, self.length, _success(self.last_info), events)

    def _failure(self, error: EnvironmentFailure) -> EvaluationFailure:
        place = f"evaluation episode {self.number}, reset with seed {self._seed}, at step {self.length}"
        return EvaluationFailure(f"{place}: {error}")


def start(episodes: Sequence[RunningEpisode], rows: np.ndarray, ignores_seed: bool | None) -> bool | None:
    """Reset each episode's environment and write its first observation into rows [episode, observation].

    Return whether the task's resets ignore their seed, None if a single episode cannot show it. If they do, episode j
    is the j-th of its environment, which must be new: with a generator that the constructor seeds, all would be alike.
    """
    for row, episode in zip(rows, episodes, strict=True):
        row[:] = episode.start()
    is_known = ignores_seed is not None or len(episodes) < 2
    ignores_seed = ignores_seed if is_known else bool((rows == rows[0]).all())
    if ignores_seed:
        for row, episode in zip(rows, episodes, strict=True):
            for _ in range(episode.number):
                row[:] = episode.start()
    return ignores_seed if is_known else ignores_seed and not (rows == rows[0]).all()  # still alike: deterministic


def _success(info: dict[str, Any]) -> float | None:
    """Return 1 or 0 for the success that `info` reports, or None if it reports none or no number."""
    verdicts = (numbers(info.get(name)) for name in ("is_success", "success"))
    return next((float(verdict.all()) for verdict in verdicts if verdict is not None), None)
