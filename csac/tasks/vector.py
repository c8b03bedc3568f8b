"""Step the environments of all seeds of a program together; each episode is reset with its own seed."""

from __future__ import annotations

import traceback
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from csac.deploy.contract import ActionBounds
from csac.seeds import training_seed
from csac.tasks.environment import Environment
from csac.tasks.events import EpisodeEvents
from csac.tasks.failures import EnvironmentFailure
from csac.tasks.registry import Task
from csac.tasks.workers import Workers
from csac.types import InputError, Snapshot

Place = tuple[int, ...]  # index of an environment: (seed,), or (seed, environment) if a seed has several


class FinishedEpisode(NamedTuple):
    """A training episode that ended; `seed_index` is the index of its seed in the group."""

    seed_index: int
    episode_return: float
    length: int
    events: Mapping[str, bool | float | None] = MappingProxyType({})


class Failure(NamedTuple):
    """A seed whose environment failed: the reason in one line, and the traceback if an exception caused it."""

    seed_index: int
    reason: str
    details: str


class Steps(NamedTuple):
    """One step of every environment, in new arrays, to be read only; failed environments keep their last valid values.

    The first axis is over seeds, the second over environments if a seed has several.
    """

    next_observation: np.ndarray  # [seed, observation] returned by the step, also where the episode ended
    reward: np.ndarray  # [seed] float32
    terminated: np.ndarray  # [seed] bool
    truncated: np.ndarray  # [seed] bool
    observation: np.ndarray  # [seed, observation] to act on next: the next episode's first where one ended
    episodes: list[FinishedEpisode]
    failures: list[Failure]


