"""Returns of a policy, per episode, in environments of its own."""

from __future__ import annotations

import sys
import warnings
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from csac.checks import check_flag, check_whole
from csac.deploy.contract import BOUNDS_ROUNDING
from csac.deploy.policy import Policy, noise_generator
from csac.record.manifest import SEED_LIMIT
from csac.tasks.environment import Environment
from csac.tasks.known import check_events, events_of
from csac.tasks.perturbations import constant_perturbations, values_at
from csac.tasks.seeds import EVALUATION_SEED, FRESH_EVALUATION_SEED
from csac.tasks.spaces import EnvironmentFailure
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from csac.deploy.contract import Contract
    from csac.tasks.making import Task
    from csac.tasks.perturbations import Perturbation
    from csac.tasks.spaces import Parts

    OnProgress = Callable[[int, int], None]  # episodes done, episodes in all

EPISODES_AT_ONCE = 10  # rows of every batch that the policy sees: rounding depends on its shape
LONGEST_EPISODE = 100_000  # steps; a task that never ends would never let training go on


class EvaluationFailure(RuntimeError):
    """An evaluation environment raised, or gave what is not finite. The message names the episode and is one line."""


class EvaluationEpisode(NamedTuple):
    """One evaluation episode; `success` is the task's own verdict (1 or 0), or None where it gives none.

    `events` are what the last step's `info` holds under the names asked for: a bool, a number, or None where it holds
    neither. An episode that reaches `LONGEST_EPISODE` steps is broken off there.
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


class Evaluator:
    """Evaluates policies on a task, always on the same episodes: episode j is reset with `first_seed + j`.

    Episodes run side by side in batches of one fixed shape, so that an episode's numbers depend neither on when the
    others end nor on how many there are. The environments are made at the first `run` and kept, but for tasks whose
    resets do not forget what was before: they are made anew for each batch. `info_names` are the names of all numbers
    that the last steps of episodes have held in `info` so far, `perturbed` what `perturb` was last given. `watch`,
    where there is one, is called with each step's observations [running episode, observation].

    Args:
        task: as `Environment`'s.
        environment_arguments: keyword arguments for the environment.
        episodes: how many.
        first_seed: what episode 0 is reset with.
        events: names in the last step's `info` to keep of each episode.

    Raises:
        InputError: episodes or seeds that there cannot be.
    """

    def __init__(
        self,
        task: Task,
        environment_arguments: dict[str, Any] | None = None,
        episodes: int = 10,
        first_seed: int = EVALUATION_SEED,
        events: Sequence[str] = (),
    ) -> None:
        _check_episodes(episodes, first_seed)
        self._task, self._environment_arguments = task, environment_arguments
        self.episodes, self._first_seed, self._events = episodes, first_seed, tuple(events)
        self._environments: list[Environment] = []
        self.info_names: set[str] = set()
        self.perturbed: dict[str, float] = {}
        self.watch: Callable[[np.ndarray], object] | None = None

    def perturb(self, values: Mapping[str, float]) -> None:
        """Change the task from the next `run` on, as `Environment.perturb`; what the task cannot be, `run` refuses.

        Raises:
            InputError: environments that are there already refuse it; then so does each `run`, until it is changed.
        """
        self.perturbed = dict(values)
        try:
            for environment in self._environments:
                environment.perturb(values)
        except InputError:
            self.close()  # those that are left as they were would be run as if they were perturbed
            raise

    def run(self, policy: Policy, deterministic: bool = True) -> list[EvaluationEpisode]:
        """Return the episodes in order; stochastic actions are drawn by the episode's seed, never as the task draws.

        Raises:
            InputError: the policy was trained on other observations or actions, or the task cannot be made.
            EvaluationFailure: an environment raised, or gave what is not a finite number.
        """
        return self.run_all([policy], deterministic)[0]

    def run_all(
        self, policies: Sequence[Policy], deterministic: bool = True, on_progress: OnProgress | None = None
    ) -> list[list[EvaluationEpisode]]:
        """Return the episodes of each policy, as `run`; `on_progress(episodes done, of how many)` is called at times.

        Raises:
            InputError, EvaluationFailure: as `run`.
        """
        finished: list[list[EvaluationEpisode]] = [[] for _ in policies]
        for index, first in self.batches(len(policies)):
            finished[index] += self.run_batch(policies[index], first, deterministic)
            if on_progress:
                on_progress(sum(map(len, finished)), len(policies) * self.episodes)
        return finished

    def batches(self, policies: int) -> list[tuple[int, int]]:
        """Return (which policy, number of its first episode) of every batch, in order."""
        return [(index, first) for index in range(policies) for first in range(0, self.episodes, EPISODES_AT_ONCE)]

    def run_batch(self, policy: Policy, first: int, deterministic: bool = True) -> list[EvaluationEpisode]:
        """Return the episodes of the batch that begins with number `first`.

        Raises:
            InputError, EvaluationFailure: as `run`.
        """
        if self._environments and self._environments[0].has_memory:
            self.close()
        self._make_environments()
        check_contract(policy, self._environments[0])
        try:
            return self._run_batch(policy, range(first, min(first + EPISODES_AT_ONCE, self.episodes)), deterministic)
        except EvaluationFailure:
            self.close()  # what has raised may be broken for good, and the next policy is to fail by itself alone
            raise

    def close(self) -> None:
        """Close the environments; another `run` makes new ones."""
        for environment in self._environments:
            environment.close()
        self._environments = []

    def _make_environments(self) -> None:
        while len(self._environments) < min(EPISODES_AT_ONCE, self.episodes):
            environment = Environment(self._task, self._environment_arguments)
            try:
                environment.perturb(self.perturbed)
            except InputError:
                environment.close()
                raise
            self._environments.append(environment)

    def _run_batch(self, policy: Policy, numbers: range, deterministic: bool) -> list[EvaluationEpisode]:
        observation_size, action_size = policy.contract.spec
        observations = np.zeros((EPISODES_AT_ONCE, observation_size), np.float32)
        noise = None if deterministic else np.zeros((EPISODES_AT_ONCE, action_size), np.float32)
        episodes = [
            _Episode(environment, number, self._first_seed + number)
            for environment, number in zip(self._environments, numbers, strict=False)
        ]
        for row, episode in enumerate(episodes):
            observations[row] = episode.start()
        running = list(enumerate(episodes))
        while running:
            if self.watch:
                self.watch(observations[[row for row, _ in running]])
            if noise is not None:
                for row, episode in running:
                    episode.generator.standard_normal(dtype=np.float32, out=noise[row])
            actions = policy.contract.to_environment(policy.act(observations, deterministic, noise))
            for row, episode in running:
                observations[row] = episode.step(actions[row])
            running = [(row, episode) for row, episode in running if not episode.ended]
        for episode in episodes:
            self.info_names |= {
                name
                for name, value in episode.last_info.items()
                if isinstance(name, str) and _number(value) is not None
            }
        return [episode.result(self._events) for episode in episodes]


class _Episode:
    """One episode on its way."""

    def __init__(self, environment: Environment, number: int, seed: int) -> None:
        self.environment, self._number, self._seed = environment, number, seed
        self.generator = noise_generator(seed)
        self.ended = False
        self._return, self._length = 0.0, 0
        self.last_info: dict[str, Any] = {}

    def start(self) -> np.ndarray:
        try:
            return self.environment.reset(self._seed)
        except EnvironmentFailure as error:
            raise self._failure(error) from error

    def step(self, action: np.ndarray) -> np.ndarray:
        try:
            observation, reward, terminated, truncated, self.last_info = self.environment.step_environment_scale(action)
        except EnvironmentFailure as error:
            raise self._failure(error) from error
        self._return += reward
        self._length += 1
        self.ended = terminated or truncated or self._length >= LONGEST_EPISODE
        return observation

    def result(self, events: Sequence[str]) -> EvaluationEpisode:
        said = {name: _number(self.last_info.get(name)) for name in events}
        return EvaluationEpisode(self._number, self._return, self._length, _success(self.last_info), said)

    def _failure(self, error: EnvironmentFailure) -> EvaluationFailure:
        place = f"evaluation episode {self._number}, reset with seed {self._seed}, at step {self._length}"
        return EvaluationFailure(f"{place}: {error}")


def evaluate(
    policy: Any,
    task: Task,
    episodes: int = 100,
    first_seed: int = FRESH_EVALUATION_SEED,
    deterministic: bool = True,
    environment_arguments: dict[str, Any] | None = None,
    perturbations: str | Perturbation | Iterable[str | Perturbation] = (),
) -> np.ndarray:
    """Return the returns [episodes] of a policy: those of `evaluate_episodes`, which has the arguments too.

    Raises:
        InputError, EvaluationFailure: as `evaluate_episodes`.
    """
    played = evaluate_episodes(
        policy, task, episodes, first_seed, deterministic, environment_arguments, perturbations=perturbations
    )
    return np.array([episode.episode_return for episode in played])


def evaluate_episodes(
    policy: Any,
    task: Task,
    episodes: int = 100,
    first_seed: int = FRESH_EVALUATION_SEED,
    deterministic: bool = True,
    environment_arguments: dict[str, Any] | None = None,
    events: Sequence[str] | None = None,
    perturbations: str | Perturbation | Iterable[str | Perturbation] = (),
) -> list[EvaluationEpisode]:
    """Return the episodes that a policy plays, each with its return, length, success and events.

    Args:
        policy: a csac `Policy`, or any object whose `predict` has Stable-Baselines3's shape: that one is given the
            task's raw observations one at a time and answers on the task's own action scale.
        task: as `train`'s.
        episodes: how many.
        first_seed: what the first is reset with; the next ones with `first_seed + 1`, ...
        deterministic: whether the policy takes its most likely action, or draws one.
        environment_arguments: keyword arguments for the environment.
        events: names in the `info` of an episode's last step; None for those that a known task has by itself.
        perturbations: what changes the task for all of every episode, such as `("friction=2",)`.

    A policy that was trained on another task, or another version of it, is warned of where its observations and actions
    fit all the same.

    Raises:
        InputError: as `Evaluator`, a policy without `predict`, or perturbations that the task cannot have.
        EvaluationFailure: as `Evaluator.run`.
    """
    check_flag("deterministic", deterministic)
    perturbed = values_at(constant_perturbations(perturbations), 0)
    if events is not None:
        check_events(events)
    events = events_of(task) if events is None else tuple(events)
    if isinstance(policy, Policy):
        evaluator = Evaluator(task, environment_arguments, episodes, first_seed, events)
        evaluator.perturb(perturbed)
        try:
            played = evaluator.run(policy, deterministic)
        finally:
            evaluator.close()
        _warn_of_another_task(policy.contract.task, task)
        return played
    if isinstance(policy, type):
        raise InputError(f"{policy.__name__} is a class: give a policy as csac.load returns it")
    if not callable(getattr(policy, "predict", None)):
        raise InputError(f"a {type(policy).__name__} has no predict: give a policy as csac.load returns it")
    _check_episodes(episodes, first_seed)
    environment = Environment(task, environment_arguments)
    try:
        played = []
        for number in range(episodes):
            if number and environment.has_memory:
                environment.close()
                environment = Environment(task, environment_arguments)
            environment.perturb(perturbed)
            episode = _Episode(environment, number, first_seed + number)
            played.append(_play(policy, episode, deterministic, events))
        return played
    finally:
        environment.close()


def _play(policy: Any, episode: _Episode, deterministic: bool, events: Sequence[str]) -> EvaluationEpisode:
    episode.start()
    state, start = None, np.ones(1, bool)
    while not episode.ended:
        answer = policy.predict(
            episode.environment.raw_observation, state=state, episode_start=start, deterministic=deterministic
        )
        if not isinstance(answer, tuple) or len(answer) != 2:
            raise InputError(f"predict of a {type(policy).__name__} must return (action, state), not {answer!r:.40}")
        action, state = answer
        episode.step(action)
        start = np.zeros(1, bool)
    return episode.result(events)


def _check_episodes(episodes: int, first_seed: int) -> None:
    check_whole("episodes", episodes, 1, SEED_LIMIT)
    check_whole("first_seed", first_seed, 0, SEED_LIMIT - episodes)


def check_contract(policy: Policy, environment: Environment) -> None:
    """Raise InputError where a policy was trained on other observations or actions than a task has now.

    A policy whose actions are within the task's bounds is none of another task: it may keep away from them.
    """
    parts = environment.contract_parts
    known = (policy.contract.observation_parts, policy.contract.action_shape)
    given = (parts.observation_parts, parts.action_shape)
    if known != given:
        raise InputError(
            f"the policy was trained on observations {_told(known[0])} and actions {known[1]}; "
            f"{environment.task_name} has {_told(given[0])} and {given[1]}: evaluate it on its own task"
        )
    _check_bounds(policy.contract, parts.action_low, parts.action_high, environment.task_name)


def _warn_of_another_task(trained_on: str | None, task: Task) -> None:
    """Warn, as from the line that called csac, where two tasks have ids that differ by more than their modules.

    What a Python function is called says nothing of the task that it makes, and is an identifier, which ids are not.
    """
    one, other = (name.rpartition(":")[2] if isinstance(name, str) else "" for name in (trained_on, task))
    if one == other or "" in (one, other) or one.isidentifier():
        return
    frame, level = sys._getframe(), 1
    while frame.f_back and frame.f_code.co_filename == __file__:
        frame, level = frame.f_back, level + 1
    text = f"the policy was trained on {trained_on} and is evaluated on {task}: their returns cannot be compared"
    warnings.warn(text, stacklevel=level)


def _check_bounds(contract: Contract, low: np.ndarray, high: np.ndarray, task_name: str) -> None:
    """Raise InputError where a policy has actions beyond a task's bounds [action] by more than rounding."""
    low, high = low.astype(np.float64), high.astype(np.float64)  # the widest may not overflow
    rounding = BOUNDS_ROUNDING * np.maximum(np.abs(low), np.abs(high))
    is_outside = (contract.action_low < low - rounding) | (contract.action_high > high + rounding)
    if is_outside.any():
        place = int(is_outside.argmax())
        raise InputError(
            f"the policy's action[{place}] is between {contract.action_low[place]:g} and "
            f"{contract.action_high[place]:g}; {task_name} takes {low[place]:g} to {high[place]:g}: "
            "evaluate it on its own task"
        )


def _told(parts: Parts) -> str:
    return ", ".join(str(shape) if key is None else f"{key} {shape}" for key, shape in parts)


def _number(value: Any) -> bool | float | None:
    """Return a boolean or a finite number out of `info` as Python's own, and None for anything else."""
    array = _numbers(value)
    return None if array is None or array.size != 1 else array.item()


def _success(info: dict[str, Any]) -> float | None:
    """Return 1 or 0 for what a task says of its success, and None where it is silent or says nothing that counts."""
    verdicts = (_numbers(info.get(name)) for name in ("is_success", "success"))
    return next((float(verdict.all()) for verdict in verdicts if verdict is not None), None)


def _numbers(value: Any) -> np.ndarray | None:
    """Return booleans or finite numbers as an array, and None for anything else."""
    if value is None or isinstance(value, str | bytes):
        return None
    try:
        array = np.asarray(value)
    except Exception:  # `info` may hold anything
        return None
    is_number = array.size > 0 and array.dtype.kind in "buif" and np.isfinite(array).all()
    return array if is_number else None
