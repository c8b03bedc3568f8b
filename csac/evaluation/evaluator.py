"""Returns of a policy, per episode, in environments of its own."""

from __future__ import annotations

import warnings
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.checks import check_flag, check_whole
from csac.deploy.contract import BOUNDS_ROUNDING
from csac.deploy.policy import Policy
from csac.evaluation.episode import EvaluationEpisode, EvaluationFailure, Playing, start
from csac.evaluation.pool import EvaluationStopped, Pending
from csac.seeds import EVALUATION_SEED, FRESH_EVALUATION_SEED
from csac.tasks.environment import Environment
from csac.tasks.perturbations import constant_perturbations, values_at
from csac.tasks.preflight import globals_seeded
from csac.tasks.registry import check_events, events_of
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from csac.evaluation.pool import Batch, OnProgress, Result
    from csac.tasks.perturbations import Perturbation
    from csac.tasks.registry import Task
    from csac.tasks.spaces import Parts


EPISODES_AT_ONCE = 10  # rows of every batch that the policy sees: rounding depends on its shape
LONGEST_EPISODE = 100_000  # steps; a task that never ends would never let training go on

_SEED_LIMIT = 2**32


class Evaluator:
    """Evaluates policies on a task, always on the same `episodes`: episode j is reset with `first_seed + j`.

    Episodes run side by side in batches of one fixed shape, so that an episode's numbers depend neither on when the
    others end nor on how many there are. The environments are made at the first batch and kept, but for tasks whose
    resets do not forget what was before: they are made anew for each batch. `perturbed` is what `perturb` was
    last given.

    So many `environments` are stepped side by side, ten at most, and no number depends on it; or the one that is `lent`
    is, and stays open. `events` are what to keep of each episode's `info` (`csac.tasks.events`).
    """

    def __init__(
        self,
        task: Task,
        environment_arguments: dict[str, Any] | None = None,
        episodes: int = 10,
        first_seed: int = EVALUATION_SEED,
        events: Sequence[str] = (),
        environments: int = EPISODES_AT_ONCE,
        lent: Environment | None = None,
    ) -> None:
        check_whole("episodes", episodes, 1, _SEED_LIMIT)
        check_whole("first_seed", first_seed, 0, _SEED_LIMIT - episodes)
        self._task, self._environment_arguments = task, environment_arguments
        self.episodes, self._first_seed, self._events = episodes, first_seed, tuple(events)
        self._lent, self._at_once = lent, min(environments, EPISODES_AT_ONCE, episodes)
        self._environments = [lent] if lent else []
        self._ignores_seed: bool | None = None  # None before the first batch
        self.perturbed: dict[str, float] = {}

    def perturb(self, values: Mapping[str, float]) -> None:
        """Change the task from the next batch on, as `Environment.perturb`; what the task cannot be, a batch refuses.

        Raises InputError where environments that are there refuse it; then so does each batch, until it is changed.
        """
        self.perturbed = dict(values)
        try:
            for environment in self._environments:
                environment.perturb(values)
        except InputError:
            self.close()  # those that are left as they were would be run as if they were perturbed
            raise

    def begin(
        self, policies: Sequence[Policy], deterministic: bool = True, on_progress: OnProgress | None = None
    ) -> Pending:
        """Return the evaluation of these policies, which `Pending.results` runs."""
        return Pending(self, policies, deterministic, on_progress)

    def run(self, policy: Policy, deterministic: bool = True) -> list[EvaluationEpisode]:
        """Return the episodes in order; stochastic actions are drawn by the episode's seed, never as the task draws.

        Raises:
            InputError: the policy was trained on other observations or actions, or the task cannot be made.
            EvaluationFailure: an environment raised, or gave what is not a finite number.
        """
        batches = (self.run_batch(policy, first, deterministic) for _, first in self.batches(1))
        return [episode for batch in batches for episode in batch]

    def batches(self, policies: int) -> list[Batch]:
        """Return (which policy, number of its first episode) of every batch, in order."""
        return [(index, first) for index in range(policies) for first in range(0, self.episodes, self._at_once)]

    def run_batch(
        self,
        policy: Policy,
        first: int,
        deterministic: bool = True,
        should_stop: Callable[[], bool] | None = None,
    ) -> list[EvaluationEpisode]:
        """Return the episodes of the batch that begins with number `first`, played side by side to their ends.

        Raises InputError and EvaluationFailure as `run`, EvaluationStopped where `should_stop`, asked before each step,
        says so.
        """
        self._make_environments(self._at_once)
        check_contract(policy, self._environments[0])
        numbers = range(first, min(first + self._at_once, self.episodes))
        episodes = [
            Playing(environment, number, self._first_seed + number, LONGEST_EPISODE, self._events)
            for environment, number in zip(self._environments, numbers, strict=False)
        ]
        observation_size, action_size = policy.contract.spec[:2]
        observations = np.zeros((EPISODES_AT_ONCE, observation_size), np.float32)
        noise = None if deterministic else np.zeros((EPISODES_AT_ONCE, action_size), np.float32)
        running = list(enumerate(episodes))
        try:
            with globals_seeded(self._first_seed + first):
                self._ignores_seed = start(episodes, observations[: len(episodes)], self._ignores_seed)
                while running:
                    if should_stop and should_stop():
                        raise EvaluationStopped
                    if noise is not None:
                        for row, episode in running:
                            episode.generator.standard_normal(dtype=np.float32, out=noise[row])
                    actions = policy.contract.to_environment(policy.act(observations, deterministic, noise))
                    for row, episode in running:
                        observations[row] = episode.step(actions[row])
                    running = [(row, episode) for row, episode in running if not episode.ended]
        except EvaluationFailure:
            self.close()  # what has raised may be broken for good, and the next policy is to fail by itself alone
            raise
        return [episode.result() for episode in episodes]

    def answer(
        self,
        policy: Policy,
        first: int,
        deterministic: bool,
        perturbed: dict[str, float],
        should_stop: Callable[[], bool] | None = None,
    ) -> Result:
        """Return the episodes of a batch on the task perturbed so, or its failure. Raises EvaluationStopped."""
        try:
            if perturbed != self.perturbed:
                self.perturb(perturbed)
            return self.run_batch(policy, first, deterministic, should_stop)
        except (EvaluationFailure, InputError) as error:  # the latter: the task cannot be made once more
            return EvaluationFailure(str(error))

    def play(self, policy: Any, number: int, deterministic: bool) -> EvaluationEpisode:
        """Return an episode that a policy with Stable-Baselines3's `predict` plays, on the task's raw observations.

        Raises InputError and EvaluationFailure as `run`.
        """
        self._make_environments(1)
        environment = self._environments[0]
        episode = Playing(environment, number, self._first_seed + number, LONGEST_EPISODE, self._events)
        with globals_seeded(self._first_seed + number):
            episode.start()
            state, start = None, np.ones(1, bool)
            while not episode.ended:
                observation = environment.raw_observation
                answer = policy.predict(observation, state=state, episode_start=start, deterministic=deterministic)
                if not isinstance(answer, tuple) or len(answer) != 2:
                    kind = type(policy).__name__
                    raise InputError(f"predict of a {kind} must return (action, state), not {answer!r:.40}")
                action, state = answer
                episode.step(action)
                start = np.zeros(1, bool)
        return episode.result()

    def close(self) -> None:
        """Close the environments, but for one that is lent; another batch makes new ones."""
        if self._lent:
            return
        for environment in self._environments:
            environment.close()
        self._environments = []

    def _make_environments(self, count: int) -> None:
        if self._environments and (self._environments[0].has_memory or self._ignores_seed):
            self.close()
        while len(self._environments) < count:
            environment = Environment(self._task, self._environment_arguments)
            try:
                environment.perturb(self.perturbed)
            except InputError:
                environment.close()
                raise
            self._environments.append(environment)