class SeedEnvironments:
    """The environments of each seed, reset automatically when an episode ends, each episode with its own derived seed.

    A failure affects only one seed: if one of its environments raises or returns a non-finite value, the seed is
    reported once and never stepped again. `alive` [seed] says which seeds are still stepped; it becomes False with the
    report. `processes` share the environments; 0 steps them in this process. Their number does not change the results.
    """

    def __init__(
        self,
        task: Task,
        environment_arguments: dict[str, Any] | None,
        seeds: Sequence[int],
        environments: int = 1,
        processes: int = 0,
        events: Sequence[str] = (),
    ) -> None:
        axes = (len(seeds), environments) if environments > 1 else (len(seeds),)
        self._places: list[Place] = list(np.ndindex(*axes))
        self._workers: Workers | None = None
        if processes:
            shares = [len(share) for share in np.array_split(self._places, processes)]
            self._workers = Workers(task, environment_arguments, shares, seeds[0], events)
        self.environments: list[Any] = self._workers.environments if self._workers else []
        with ExitStack() as stack:
            stack.callback(self.close)
            while len(self.environments) < len(self._places):
                self.environments.append(Environment(task, environment_arguments))
            stack.pop_all()
        self._by_place = dict(zip(self._places, self.environments, strict=True))
        first = self.environments[0]
        self.spec = first.spec._replace(environments=environments)
        self.contract_parts, self.task_name = first.contract_parts, first.task_name
        low, high = self.contract_parts.action_low, self.contract_parts.action_high
        self._bounds, self.action_bounds = ActionBounds(low, high), [low.tolist(), high.tolist()]
        self.seeds = tuple(seeds)
        self.alive = np.ones(len(seeds), bool)
        self._running = self._places
        self._action_axes = *axes, *first.contract_parts.action_shape
        self.observations = np.zeros((*axes, self.spec.observation_size), np.float32)  # to act on next
        self._reward = np.zeros(axes, np.float32)
        self._episodes_begun = dict.fromkeys(self._places, 0)
        self._returns = dict.fromkeys(self._places, 0.0)
        self._lengths = dict.fromkeys(self._places, 0)
        self._events = events
        self._episode_events = {place: EpisodeEvents(events) for place in self._places}
        self._failures: list[Failure] = []
        self.refused: dict[int, str] = {}  # by seed index: why the saved episode was not restored

    def reset(self) -> np.ndarray:
        """Start the next episode of every environment; return observations [seed, observation].

        A seed that fails here is reported by the next `step`.
        """
        self.observations = self.observations.copy()
        self._reset(self._running)
        return self.observations

    def perturb(self, values: Mapping[str, float]) -> None:
        """Perturb every seed's task, as `Environment.perturb` does."""
        for place in self._running:
            try:
                self._by_place[place].perturb(values)
            except EnvironmentFailure as error:
                self._fail(place, error)

    def step(self, actions: np.ndarray) -> Steps:
        """Step every environment of the seeds that are alive, with actions [seed, action] in [-1, 1]."""
        scaled = self._bounds.scale(actions).reshape(self._action_axes)
        next_observation, reward = self.observations.copy(), self._reward.copy()
        terminated, truncated = np.zeros(reward.shape, bool), np.zeros(reward.shape, bool)
        ended: list[Place] = []
        episodes: list[FinishedEpisode] = []
        if self._workers:
            for place in self._running:
                self._by_place[place].ask("step_environment_scale", scaled[place])
            self._workers.begin()
        for place in self._running:
            try:
                step = self._by_place[place].step_environment_scale(scaled[place])
            except EnvironmentFailure as error:
                self._fail(place, error)
                continue
            next_observation[place], reward[place], terminated[place], truncated[place], info = step
            self._returns[place] += step[1]
            self._lengths[place] += 1
            if self._events:
                self._episode_events[place].add(info)
            if step[2] or step[3]:
                events = self._episode_events[place].of(info, self._lengths[place])
                episodes.append(FinishedEpisode(place[0], self._returns[place], self._lengths[place], events))
                ended.append(place)
        self.observations, self._reward = next_observation.copy(), reward
        self._reset([place for place in ended if place in self._running])
        failures, self._failures = self._failures, []
        for failure in failures:
            self.alive[failure.seed_index] = False
        return Steps(next_observation, reward, terminated, truncated, self.observations, episodes, failures)

    def relabel(
        self, place: Place, achieved: np.ndarray, desired: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None] | None:
        """Return the result of `Environment.relabel`, or None if it fails, which the next `step` reports."""
        try:
            return self._by_place[place].relabel(achieved, desired)
        except EnvironmentFailure as error:
            self._fail(place, error)
            return None

    def stop(self, index: int) -> None:
        """Stop stepping the seed with this index."""
        self.alive[index] = False
        self._stop_stepping(index)

    def save(self, index: int) -> Snapshot:
        """Return a snapshot of the seed with this index. Unless "exact", restoring it restarts the current episodes.

        "problem" says why an environment that supports snapshots could not be saved.
        """
        saved = {str(place[-1]): self._save(place) for place in self._places_of(index)}
        if self.spec.environments == 1:
            return next(iter(saved.values()))
        joined, all_values = Snapshot.joined(saved), [one.values for one in saved.values()]
        joined.values["exact"] = all(values["exact"] for values in all_values)
        joined.values["problem"] = next(filter(None, (values["problem"] for values in all_values)), "")
        return joined

    def _save(self, place: Place) -> Snapshot:
        snapshot, problem = None, ""
        try:
            snapshot = self._by_place[place].snapshot()
        except EnvironmentFailure as error:
            problem = str(error)
        arrays = {"observation": self.observations[place].copy(), **(snapshot.arrays if snapshot else {})}
        values = {
            "reward": float(self._reward[place]),
            "episodes_begun": self._episodes_begun[place],
            "episode_return": self._returns[place],
            "episode_length": self._lengths[place],
            **({"events": self._episode_events[place].sums} if self._episode_events[place].sums else {}),
            "exact": snapshot is not None,
            "problem": problem,
            "environment": snapshot.values if snapshot else {},
        }
        return Snapshot(arrays, values)

    def refuse_incompatible(self, saved: Snapshot, actions: np.ndarray) -> None:
        """Raise InputError if `saved` is of a task with other sizes; `actions` are the saved ones to apply next."""
        first = "observation" if self.spec.environments == 1 else "0.observation"
        before, now = (saved.arrays[first].size, actions.shape[-1]), (self.spec.observation_size, self.spec.action_size)
        if before != now:
            raise InputError(
                f"{self.task_name}: (observations, actions) were {before} and are {now} now: "
                "resume with the task and the versions of its packages that the manifest names"
            )

    def restore(self, index: int, saved: Snapshot) -> bool:
        """Restore the seed with this index from `save`; return False if any of its episodes had to be restarted.

        An environment that rejects its snapshot restarts too, and `refused` says why. A seed whose environment cannot
        be reset either is reported by the next `step`.
        """
        if self.spec.environments == 1:
            return self._restore((index,), saved, saved.values["exact"])
        parts = {place: saved.part(str(place[-1])) for place in self._places_of(index)}
        are_restored = [self._restore(place, part, saved.values["exact"]) for place, part in parts.items()]
        return all(are_restored)

    def _restore(self, place: Place, saved: Snapshot, is_exact: bool) -> bool:
        arrays, values = dict(saved.arrays), saved.values
        self._episodes_begun[place] = values["episodes_begun"]
        self.observations, self._reward = self.observations.copy(), self._reward.copy()
        self.observations[place], self._reward[place] = arrays.pop("observation"), values["reward"]
        seed = training_seed(self.seeds[place[0]], self._episodes_begun[place] - 1, *place[1:])
        try:
            if is_exact:
                self._by_place[place].restore(seed, Snapshot(arrays, values["environment"]))
                self._returns[place], self._lengths[place] = values["episode_return"], values["episode_length"]
                self._episode_events[place] = EpisodeEvents(self._events, values.get("events"))
                return True
        except EnvironmentFailure as error:  # the task may have changed since
            self.refused[place[0]] = str(error)
        self._episodes_begun[place] -= 1
        self._reset([place])
        return False

    def begin_again(self) -> np.ndarray:
        """Restart the episodes in progress; return observations [seed, observation]."""
        self._episodes_begun = {place: begun - 1 for place, begun in self._episodes_begun.items()}
        return self.reset()

    @property
    def is_at_start(self) -> bool:
        """Whether every environment is at the start of its episode."""
        return not any(self._lengths.values())

    @property
    def is_any_alive(self) -> bool:
        """Whether a seed is still stepped, or has a failure that is not reported yet."""
        return bool(self._running or self._failures)

    def close(self) -> None:
        """Close every environment."""
        for environment in self.environments:
            environment.close()
        if self._workers:
            self._workers.close()

    def _places_of(self, index: int) -> list[Place]:
        """Return the places of the environments of the seed with this index."""
        return [place for place in self._places if place[0] == index]

    def _reset(self, places: Sequence[Place]) -> None:
        seeds = [training_seed(self.seeds[place[0]], self._episodes_begun[place], *place[1:]) for place in places]
        for place, seed in zip(places, seeds, strict=True):
            self._returns[place], self._lengths[place] = 0.0, 0
            self._episode_events[place] = EpisodeEvents(self._events)
            self._episodes_begun[place] += 1
            if self._workers:
                self._by_place[place].ask("reset", seed)
        if self._workers:
            self._workers.begin()
        for place, seed in zip(places, seeds, strict=True):
            try:
                self.observations[place] = self._by_place[place].reset(seed)
            except EnvironmentFailure as error:
                self._fail(place, error)

    def _stop_stepping(self, index: int) -> None:
        self._running = [place for place in self._running if place[0] != index]

    def _fail(self, place: Place, error: EnvironmentFailure) -> None:
        self._stop_stepping(place[0])
        details = "".join(traceback.format_exception(error)) if error.__cause__ else ""
        if all(failure.seed_index != place[0] for failure in self._failures):
            self._failures.append(Failure(place[0], str(error), details))
