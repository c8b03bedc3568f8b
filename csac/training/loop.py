"""The training loop of every algorithm: step environments, store, update, act; evaluate, write and save when due."""

from __future__ import annotations

import time
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from csac.deploy.contract import write_with_checksum
from csac.record.manifest import written
from csac.record.recorder import Recorder
from csac.record.run import MANIFEST, TABLES
from csac.tasks.perturbations import by_step, perturbations_of, values_at
from csac.tasks.vector import SeedEnvironments
from csac.tasks.workers import choose_processes
from csac.training.callbacks import Notifier
from csac.training.checkpoint import Writer, prune
from csac.training.demonstrations import files_of, rows_of
from csac.training.evaluations import Evaluations, is_finite
from csac.training.hindsight import Hindsight
from csac.training.learner import Learner
from csac.training.resume import ResumePoint, record_inexact
from csac.types import InputError, Snapshot

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from csac.deploy.policy import Policy
    from csac.record.run import RunDirectory
    from csac.training.checkpoint import Checkpoint
    from csac.training.program import Program
    from csac.training.watch import Watcher

METRICS_INTERVAL = 1_000
CHECK_INTERVAL = 500  # steps between checks of what is due: rows to write, a signal, a diverged seed
SECONDS_BETWEEN_CHECKPOINTS = 600.0