def evaluate(
    policy: Any,
    task: Task,
    episodes: int = 10,
    first_seed: int = FRESH_EVALUATION_SEED,
    deterministic: bool = True,
    environment_arguments: dict[str, Any] | None = None,
    perturbations: str | Perturbation | Iterable[str | Perturbation] = (),
) -> np.ndarray:
    """Return the returns [episodes] of a policy. `evaluate_episodes` explains the arguments and what is raised."""
    given = policy, deterministic, perturbations, task, environment_arguments, episodes, first_seed
    return np.array([episode.episode_return for episode in _played(*given)])


def evaluate_episodes(
    policy: Any,
    task: Task,
    episodes: int = 10,
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
    if events is not None:
        check_events(events)
    events = events_of(task) if events is None else events
    return _played(policy, deterministic, perturbations, task, environment_arguments, episodes, first_seed, events)


def _played(
    policy: Any,
    deterministic: bool,
    perturbations: str | Perturbation | Iterable[str | Perturbation],
    task: Task,
    *given: Any,
) -> list[EvaluationEpisode]:
    evaluator = Evaluator(task, *given)
    evaluator.perturb(values_at(constant_perturbations(perturbations), 0))
    check_flag("deterministic", deterministic)
    if isinstance(policy, type) or not callable(getattr(policy, "predict", None)):
        raise InputError(f"{policy!r:.60} has no predict: give a policy as csac.load returns it")
    with closing(evaluator):
        if not isinstance(policy, Policy):
            return [evaluator.play(policy, number, deterministic) for number in range(evaluator.episodes)]
        episodes = evaluator.run(policy, deterministic)
    one, other = (name.rpartition(":")[2] if isinstance(name, str) else "" for name in (policy.contract.task, task))
    if one != other and one and other and not one.isidentifier():  # what a Python function is called says nothing
        text = f"the policy was trained on {one} and is evaluated on {other}: their returns cannot be compared"
        warnings.warn(text, stacklevel=3)
    return episodes


def check_contract(policy: Policy, environment: Environment) -> None:
    """Raise InputError where a policy was trained on other observations or actions than a task has now.

    A policy whose actions are within the task's bounds is none of another task: it may keep away from them.
    """
    contract, parts, name = policy.contract, environment.contract_parts, environment.task_name
    known = (contract.observation_parts, contract.action_shape)
    if known != parts[:2]:
        raise InputError(
            f"the policy was trained on observations {_told(known[0])} and actions {known[1]}; "
            f"{name} has {_told(parts.observation_parts)} and {parts.action_shape}: evaluate it on its own task"
        )
    low, high = parts.action_low.astype(np.float64), parts.action_high.astype(np.float64)  # the widest may not overflow
    rounding = BOUNDS_ROUNDING * np.maximum(np.abs(low), np.abs(high))
    is_outside = (contract.action_low < low - rounding) | (contract.action_high > high + rounding)
    if is_outside.any():
        place = int(is_outside.argmax())
        raise InputError(
            f"the policy's action[{place}] is between {contract.action_low[place]:g} and "
            f"{contract.action_high[place]:g}; {name} takes {low[place]:g} to {high[place]:g}"
        )


def _told(parts: Parts) -> str:
    return ", ".join(str(shape) if key is None else f"{key} {shape}" for key, shape in parts)
