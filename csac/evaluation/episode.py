"""One evaluation episode: its return, and what its last step says of it."""

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
    """An evaluation environment raised, or gave what is not finite. The message names the episode and is one line."""


class EvaluationEpisode(NamedTuple):
    """One evaluation episode; `success` is the task's own verdict (1 or 0), or None where it gives none.

    `events` are what `info` holds under the names asked for (`csac.tasks.events`): a bool, a number, or None where it
    holds neither.
    """

    episode: int
    episode_return: float
    length: int
    success: float | None
    events: Mapping[str, float | None] = MappingProxyType({})

    def row(self, seed: int, step: int) -> dict[str, Any]:
        """Return the row of evaluations.csv that says this of a seed's policy of that step."""
        return {
            "seed": seed,
            "step": step,
            "episode": self.episode,
            "return": self.episode_return,
            "length": self.length,
            "success": self.success,
            **self.events,
        }


class Playing:
    """One episode on its way. `generator` is what stochastic actions are drawn from."""

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
        """Reset the environment and return the first observation. Raises EvaluationFailure."""
        try:
            return self.environment.reset(self._seed)
        except EnvironmentFailure as error:
            raise self._failure(error) from error

    def step(self, action: np.ndarray) -> np.ndarray:
        """Apply an action on the environment's scale and return the observation. Raises EvaluationFailure."""
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
        """Return what there is to say of the episode."""
        said = self._events.of(self.last_info, self.length)
        return EvaluationEpisode(self.number, self._return, self.length, _success(self.last_info), said)

    def _failure(self, error: EnvironmentFailure) -> EvaluationFailure:
        place = f"evaluation episode {self.number}, reset with seed {self._seed}, at step {self.length}"
        return EvaluationFailure(f"{place}: {error}")


def start(episodes: Sequence[Playing], rows: np.ndarray, ignores_seed: bool | None) -> bool | None:
    """Put the first observations of new episodes into rows [episode, observation]; return whether seeds change nothing.

    None where one episode cannot tell. If so, episode j begins as the j-th of its environment, which is to be new: a
    generator that no seed reaches, made in a constructor, would give the same episode again and again.
    """
    for row, episode in zip(rows, episodes, strict=True):
        row[:] = episode.start()
    is_told = ignores_seed is not None or len(episodes) < 2
    ignores_seed = ignores_seed if is_told else bool((rows == rows[0]).all())
    if ignores_seed:
        for row, episode in zip(rows, episodes, strict=True):
            for _ in range(episode.number):
                row[:] = episode.start()
    return ignores_seed if is_told else ignores_seed and not (rows == rows[0]).all()  # else all begin alike


def _success(info: dict[str, Any]) -> float | None:
    """Return 1 or 0 for what a task says of its success, and None where it is silent or says nothing that counts."""
    verdicts = (numbers(info.get(name)) for name in ("is_success", "success"))
    return next((float(verdict.all()) for verdict in verdicts if verdict is not None), None)
