"""Evaluate a policy episode by episode in separate environments."""

from __future__ import annotations

import warnings
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.checks import check_flag, check_whole
from csac.deploy.contract import BOUNDS_ROUNDING
from csac.deploy.policy import Policy
from csac.evaluation.episode import EvaluationEpisode, EvaluationFailure, NotMade, RunningEpisode, start
from csac.evaluation.pool import EvaluationStopped, Pending
from csac.record.config import SEED_LIMIT
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


EPISODES_AT_ONCE = 10  # rows of every observation batch: fixed, since rounding depends on the batch shape
LONGEST_EPISODE = 100_000  # steps; otherwise a task whose episodes never end would block training


class Evaluator:
    """Evaluates policies on a task, always on the same `episodes`: episode j is reset with `first_seed + j`.

    Episodes run in parallel in batches of one fixed shape, so that an episode's result depends neither on when the
    others end nor on how many there are. The environments are created at the first batch and reused, except for tasks
    whose resets leave state behind or ignore their seed: those get new environments for each batch. `perturbed` is the
    latest argument of `perturb`.

    `environments`, at most ten, are stepped in parallel; their number does not change the results, unless the task
    ignores its seed. Alternatively the environment `lent` is used and left open. `events` names what to record from
    `info` (`csac.tasks.events`).
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
        check_whole("episodes", episodes, 1, SEED_LIMIT)
        check_whole("first_seed", first_seed, 0, SEED_LIMIT - episodes)
        self._task, self._environment_arguments = task, environment_arguments
        self.episodes, self._first_seed, self._events = episodes, first_seed, tuple(events)
        self._lent, self._batch_size = lent, min(environments, EPISODES_AT_ONCE, episodes)
        self._environments = [lent] if lent else []
        self._ignores_seed: bool | None = None  # None before the first batch
        self.perturbed: dict[str, float] = {}

    def perturb(self, values: Mapping[str, float]) -> None:
        """Perturb the task from the next batch on, as `Environment.perturb` does.

        Raise InputError if the task does not support it: here if environments are open, otherwise in the next batch.
        """
        for environment in self._environments:
            environment.perturb(values)
        self.perturbed = dict(values)

    def begin(
        self, policies: Sequence[Policy], deterministic: bool = True, on_progress: OnProgress | None = None
    ) -> Pending:
        """Return a pending evaluation of these policies; `Pending.results` runs it."""
        return Pending(self, policies, deterministic, on_progress)

    def run(self, policy: Policy, deterministic: bool = True) -> list[EvaluationEpisode]:
        """Return the episodes in order; the episode's seed determines stochastic actions, in a stream of their own.

        Raises:
            InputError: the policy was trained on other observations or actions, or the task cannot be created.
            EvaluationFailure: an environment raised or returned a non-finite value.
        """
        batches = (self.run_batch(policy, first, deterministic) for _, first in self.batches(1))
        return [episode for batch in batches for episode in batch]

    def batches(self, policies: int) -> list[Batch]:
        """Return (policy index, number of the first episode) of every batch, in order."""
        return [(index, first) for index in range(policies) for first in range(0, self.episodes, self._batch_size)]

    def run_batch(
        self,
        policy: Policy,
        first: int,
        deterministic: bool = True,
        should_stop: Callable[[], bool] | None = None,
    ) -> list[EvaluationEpisode]:
        """Run the batch that starts with episode number `first` to the end, in parallel, and return its episodes.

        Raise InputError and EvaluationFailure as `run` does, and EvaluationStopped if `should_stop`, called before each
        step, returns True.
        """
        self._make_environments(self._batch_size)
        check_contract(policy, self._environments[0])
        numbers = range(first, min(first + self._batch_size, self.episodes))
        episodes = [
            RunningEpisode(environment, number, self._first_seed + number, LONGEST_EPISODE, self._events)
            for environment, number in zip(self._environments, numbers, strict=False)
        ]
        observation_size, action_size = policy.contract.spec[:2]
        observations = np.zeros((EPISODES_AT_ONCE, observation_size), np.float32)
        noise = None if deterministic else np.zeros((EPISODES_AT_ONCE, action_size), np.float32)
        rows = [number % EPISODES_AT_ONCE for number in numbers]  # the last bits depend on an observation's row
        running = list(zip(rows, episodes, strict=True))
        try:
            with globals_seeded(self._first_seed + first):
                first_observations = observations[: len(episodes)].copy()
                self._ignores_seed = start(episodes, first_observations, self._ignores_seed)
                observations[rows] = first_observations
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
            self.close()  # an environment that raised may stay broken, and must not make the next policy fail too
            raise
        return [episode.result() for episode in episodes]

    def try_batch(
        self,
        policy: Policy,
        first: int,
        deterministic: bool,
        perturbed: dict[str, float],
        should_stop: Callable[[], bool] | None = None,
    ) -> Result:
        """Return a batch's episodes on the perturbed task, or its failure. Raise EvaluationStopped."""
        try:
            if perturbed != self.perturbed:
                self.perturb(perturbed)
            return self.run_batch(policy, first, deterministic, should_stop)
        except InputError as error:
            return NotMade(str(error))
        except EvaluationFailure as error:
            return EvaluationFailure(str(error))

    def play(self, policy: Any, number: int, deterministic: bool) -> EvaluationEpisode:
        """Run an episode with a policy that has Stable-Baselines3's `predict`, on the task's raw observations.

        Raise InputError and EvaluationFailure as `run` does.
        """
        self._make_environments(1)
        environment = self._environments[0]
        episode = RunningEpisode(environment, number, self._first_seed + number, LONGEST_EPISODE, self._events)
        with globals_seeded(self._first_seed + number):
            episode.start()
            state, start = None, np.ones(1, bool)
            while not episode.ended:
                observation = environment.raw_observation
                prediction = policy.predict(observation, state=state, episode_start=start, deterministic=deterministic)
                if not isinstance(prediction, tuple) or len(prediction) != 2:
                    kind = type(policy).__name__
                    raise InputError(f"predict of a {kind} must return (action, state), not {prediction!r:.40}")
                action, state = prediction
                episode.step(action)
                start = np.zeros(1, bool)
        return episode.result()

    def close(self) -> None:
        """Close the environments, except a lent one; the next batch creates new ones."""
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
            environment.perturb(self.perturbed)
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
    """Return the returns [episodes] of a policy. Arguments and errors are those of `evaluate_episodes`."""
    arguments = episodes, first_seed, deterministic, environment_arguments, (), perturbations
    return np.array([episode.episode_return for episode in evaluate_episodes(policy, task, *arguments)])


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
    """Evaluate a policy and return its episodes, each with return, length, success and events.

    Args:
        policy: a csac `Policy`, or any object with Stable-Baselines3's `predict`, which gets the task's raw
            observations one at a time and returns actions on the task's own scale.
        task: as in `train`.
        episodes: number of episodes.
        first_seed: reset seed of the first episode; the next ones use `first_seed + 1`, ...
        deterministic: whether the policy takes its most likely action or samples one.
        environment_arguments: keyword arguments for the environment.
        events: names in the `info` of an episode's last step; None for the default events of a known task.
        perturbations: changes of the task that hold for whole episodes, such as `("friction=2",)`.

    Warn if the policy was trained on another task, or another version of it, with the same observations and actions.

    Raises:
        InputError: as `Evaluator.run`, invalid arguments, or perturbations that the task does not support.
        EvaluationFailure: as `Evaluator.run`.
    """
    events = events_of(task) if events is None else events
    check_events(events)
    evaluator = Evaluator(task, environment_arguments, episodes, first_seed, events)
    evaluator.perturb(values_at(constant_perturbations(perturbations), 0))
    check_flag("deterministic", deterministic)
    if isinstance(policy, type) or not callable(getattr(policy, "predict", None)):
        raise InputError(f"{policy!r:.60} has no predict: give a policy as csac.load returns it")
    with closing(evaluator):
        if not isinstance(policy, Policy):
            return [evaluator.play(policy, number, deterministic) for number in range(evaluator.episodes)]
        results = evaluator.run(policy, deterministic)
    one, other = (name.rpartition(":")[2] if isinstance(name, str) else "" for name in (policy.contract.task, task))
    if one != other and one and other and not one.isidentifier():  # the name of a Python function identifies no task
        text = f"the policy was trained on {one} and is evaluated on {other}: their returns cannot be compared"
        warnings.warn(text, stacklevel=2)
    return results


