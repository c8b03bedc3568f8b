"""One loop for every algorithm: step the environments, remember, learn, act. It knows no algorithm by name."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.evaluation.evaluator import EvaluationFailure, Evaluator
from csac.evaluation.pool import EvaluationPool
from csac.tasks.perturbations import values_at
from csac.tasks.seeds import SeedEnvironments
from csac.training.checkpoint import Checkpoint, taken_back
from csac.training.learner import Learner
from csac.training.messages import (
    BegunAnew,
    Boundary,
    Ended,
    Evaluated,
    Failed,
    GroupMessage,
    Noted,
    Progress,
    Rows,
    Saved,
    Settings,
)
from csac.training.seed_files import SeedFiles
from csac.types import Snapshot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from csac.evaluation.pending import Pending
    from csac.types import PolicyNetwork

METRICS_INTERVAL = 1_000


class Evaluation(NamedTuple):
    """Policies that are being evaluated in other processes, or will be in this one."""

    step: int
    policies: dict[int, Policy]
    pending: Pending


class Group:
    """Seeds that are trained side by side. At a `Boundary` of `run` it can be saved, after `settle`.

    Strict order: whatever updates the step before an action has brought are made before it.

    Evaluations may be made by processes beside this one while training goes on. What happens meanwhile is told after
    what they give, so that the order of messages and all that they say is the same as with evaluations in line.

    Args:
        settings: what is trained and how, and where it begins.
        seeds: the labels of the seeds.
        cores: the processors for the processes that evaluate; None for those of this one.

    Raises:
        Damaged: the checkpoint to go on from cannot be read.
        InputError: it does not fit the algorithm or the task.
    """

    def __init__(self, settings: Settings, seeds: Sequence[int], cores: Sequence[int] | None = None) -> None:
        plan = settings.plan
        self.settings, self.seeds, self.step = settings, list(seeds), settings.begin
        self.environments = SeedEnvironments(plan.task, plan.environment_arguments, seeds)
        self.evaluator = Evaluator(
            plan.task, plan.environment_arguments, plan.evaluation_episodes, plan.evaluation_seed, plan.events
        )
        processes = plan.evaluation_processes
        self._pool = EvaluationPool(self.evaluator, processes, cores) if processes else None
        self._evaluation: Evaluation | None = None  # the one on its way
        self._held: list[GroupMessage] = []  # what has happened after it
        self._info_names: set[str] = set()
        self.learner = Learner(plan.algorithm, self.environments.spec, seeds, plan.steps)
        self._contract = Contract(
            self.environments.task_name,
            plan.algorithm.name,
            self.learner.network.activation,
            self.learner.network.head,
            *self.environments.contract_parts,
        )
        self._files: list[SeedFiles] = []
        self._changes = {item.step for item in plan.perturbations}
        self._perturb(max(settings.begin - 1, 0))  # as in the step that the checkpoint came after
        if settings.begin:
            assert settings.checkpoints
            checkpoint = Checkpoint.open(settings.checkpoints, settings.begin)
            with taken_back(checkpoint):
                self._go_on(checkpoint)
        else:
            self._observations = self.environments.reset()
            self._actions = self.learner.next_actions(self._observations, 0)
        if settings.checkpoints and not self._files:
            self._files = [SeedFiles(settings.checkpoints, seed, {}) for seed in seeds]

    def run(self, should_stop: Callable[[], bool]) -> Iterator[GroupMessage]:
        """Train to the last step and yield what happens; the caller writes it down."""
        if self._pool:
            self._pool.start()
        for index, reason in self.environments.refused.items():
            yield BegunAnew(self.seeds[index], reason)
        for message in self._train(should_stop):
            if self._evaluation and not isinstance(message, Boundary):
                self._held.append(message)
            else:
                yield message

    def settle(self) -> Iterator[GroupMessage]:
        """Wait for the evaluation that is on its way, if there is one; yield what it gives, then what waited for it."""
        if not self._evaluation:
            return
        evaluation, held = self._evaluation, self._held
        self._evaluation, self._held = None, []
        failed: set[int] = set()
        for message in self._outcome(evaluation):
            if isinstance(message, Failed):
                failed.add(message.seed)
            yield message
        for message in held:
            if (rest := _without(message, failed)) is not None:
                yield rest

    def _train(self, should_stop: Callable[[], bool]) -> Iterator[GroupMessage]:
        plan, environments = self.settings.plan, self.environments
        while self.step < plan.steps and environments.is_any_alive and not should_stop():
            yield from self._advance()
            last = self.step == plan.steps
            if self.step % METRICS_INTERVAL == 0 or last:
                yield Rows("metrics", _metrics_rows(self.learner, environments, self.seeds, self.step))
            if self.step % METRICS_INTERVAL == 0:
                self.learner.forget_metrics()
            boundary = self.settings.ends_turn(self.step)
            if boundary:
                yield from self._stop_diverged()
            due = self.step % plan.evaluation_interval == 0 or last
            if due:
                yield from self.settle()  # one at a time
                self._evaluation = self._begin_evaluation()
            if self._evaluation and (due or boundary) and self._evaluation.pending.is_over:
                yield from self.settle()
            if boundary or (due and not self._evaluation):  # so that who watches hears of an evaluation at once
                yield Progress(self.step)
            if boundary:
                yield Boundary(self.step)
        yield from self.settle()
        if not self.settings.ends_turn(self.step):
            yield from self._stop_diverged()  # what is saved of a stop between two turns is looked at as well
        yield Ended(self.step, self.policies())

    def policies(self) -> dict[int, Policy]:
        """Return the policies of the seeds that are alive and sound."""
        networks = self.learner.networks()
        return {
            seed: Policy(networks[i], self._contract, step=self.step)
            for i, seed in enumerate(self.seeds)
            if self.environments.alive[i] and _is_finite(networks[i])
        }

    def save(self) -> Saved:
        """Write what a checkpoint at this step needs of the group.

        Raises:
            OSError: it cannot be written.
        """
        files, inexact = {}, {}
        for index, (seed, seed_files) in enumerate(zip(self.seeds, self._files, strict=True)):
            learnt, environment = self.learner.save(index), self.environments.save(index)
            arrays = {
                **{f"learner.{name}": array for name, array in learnt.arrays.items()},
                **{f"environment.{name}": array for name, array in environment.arrays.items()},
                "actions": self._actions[index],
            }
            values = {"learner": learnt.values, "environment": environment.values}
            memory = self.learner.memory(index, self.step)
            files |= seed_files.write(self.step, Snapshot(arrays, values), memory)
            if self.environments.alive[index] and not environment.values["exact"]:
                inexact[seed] = environment.values["problem"]
        return Saved(self.step, files, inexact)

    def close(self) -> None:
        """Close every environment, and end the processes that evaluate."""
        if self._pool:
            self._pool.close()
        self.environments.close()
        self.evaluator.close()

    def _advance(self) -> Iterator[GroupMessage]:
        """Make one environment step, and learn from it."""
        if self.step in self._changes:
            self._perturb(self.step)
        outcome = self.environments.step(self._actions)
        self.step += 1
        for failure in outcome.failures:
            network = self.learner.networks()[failure.place]
            policy = Policy(network, self._contract, step=self.step) if _is_finite(network) else None
            yield Failed(self.seeds[failure.place], self.step, failure.reason, failure.details, policy)
        if outcome.episodes:
            yield Rows("episodes", [_episode_row(self.seeds[e.place], self.step, e) for e in outcome.episodes])
        self._actions = self.learner.step(self._observations, self._actions, outcome, self.step)
        self._observations = outcome.observation
        flat = self._actions.ravel()
        # One product finds a nan or an inf in a third of the time of np.isfinite().all().
        if not flat.dot(flat) < np.inf and not np.isfinite(self._actions[self.environments.alive]).all():
            yield from self._stop_diverged()

    def _perturb(self, step: int) -> None:
        """Have the task as it is in the environment step after the first `step`."""
        if self._changes:
            self.environments.perturb(values_at(self.settings.plan.perturbations, step))

    def _begin_evaluation(self) -> Evaluation:
        """Begin to evaluate the policies of now, on the task as it was in the last step."""
        policies = self.policies()
        self.evaluator.perturb(values_at(self.settings.plan.perturbations, self.step - 1))
        return Evaluation(self.step, policies, (self._pool or self.evaluator).begin(list(policies.values())))

    def _outcome(self, evaluation: Evaluation) -> Iterator[GroupMessage]:
        """Yield what an evaluation gives; stop the seeds that fail in it."""
        rows, policies, step = [], dict(evaluation.policies), evaluation.step
        results = evaluation.pending.results()
        for note in evaluation.pending.notes:
            yield Noted(f"step {step}: {note}")
        for seed, result in zip(evaluation.policies, results, strict=True):
            if isinstance(result, EvaluationFailure):
                self.environments.stop(self.seeds.index(seed))
                yield Failed(seed, step, f"its evaluation failed: {result}", "", policies.pop(seed))
            else:
                rows += [episode.row(seed, step) for episode in result]
        limit = self.evaluator.episode_limit
        if any(row["length"] >= limit for row in rows):
            yield Noted(f"step {step}: evaluation episodes were broken off after {limit:,} steps: do they end?")
        self._info_names |= self.evaluator.info_names
        yield Evaluated(step, rows, policies, frozenset(self._info_names))

    def _stop_diverged(self) -> Iterator[GroupMessage]:
        """Stop each seed whose parameters, or what they led to, are not finite. Its last checkpoint stays sound."""
        for index in np.flatnonzero(self.environments.alive).tolist():
            bad = self.learner.first_bad(index)
            if bad is None and not np.isfinite(self._actions[index]).all():
                bad = "the policy's action"
            if bad is not None:
                self.environments.stop(index)
                reason = f"{bad} is not finite: learning has diverged (a lower learning rate may help)"
                yield Failed(self.seeds[index], self.step, reason, "", None)

    def _go_on(self, checkpoint: Checkpoint) -> None:
        """Take everything back that `save` wrote."""
        actions = np.zeros((len(self.seeds), self.environments.spec.action_size), np.float32)
        learnt, anew = [], []
        for index, seed in enumerate(self.seeds):
            saved = checkpoint.seed(seed)
            learnt.append(saved.part("learner"))
            if saved.arrays["actions"].shape != actions[index].shape:
                raise ValueError(f"the next action has shape {saved.arrays['actions'].shape}")
            actions[index] = saved.arrays["actions"]
            environment = saved.part("environment")
            if self.settings.has_other_task:
                environment.values["exact"] = False
            if not self.environments.restore(index, environment):
                anew.append(index)
        self.learner.take_back(learnt, [functools.partial(checkpoint.memory, seed) for seed in self.seeds])
        self._files = [SeedFiles(checkpoint.folder, seed, checkpoint.files) for seed in self.seeds]
        self._observations, self._actions = self.environments.observations, actions
        if anew:
            self.learner.break_off(anew, self.step)
            self._actions[anew] = self.learner.next_actions(self._observations, self.step)[anew]


def _without(message: GroupMessage, seeds: set[int]) -> GroupMessage | None:
    """Return the message without what these seeds did, or None where nothing is left of it."""
    if isinstance(message, Rows):
        rows = [row for row in message.rows if row["seed"] not in seeds]
        return Rows(message.table, rows) if rows else None
    return None if isinstance(message, Failed) and message.seed in seeds else message


def _episode_row(seed: int, step: int, episode: Any) -> dict[str, Any]:
    return {"seed": seed, "step": step, "return": episode.episode_return, "length": episode.length}


def _metrics_rows(
    learner: Learner, environments: SeedEnvironments, seeds: Sequence[int], step: int
) -> list[dict[str, Any]]:
    rows = [{"seed": seed, "step": step, **metrics} for seed, metrics in zip(seeds, learner.metrics())]  # noqa: B905
    return [row for row, alive in zip(rows, environments.alive) if alive]  # noqa: B905


def _is_finite(network: PolicyNetwork) -> bool:
    return all(np.isfinite(array).all() for array in jax.tree.leaves(network.parameters))