class Loop:
    """Trains runs side by side that differ only in their seeds.

    Strict order: all updates due after a step finish before the next action is chosen. Evaluations may run in other
    processes while training goes on; their numbers are the same.

    This process must hold the runs' locks, and all runs must be at the same step. Raises InputError if a checkpoint
    does not fit, or the task cannot be made.
    """

    def __init__(
        self, program: Program, runs: Sequence[RunDirectory], points: Sequence[ResumePoint], watcher: Watcher
    ) -> None:
        self.runs, self.watcher, self.config = list(runs), watcher, runs[0].config
        self.step, self.steps = points[0].step, self.config.steps
        self._stride = self.config.environments  # environment steps per iteration: one per environment
        seeds = [run.seed for run in runs]
        arguments = self.config.environment_arguments
        with ExitStack() as stack:
            processes = program.environment_processes
            if processes is None:
                processes = choose_processes(program.task, arguments, self._stride, program.threads)
            self.environments = SeedEnvironments(
                program.task, arguments, seeds, self._stride, processes, self.config.events
            )
            stack.callback(self.environments.close)
            self.learner = Learner(
                program.algorithm, self.environments.spec, seeds, self.steps, self.config.extra_transitions
            )
            copies = self.config.hindsight
            self.hindsight = Hindsight(copies, self.environments, self.learner) if copies else None
            self._perturbations = perturbations_of(self.config.perturbations)
            self._changes = by_step(self._perturbations)
            self._begin(points)
            logs = self.step, program.tensorboard, program.wandb
            self.recorders = [Recorder(run, *logs, partial(watcher.note_of, run)) for run in runs]
            recorded = self.runs, self.recorders
            self.notifier = Notifier(
                program.interests, watcher.call, *recorded, self.learner.metric_names, self._policy
            )
            self.evaluations = Evaluations(program, *recorded, self.environments, watcher, self.notifier, stack)
            self._register_best()
            self._saved_at, self._saved_time = self.step, time.monotonic()
            self.has_returned = False
            self._resources = stack.pop_all()

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Train to the last step, until no seed is alive, or until a signal or a callback asks for a stop.

        Raises OSError if a run directory can no longer be written.
        """
        is_stopping, self.evaluations.should_stop = False, should_stop
        self.watcher.wait_for_turn(self.step)
        if self._evaluation_pending:
            self._evaluate(self.step)
            self._saved_at, is_stopping = -1, self.evaluations.wants_stop  # the rows are in no checkpoint yet
        while self.step < self.steps and self.environments.is_any_alive and not is_stopping:
            is_stopping = self._advance()
            is_last = self.step == self.steps
            if self._is_due(METRICS_INTERVAL) or is_last:
                self._record_metrics()
            is_check_due = self._is_due(CHECK_INTERVAL) or is_last
            if is_check_due:
                self._stop_diverged()
            if (due := self._due_evaluation()) is not None:
                self._evaluate(due)
            if is_check_due:
                self._write_and_report()
                is_stopping = should_stop() or is_stopping
            if self._is_due(self.config.checkpoint_interval):
                self.save()
            is_stopping = is_stopping or self.evaluations.wants_stop
        self._finish()
        self.has_returned = True

    def save(self) -> None:
        """Write a checkpoint of each run that goes on, unless this step already has one. Raises OSError."""
        self.evaluations.finish()
        self._stop_diverged()
        if self.step == self._saved_at:
            return
        alive = np.flatnonzero(self.environments.alive).tolist()
        for index in alive:
            run = self.runs[index]
            self.recorders[index].sync()
            saved = self._snapshot(index)
            restarts = not saved.values["environment"]["exact"]
            if restarts and not run.manifest.restarts_episode:
                problem = saved.values["environment"]["problem"] or "its environment cannot be saved"
                self.watcher.note_of(run, f"seed {run.seed}: {problem}: a resume restarts the episode in progress")
            run.update_manifest(steps_done=self.step, restarts_episode=restarts, last_checkpoint=self.step)
            self._writers[index].write(self.step, saved, self.learner.memory(index, self.step), _tables_and_policy(run))
        for index in alive:  # once all have this checkpoint: they resume from a common one
            prune(self.runs[index].checkpoints, self.config.keep_checkpoints)
        self._saved_at, self._saved_time = self.step, time.monotonic()

    def close(self) -> None:
        """Close the recorders and environments, and end the evaluation processes."""
        for recorder in self.recorders:
            recorder.close()
        self._resources.close()

    def _begin(self, points: Sequence[ResumePoint]) -> None:
        """Begin at step 0, or restore what `save` wrote."""
        demonstrations = files_of(self.config.demonstrations)
        self._writers = [Writer(run.checkpoints, demonstrations) for run in self.runs]
        self._evaluation_pending = False  # whether the evaluation of this step was broken off
        self._perturb(max(self.step - self._stride, 0))  # as it was during the checkpoint's last step
        if not self.step:
            if demonstrations:
                self.learner.extend([rows_of(run) for run in self.runs], 0)
            self._observations = self.environments.reset()
            self._actions = self.learner.next_actions(self._observations, 0)
            return
        axes = self.environments.observations.shape[:-1]
        self._actions = np.zeros((*axes, self.environments.spec.action_size), np.float32)
        learner_snapshots, restarted, fills = [], [], []
        for index, (run, point) in enumerate(zip(self.runs, points, strict=True)):
            assert point.checkpoint
            saved, origin = point.checkpoint.state(), run.manifest.forked_from
            environment = saved.part("environment")
            self.environments.refuse_incompatible(environment, saved.arrays["actions"])
            is_new_task = origin and origin.step == self.step and origin.changed("task ", "environment_arguments")
            if not is_new_task and saved.values.get("action_bounds") not in (None, self.environments.action_bounds):
                reason = "resume with the task and the versions of its packages that the manifest names"
                raise InputError(f"{run.path}: the task's action bounds have changed: {reason}")
            self._evaluation_pending = self._evaluation_pending or saved.values.get("evaluation_owed", False)
            for step in saved.values.get("evaluations_lost", []):
                self._note_inexact(run, f"seed {run.seed}: the evaluation at step {step:,} was broken off")
            learner_snapshots.append(saved.part("learner"))
            self._actions[index] = saved.arrays["actions"]
            # Forked here from a run of another task: its saved episode does not fit (changes read "task is X, not Y").
            if origin and origin.step == self.step and origin.changed("task "):
                environment.values["exact"] = False
            if not self.environments.restore(index, environment):
                restarted.append(index)
            elif self.hindsight:
                self.hindsight.restore(index, saved.part("hindsight"))
            fills.append(partial(self._fill, index, point.checkpoint))
        self.learner.restore(learner_snapshots, fills)
        self._observations = self.environments.observations
        for index, reason in self.environments.refused.items():
            self._note_inexact(self.runs[index], f"seed {self.runs[index].seed}: {reason}: its episode restarts")
        if restarted:
            self.learner.truncate_last(restarted, self.step)
            self._actions[restarted] = self.learner.next_actions(self._observations, self.step)[restarted]

    def _fill(self, index: int, checkpoint: Checkpoint, rows: np.ndarray) -> None:
        """Fill rows [capacity, width] with a run's transitions, and have its writer continue the checkpoint's files."""
        run, lost = self.runs[index], checkpoint.fill(rows)
        for text in lost:
            self._note_inexact(run, f"warning: {text}")
        self._writers[index] = Writer(run.checkpoints, {} if lost else checkpoint.files)

    def _register_best(self) -> None:
        """Put the checksums of best policies into their contracts: a rollback or a fork restores only the files."""
        fields = self.evaluations.contract(self.learner.network).fields()
        for best in (run.policy_file("best") for run in self.runs):
            if best.exists():
                write_with_checksum(best, best.read_bytes(), fields)

    def _advance(self) -> bool:
        """Step each environment once and learn from it; return whether a callback ends the runs."""
        for change in [text for step, text in self._changes if 0 <= self.step - step < self._stride]:
            self._perturb(self.step)
            text = f"perturbed from step {self.step + 1:,} on: {change}"
            for run in self.runs:
                run.log(text)
            self.watcher.note(text)
        outcome = self.environments.step(self._actions)
        self.step += self._stride
        for failure in outcome.failures:
            self.evaluations.finish()  # before it, so that the last policy is this one
            self._save_policy(failure.seed_index)
            self._fail(failure.seed_index, failure.reason, failure.details)
        for episode in outcome.episodes:
            row = {"seed": self.runs[episode.seed_index].seed, "step": self.step}
            row |= {"return": episode.episode_return, "length": episode.length, **episode.events}
            self.recorders[episode.seed_index].add("episodes", [row])
        if self.hindsight:
            self.hindsight.after_step(self._observations, self._actions, outcome, self.step)
        self._actions = self.learner.step(self._observations, self._actions, outcome, self.step)
        self._observations = outcome.observation
        flat = self._actions.ravel()
        # A dot product finds a nan or an inf in a third of the time of np.isfinite().all().
        if not flat.dot(flat) < np.inf and not np.isfinite(self._actions[self.environments.alive]).all():
            self._stop_diverged()
        return self.notifier.after_step(self.step, self._stride, self.environments.alive, outcome.episodes)

    def _due_evaluation(self) -> int | None:
        """Return the step of the evaluation that is due now, or None."""
        interval = self.config.evaluation_interval
        if not interval or self.step == self.steps:
            return self.step if interval else None
        if self.config.evaluation_environments:
            return self.step if self._is_due(interval) else None
        due = self.step - self.step % interval  # made once the episode in progress has ended
        return due if due > self.evaluations.step and self.environments.is_at_start else None

    def _evaluate(self, step: int) -> None:
        """Evaluate the current policies on the task as it was in the last step, recorded under `step`.

        In the training environment, `step` is the last multiple of the interval, passed up to an episode ago.
        """
        is_lent = not self.config.evaluation_environments  # the episodes run in the training environment
        saved = self.environments.save(0) if is_lent and not self.environments.is_at_start else None
        self.evaluations.begin(step, self.learner.networks(), self.step - self._stride)
        if saved and saved.values["exact"] and self.environments.restore(0, saved):
            self._observations = self.environments.observations
        elif is_lent:
            self.learner.truncate_last([0], self.step)
            self._observations = self.environments.begin_again()
            self._actions = self.learner.next_actions(self._observations, self.step)

    def _write_and_report(self) -> None:
        """Write waiting rows, report progress, save if the last save is old, wait for the next turn on the cores."""
        if self.evaluations.is_ready:
            self.evaluations.finish()
        for recorder in self.recorders:
            recorder.flush()
        alive = zip(self.runs, self.environments.alive.tolist(), strict=True)
        self.watcher.progress({run.seed: self.step for run, is_alive in alive if is_alive})
        if self.config.checkpoint_interval and time.monotonic() - self._saved_time >= SECONDS_BETWEEN_CHECKPOINTS:
            self.save()
        if self.step < self.steps:
            self.watcher.wait_for_turn(self.step)

    def _finish(self) -> None:
        """Write the newest policies, and save, at the end or after a stop."""
        self.evaluations.finish()
        self._stop_diverged()
        for index, alive in enumerate(self.environments.alive.tolist()):
            self.recorders[index].flush()
            if alive:
                self._save_policy(index)
                self.runs[index].update_manifest(steps_done=self.step)
        if self.config.checkpoint_interval:
            self.save()

    def _snapshot(self, index: int) -> Snapshot:
        parts = {"learner": self.learner.save(index), "environment": self.environments.save(index)}
        saved = Snapshot.joined(parts | ({"hindsight": self.hindsight.save(index)} if self.hindsight else {}))
        saved.arrays["actions"] = self._actions[index]
        saved.values["action_bounds"] = self.environments.action_bounds
        broken_off = self.evaluations.broken_off
        saved.values["evaluation_owed"] = self.step in broken_off
        saved.values["evaluations_lost"] = [step for step in broken_off if step != self.step]
        return saved

    def _policy(self, index: int) -> Policy:
        return self.evaluations.policy(self.learner.networks()[index], self.step)

    def _save_policy(self, index: int) -> None:
        policy = self._policy(index)
        if is_finite(policy.network):
            policy.write(self.runs[index].policy_file("last"))

    def _record_metrics(self) -> None:
        for index, metrics in enumerate(self.learner.metrics()):
            if self.environments.alive[index]:
                self.recorders[index].add("metrics", [{"seed": self.runs[index].seed, "step": self.step, **metrics}])
        if self._is_due(METRICS_INTERVAL):
            self.learner.reset_metrics()

    def _stop_diverged(self) -> None:
        """Stop each seed with parameters or actions that are not finite. Its last checkpoint stays sound."""
        for index in np.flatnonzero(self.environments.alive).tolist():
            bad = self.learner.first_non_finite(index)
            if bad is None and not np.isfinite(self._actions[index]).all():
                bad = "the policy's action"
            if bad is not None:
                self.environments.stop(index)
                self._fail(index, f"{bad} is not finite: learning has diverged (a lower learning rate may help)")

    def _fail(self, index: int, reason: str, details: str = "") -> None:
        run = self.runs[index]
        run.log(f"stopped at step {self.step}: {reason}\n{details}".rstrip())
        run.update_manifest(state="failed", failure=f"step {self.step}: {reason}", steps_done=self.step)
        self.watcher.failed(run.seed, self.step, reason)

    def _note_inexact(self, run: RunDirectory, text: str) -> None:
        self.watcher.note_of(run, text)
        record_inexact(run, text)

    def _perturb(self, step: int) -> None:
        """Apply the perturbations in force after `step` steps."""
        if self._perturbations:
            self.environments.perturb(values_at(self._perturbations, step))

    def _is_due(self, interval: int) -> bool:
        """Return whether this iteration reached or passed a multiple of `interval`."""
        return bool(interval) and self.step % interval < self._stride


def _tables_and_policy(run: RunDirectory) -> dict[str, bytes]:
    """Return what a checkpoint holds besides the state: the tables, the best policy and the manifest."""
    paths = [*map(run.table, TABLES), run.policy_file("best")]
    contents = {path.name: path.read_bytes() for path in paths if path.exists()}
    return {**contents, MANIFEST: written(run.manifest)}
