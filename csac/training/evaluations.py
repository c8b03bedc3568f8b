"""Evaluations during training: between steps, in parallel processes, or in the training environment itself."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.evaluation.evaluator import LONGEST_EPISODE, EvaluationFailure, Evaluator
from csac.evaluation.pool import EvaluationPool, EvaluationStopped
from csac.tasks.perturbations import perturbations_of, values_at
from csac.training.callbacks import mean_return

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import ExitStack

    from csac.evaluation.evaluator import EvaluationEpisode
    from csac.record.recorder import Recorder
    from csac.record.run import RunDirectory
    from csac.tasks.vector import SeedEnvironments
    from csac.training.callbacks import Notifier
    from csac.training.program import Program
    from csac.training.watch import Watcher
    from csac.types import PolicyNetwork

SECONDS_TO_FINISH = 10.0  # that an evaluation may still take after a stop is requested


class Evaluations:
    """Evaluates the policies of runs that train together, one evaluation at a time, and records each.

    The notifier may end training; `stack` closes the evaluators.
    """

    def __init__(
        self,
        program: Program,
        runs: Sequence[RunDirectory],
        recorders: Sequence[Recorder],
        environments: SeedEnvironments,
        watcher: Watcher,
        notifier: Notifier,
        stack: ExitStack,
    ) -> None:
        self.runs, self.recorders, self.environments = runs, recorders, environments
        self.watcher, self._notifier = watcher, notifier
        config = runs[0].config
        self.evaluator = self._evaluator = Evaluator(
            *(program.task, config.environment_arguments, config.evaluation_episodes, config.evaluation_seed),
            config.events,
            environments=config.evaluation_environments or 1,
            lent=None if config.evaluation_environments else environments.environments[0],
        )
        stack.callback(self._evaluator.close)
        if program.evaluation_processes and config.evaluation_interval:
            self.evaluator = pool = EvaluationPool(self._evaluator, program.evaluation_processes)
            stack.callback(pool.close)
            pool.start(program.evaluation_processes)
        self._algorithm = config.algorithm
        self._perturbations = perturbations_of(config.perturbations)
        self._pending: tuple[int, list[int], list[Policy], Any] | None = None
        self.step = int(runs[0].rows("evaluations")["step"].max(initial=0))  # of the newest evaluation
        self.wants_stop = False  # whether a callback ends the runs, or an evaluation was broken off
        self.broken_off: list[int] = []  # the steps of evaluations that were broken off, or not begun after one
        self.should_stop: Callable[[], bool] = lambda: False
        self._deadline = 0.0  # of the evaluation in progress, once a stop was requested
        self._missing_events = [] if len(runs[0].evaluations) else sorted(config.events)

    @property
    def is_ready(self) -> bool:
        """Whether the evaluation in progress is done and only needs recording by `finish`."""
        return bool(self._pending and self._pending[3].is_over)

    def policy(self, network: PolicyNetwork, step: int) -> Policy:
        """Return the policy for deployment that has this network."""
        return Policy(network, self.contract(network), step=step)

    def contract(self, network: PolicyNetwork) -> Contract:
        """Return the contract of policies with such a network."""
        names = self.environments.task_name, self._algorithm, network.activation, network.head
        return Contract(*names, *self.environments.contract_parts, critic_activation=network.critic_activation)

    def begin(self, step: int, networks: Sequence[PolicyNetwork], task_step: int) -> None:
        """Begin to evaluate each seed's network of `step`, on the task as perturbed after `task_step`."""
        self.finish()
        if self.broken_off:  # a resume makes this evaluation
            self.broken_off.append(step)
            return
        self.step = step
        indices = [i for i in np.flatnonzero(self.environments.alive).tolist() if is_finite(networks[i])]
        policies = [self.policy(networks[i], step) for i in indices]
        self._evaluator.perturb(values_at(self._perturbations, task_step))
        self._pending = (step, indices, policies, self.evaluator.begin(policies))
        if self.is_ready:
            self.finish()

    def finish(self) -> None:
        """Wait for the evaluation in progress, if any, and record it; a stop request breaks off a long one."""
        if not self._pending:
            return
        (step, indices, policies, pending), self._pending = self._pending, None
        try:
            answers = pending.results(self._should_break_off)
        except EvaluationStopped:
            self.broken_off, self.wants_stop = [step], True
            self.watcher.note_of(
                self.runs[0], f"the evaluation at step {step:,} is broken off, as a stop was asked for"
            )
            return
        results: dict[int, tuple[Policy, list[EvaluationEpisode]]] = {}
        for index, policy, result in zip(indices, policies, answers, strict=True):
            run = self.runs[index]
            if isinstance(result, EvaluationFailure):
                self.watcher.note_of(run, f"warning: seed {run.seed}: the evaluation at step {step:,} failed: {result}")
                continue
            self._record(index, step, policy, result)
            results[index] = policy, result
        for text in pending.notes:
            self.watcher.note_of(self.runs[0], text)
        if results:
            self._warn_of_missing_events([episode for _, episodes in results.values() for episode in episodes])
            means = {self.runs[index].seed: mean_return(episodes) for index, (_, episodes) in results.items()}
            self.watcher.evaluated(step, means)
        self.wants_stop = self._notifier.evaluated(step, results) or self.wants_stop

    def _should_break_off(self) -> bool:
        """Return whether a stop was requested so long ago that the evaluation in progress should be broken off."""
        if not self.should_stop():
            return False
        self._deadline = self._deadline or time.monotonic() + SECONDS_TO_FINISH
        return time.monotonic() >= self._deadline

    def _record(self, index: int, step: int, policy: Policy, episodes: list[EvaluationEpisode]) -> None:
        """Record a run's evaluation and its policy, also as the best one if it is the best so far."""
        run, recorder = self.runs[index], self.recorders[index]
        recorder.add("evaluations", [episode.row(run.seed, step) for episode in episodes])
        recorder.flush("evaluations")
        mean = mean_return(episodes)
        is_best = mean > recorder.best
        recorder.best = max(mean, recorder.best)
        policy.write(run.policy_file("last"))
        if is_best:
            policy.write(run.policy_file("best"))
        run.log(f"step {step}: mean return {mean:.1f}")
        run.update_manifest(steps_done=max(step, run.manifest.steps_done))
        if any(episode.length >= LONGEST_EPISODE for episode in episodes):
            self.watcher.note_of(run, f"step {step}: evaluation episodes were cut off after {LONGEST_EPISODE:,} steps")

    def _warn_of_missing_events(self, episodes: Sequence[EvaluationEpisode]) -> None:
        """Note which events no episode of the first evaluation reported."""
        for name in self._missing_events:
            if all(episode.events[name] is None for episode in episodes):
                self.watcher.note_of(self.runs[0], f"note: no episode's last info holds a number called {name!r}")
        self._missing_events = []


def is_finite(network: PolicyNetwork) -> bool:
    """Return whether every parameter is finite."""
    return all(np.isfinite(array).all() for array in jax.tree.leaves(network.parameters))
