"""Hindsight: copy transitions with goals that their episode achieved later (HER, Andrychowicz et al. 2017)."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from csac.algorithms.memory import pack
from csac.tasks.failures import EnvironmentFailure
from csac.types import InputError, Snapshot, Transition

if TYPE_CHECKING:
    from collections.abc import Callable

    from csac.tasks.environment import Environment
    from csac.tasks.spaces import Parts
    from csac.tasks.vector import SeedEnvironments, Steps
    from csac.training.learner import Learner
    from csac.types import Algorithm, Spec

    Relabel = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray | None] | None]

ACHIEVED, DESIRED = "achieved_goal", "desired_goal"


class Hindsight:
    """Keeps the episodes in progress; at an episode's end, adds `copies` of each transition to its seed's replay."""

    def __init__(self, copies: int, environments: SeedEnvironments, learner: Learner) -> None:
        self._copies, self._environments, self._learner = copies, environments, learner
        self._goals = places_of(environments.contract_parts.observation_parts)
        self._episodes: dict[tuple[int, ...], list[np.ndarray]] = {}  # packed transitions by (seed index, environment)

    def after_step(self, observations: np.ndarray, actions: np.ndarray, outcome: Steps, step: int) -> None:
        """Store one transition of each environment, up to `step` in all, before the learner does."""
        ends = outcome.terminated, outcome.truncated
        rows = pack(Transition(observations, actions, outcome.reward, outcome.next_observation, *ends))
        copies_by_seed: dict[int, list[np.ndarray]] = {}
        for place in np.ndindex(rows.shape[:-1]):
            if not self._environments.alive[place[0]]:
                continue
            self._episodes.setdefault(place, []).append(rows[place])
            if ends[0][place] or ends[1][place]:
                generator = np.random.default_rng([self._environments.seeds[place[0]], *place[1:], step])
                episode, relabel = np.stack(self._episodes.pop(place)), partial(self._environments.relabel, place)
                copies = relabelled(episode, self._goals, self._environments.spec, self._copies, generator, relabel)
                copies_by_seed.setdefault(place[0], []).append(copies)
        if copies_by_seed:
            no_rows = rows.reshape(-1, rows.shape[-1])[:0]
            rows_by_seed = [np.concatenate([no_rows, *copies_by_seed.get(index, [])]) for index in range(len(rows))]
            self._learner.extend(rows_by_seed, step - self._environments.spec.environments)

    def save(self, index: int) -> Snapshot:
        """Return the episodes in progress of the seed at this index."""
        episodes = {place: rows for place, rows in self._episodes.items() if place[0] == index}
        return Snapshot({str(place[-1]): np.stack(rows) for place, rows in episodes.items()}, {})

    def restore(self, index: int, saved: Snapshot) -> None:
        """Restore the episodes that `save` returned; not for a seed whose episode restarts."""
        for name, rows in saved.arrays.items():
            environment = (int(name),) if self._environments.spec.environments > 1 else ()
            self._episodes[(index, *environment)] = [*rows]


def relabelled(
    episode: np.ndarray,
    goals: tuple[slice, slice],
    spec: Spec,
    copies: int,
    generator: np.random.Generator,
    relabel: Relabel,
) -> np.ndarray:
    """Return `copies` of each transition of an episode [steps, width], with goals achieved in that step or a later one.

    Rewards are recomputed for the new goals, and so is `terminated` if the task can; otherwise it is unchanged.
    """
    achieved, desired = goals
    reward = spec.observation_size + spec.action_size
    following = reward + 1  # where the next observation begins
    achieved = slice(achieved.start + following, achieved.stop + following)
    steps = len(episode)
    later = generator.integers(np.arange(steps)[:, None], steps, (steps, copies)).ravel()
    rows, new_goals = np.repeat(episode, copies, axis=0), episode[later, achieved]
    rows[:, desired] = rows[:, desired.start + following : desired.stop + following] = new_goals
    computed = relabel(rows[:, achieved], new_goals)
    if computed is None:
        return rows[:0]
    rows[:, reward] = computed[0]
    if computed[1] is not None:
        rows[:, -2] = computed[1]
    return rows


def places_of(parts: Parts) -> tuple[slice, slice]:
    """Return the slices of the achieved and the desired goal in a flat observation. Raises InputError without them."""
    ends = np.cumsum([0, *(math.prod(shape) for _, shape in parts)]).tolist()
    places = {name: slice(*ends[i : i + 2]) for i, (name, _) in enumerate(parts)}
    shapes = dict(parts)
    if ACHIEVED not in places or DESIRED not in places or shapes[ACHIEVED] != shapes[DESIRED]:
        found = ", ".join(f"{name} {shape}" for name, shape in parts if name) or "one Box"
        raise InputError(f"hindsight needs {ACHIEVED} and {DESIRED} of one shape in a Dict observation, not {found}")
    return places[ACHIEVED], places[DESIRED]


def check_goals(algorithm: Algorithm, environment: Environment) -> None:
    """Raise InputError if an algorithm or a task does not support hindsight. Steps the environment once."""
    if not hasattr(algorithm, "replay_size"):
        raise InputError(f"hindsight is for algorithms with a replay, and {type(algorithm).__name__} has none")
    if getattr(algorithm, "n_steps", 1) > 1:
        raise InputError("hindsight gives the replay single steps: n_steps must be 1")
    achieved, desired = places_of(environment.contract_parts.observation_parts)
    if not environment.raw.has_wrapper_attr("compute_reward"):
        raise InputError(
            f"hindsight needs compute_reward(achieved_goal, desired_goal, info) of {environment.task_name}"
        )
    try:
        environment.reset(0)
        observation, reward, *_ = environment.step(np.zeros(environment.spec.action_size, np.float32))
        computed = environment.relabel(observation[None, achieved], observation[None, desired])[0][0]
    except EnvironmentFailure as error:
        raise InputError(f"hindsight does not work with {environment.task_name}: {error}") from None
    if not np.isclose(computed, reward, rtol=1e-3, atol=1e-4):
        rewards = f"{environment.task_name} gave {reward:g} and its compute_reward {computed:g}"
        raise InputError(f"hindsight needs rewards that compute_reward reproduces: {rewards}")