def check_contract(policy: Policy, environment: Environment) -> None:
    """Raise InputError if a policy was trained with other observations or actions than the environment has.

    Its action bounds may lie within the environment's: a policy may be restricted to part of the range.
    """
    contract, parts, name = policy.contract, environment.contract_parts, environment.task_name
    trained = (contract.observation_parts, contract.action_shape)
    if trained != parts[:2]:
        raise InputError(
            f"the policy was trained on observations {_describe(trained[0])} and actions {trained[1]}; "
            f"{name} has {_describe(parts.observation_parts)} and {parts.action_shape}: evaluate it on its own task"
        )
    low, high = parts.action_low.astype(np.float64), parts.action_high.astype(np.float64)  # float64: no overflow
    rounding = BOUNDS_ROUNDING * np.maximum(np.abs(low), np.abs(high))
    is_outside = (contract.action_low < low - rounding) | (contract.action_high > high + rounding)
    if is_outside.any():
        place = int(is_outside.argmax())
        raise InputError(
            f"the policy's action[{place}] is between {contract.action_low[place]:g} and "
            f"{contract.action_high[place]:g}; {name} takes {low[place]:g} to {high[place]:g}"
        )


def _describe(parts: Parts) -> str:
    return ", ".join(str(shape) if key is None else f"{key} {shape}" for key, shape in parts)
