"""Turns what the groups yield into the files of a run, in an order that does not depend on which group was faster."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from csac.record.run import Table
from csac.record.statistics import best_returns, mean_returns
from csac.training.messages import (
    BegunAnew,
    Boundary,
    Ended,
    Evaluated,
    Failed,
    GroupCrashed,
    GroupRestarted,
    Noted,
    NotSaved,
    Progress,
    Refused,
    Rows,
    Saved,
)
from csac.training.restore import LOG, keep_best_policies, keep_tables

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from csac.console.progress import Reporter
    from csac.deploy.policy import Policy
    from csac.record.run import RunDirectory
    from csac.record.scalars import Log
    from csac.training.checkpoint import Checkpoints
    from csac.training.messages import Message
    from csac.training.seed_files import Files

OVER = np.iinfo(np.int64).max  # the step of a group that is over: it holds nobody back


class Recorder:
    """Writes what a run has to tell: tables, policies, manifest, log. Rows wait until every group has passed them.

    Args:
        run: the run directory.
        groups: the seeds of each group.
        reporter: where progress is shown, or None.
        logs: where its curves go as well.
        checkpoints: where checkpoints are committed, or None.
        begin: the step that the run goes on from; 0 for a new run.
        failures: the seeds that had failed by then, and how.
        perturbations: (step, what changes there), in order.
    """

    def __init__(
        self,
        run: RunDirectory,
        groups: Sequence[Sequence[int]],
        reporter: Reporter | None,
        logs: Sequence[Log],
        checkpoints: Checkpoints | None = None,
        begin: int = 0,
        failures: Mapping[int, str] = MappingProxyType({}),
        perturbations: Sequence[tuple[int, str]] = (),
    ) -> None:
        self.run, self.groups, self.reporter, self.logs = run, groups, reporter, logs
        self.checkpoints = checkpoints
        self.failures: dict[int, str] = dict(failures)
        self._begin, self._failed_at = begin, dict.fromkeys(failures, begin)
        self.inexact: set[int] = set()
        self.evaluated: list[tuple[int, dict[int, float]]] = []  # since the caller last emptied it
        self._passed = [begin] * len(groups)
        self._written = begin  # every row up to this step is in the tables, and none after it
        self._received: list[dict[Table, int]] = [dict.fromkeys(get_args(Table), begin) for _ in groups]
        self._steps = dict.fromkeys((seed for group in groups for seed in group), begin)
        self._made = dict(self._steps)  # steps of which some may not have been told of yet
        self._pending: dict[Table, list[dict[str, Any]]] = defaultdict(list)
        self._saved: dict[int, dict[int, Files]] = defaultdict(dict)  # step -> group -> its files
        # One that was lost is followed by the best of later evaluations, and that of another task by the first of this.
        origin, known = run.manifest.forked_from, run.evaluations
        if origin and origin.has_other_returns:
            known = known[known["step"] > origin.step]
        self._best = {k: v for k, v in best_returns(known).items() if self.run.policy(k, "best").exists()}
        # Told once, after the first evaluation of the run.
        self._unheard = set() if len(run.evaluations) else set(run.manifest.events)
        self._info_names: set[str] = set()
        self._perturbations = [(step, text) for step, text in perturbations if step >= begin]  # still to be told

    def handle(self, group: int, message: Message) -> None:
        """Take one message of one group."""
        match message:
            case Rows(table, rows):
                self._take(group, table, rows)
            case Evaluated():
                self._evaluated(group, message)
            case Failed():
                self._failed(message)
            case Progress(step):
                self._progress(group, step)
            case Boundary(step):
                if step > self._passed[group]:  # else it has just been shown
                    self._show(group, step)
            case Saved():
                self._progress(group, message.step)
                self._commit_when_whole(group, message)
            case Ended(step, policies):
                self._progress(group, step)
                self._save(policies)
                self._passed[group] = OVER
                self._commit_whole()
                self._flush()
            case GroupCrashed():
                self._crashed(group, message)
            case GroupRestarted(reason, step):
                self._go_back(group, step)
                self._note(f"{_seeds(self.groups[group])}: {reason}; started again from step {step:,}")
            case Noted(text):
                self._note(text)
            case BegunAnew():
                self._begun_anew(message)
            case NotSaved(error) | Refused(error):
                raise error

    def is_complete(self, steps: int) -> bool:
        """Return whether every seed has made so many steps, or has failed."""
        return all(step >= steps or seed in self.failures for seed, step in self._steps.items())

    def close(self) -> None:
        """Write what still waits."""
        self._passed = [OVER] * len(self.groups)
        self._flush()
        self.run.update_manifest(steps_done=self._furthest())

    def _furthest(self) -> int:
        """Return the most steps that a seed has made, those of the beginning where none is left to make any."""
        return max(self._steps.values(), default=self._begin)

    def _take(self, group: int, table: Table, rows: list[dict[str, Any]]) -> None:
        """Let rows wait for their turn, but for those that a restarted group makes for the second time."""
        if not rows or rows[0]["step"] <= self._received[group][table]:
            return
        self._received[group][table] = rows[0]["step"]
        self._pending[table] += rows

    def _evaluated(self, group: int, message: Evaluated) -> None:
        self._take(group, "evaluations", message.rows)
        self._info_names |= message.info_names
        self._save(message.policies)
        for seed, value in mean_returns(message.rows).items():
            if value > self._best.get(seed, -np.inf):
                self._best[seed] = value
                message.policies[seed].write(self.run.policy(seed, "best"))

    def _commit_when_whole(self, group: int, message: Saved) -> None:
        """Keep a group's best policies with its files; with the last living group's files there is a checkpoint."""
        assert self.checkpoints
        best = keep_best_policies(self.run.path, self.groups[group], message.step)
        for seed, problem in message.inexact.items():
            if problem and seed not in self.inexact:
                self._note(f"seed {seed}: {problem}; after a stop its episode begins anew")
        self.inexact.update(message.inexact)
        self._saved[message.step][group] = {**message.files, **best}
        self._commit_whole()

    def _commit_whole(self) -> None:
        """Commit what every group has saved that had not failed by then."""
        for step in sorted(self._saved):
            needed = {group for group in range(len(self.groups)) if not self._had_failed(group, step)}
            # Where every seed had failed there is nothing to go on with: the checkpoint before stays the newest.
            is_whole = needed and needed <= self._saved[step].keys()
            if is_whole and self._written <= step:  # else the tables have rows already that are not part of it
                self._commit(step)

    def _had_failed(self, group: int, step: int) -> bool:
        """Whether a group has nothing at a step, and all that it made before has been heard."""
        failed = all(seed in self.failures and self._failed_at[seed] <= step for seed in self.groups[group])
        return failed and self._passed[group] >= step

    def _commit(self, step: int) -> None:
        assert self.checkpoints
        self._flush(step)
        for log in self.logs:
            log.flush()
        # In order of the groups, not of who was saved first, so that equal runs have equal checkpoints.
        parts = [part for _, part in sorted(self._saved[step].items())]
        files = {name: facts for part in parts for name, facts in part.items()}
        failures = {seed: text for seed, text in self.failures.items() if self._failed_at[seed] <= step}
        files |= keep_tables(self.run.path, step)
        log = self.run.path / LOG
        log_bytes = log.stat().st_size if log.exists() else 0
        values = {"log_bytes": log_bytes, "failures": failures, "groups": self.groups}
        # Said before, so that no checkpoint is ever taken for exact that is not.
        self.run.update_manifest(steps_done=step, inexact_seeds=sorted(self.inexact))
        if any(failed_at > step for failed_at in self._failed_at.values()):
            self.checkpoints.pin(step)  # all were saved here by the time a seed ahead failed, and it was sound
        self.checkpoints.commit(step, files, values)
        self.run.update_manifest(last_checkpoint=step)
        for earlier in [other for other in self._saved if other <= step]:
            del self._saved[earlier]

    def _go_back(self, group: int, step: int) -> None:
        """Wait for a group that was started again at `step`.

        It will pass the steps of checkpoints again and save: until then the one that it began with must stay, and no
        row of a later step may reach the tables.
        """
        self._passed[group] = step
        self._made.update(dict.fromkeys(self.groups[group], step))
        for part in self._saved.values():
            part.pop(group, None)

    def _failed(self, message: Failed) -> None:
        if message.seed in self.failures:
            return  # a restarted group meets the same failure again
        if message.policy is not None:
            self._save({message.seed: message.policy})
        self._note_failure(message.seed, message.step, message.reason, message.details)

    def _crashed(self, group: int, message: GroupCrashed) -> None:
        for seed in self.groups[group]:
            if seed not in self.failures:  # one that had failed before keeps its reason
                self._note_failure(seed, self._steps[seed], message.reason, message.details)
        self._passed[group] = OVER
        self._commit_whole()
        self._flush()

    def _note_failure(self, seed: int, step: int, reason: str, details: str) -> None:
        self.failures[seed], self._failed_at[seed] = f"step {step}: {reason}", step
        if self.checkpoints:
            self.checkpoints.pin_newest()
        self.run.log(f"seed {seed} stopped at step {step}: {reason}\n{details}".rstrip())
        self.run.update_manifest(failures=self.failures)
        if self.reporter:
            self.reporter.failed(seed, step, reason)

    def tell(self, lines: Sequence[str]) -> None:
        """Write lines into the log and show them."""
        for line in lines:
            self._note(line)

    def _note(self, text: str) -> None:
        self.run.log(text)
        if self.reporter:
            self.reporter.note(text)

    def _begun_anew(self, message: BegunAnew) -> None:
        """Note that the run is not the one that was never stopped; the next checkpoint may be exact again."""
        self._note(f"seed {message.seed}: {message.reason}; its episode begins anew")
        before = self.run.manifest
        history = [*before.history[:-1], *(replace(last, exact=False) for last in before.history[-1:])]
        inexact = {*before.inexact_seeds, message.seed}
        self.run.update_manifest(history=tuple(history), inexact_seeds=tuple(sorted(inexact)))

    def _progress(self, group: int, step: int) -> None:
        self._passed[group] = max(step, self._passed[group])
        self._steps.update({seed: step for seed in self.groups[group] if seed not in self.failures})
        self._flush()
        self._show(group, step)

    def _show(self, group: int, step: int) -> None:
        """Show how far a group is."""
        self._made.update(
            {seed: max(step, self._made[seed]) for seed in self.groups[group] if seed not in self.failures}
        )
        if self.reporter:
            self.reporter.progress(self._made)

    def _save(self, policies: dict[int, Policy]) -> None:
        for seed, policy in policies.items():
            policy.write(self.run.policy(seed))

    def _flush(self, until: int = OVER) -> None:
        """Write the rows that no group can precede any more, as far as step `until`."""
        limit = min([until, *self._passed])
        self._written = max(limit, self._written)
        written: dict[Table, list[dict[str, Any]]] = {}
        for table in get_args(Table):
            waiting = self._pending[table]
            ready = [row for row in waiting if row["step"] <= limit]
            if not ready:
                continue
            self._pending[table] = [row for row in waiting if row["step"] > limit]
            ready.sort(key=lambda row: (row["step"], row["seed"], row.get("episode", 0)))
            self.run.append(table, ready)
            written[table] = ready
        if written:
            for log in self.logs:
                self.tell(log.write(written))
            self._announce(written.get("evaluations", []))
        self._tell_perturbations(min(limit, self._furthest()))

    def _announce(self, rows: list[dict[str, Any]]) -> None:
        """Tell whoever watches of each evaluation that every group has passed."""
        for step in sorted({row["step"] for row in rows}):
            self._tell_perturbations(step)
            returns = mean_returns([row for row in rows if row["step"] == step])
            self.evaluated.append((step, returns))
            self.run.log(f"step {step}: " + ", ".join(f"seed {seed} {value:.1f}" for seed, value in returns.items()))
            self.run.update_manifest(steps_done=step)
            if self.reporter:
                self.reporter.evaluated(step, returns)
            self._tell_unheard(rows)

    def _tell_unheard(self, rows: list[dict[str, Any]]) -> None:
        """Say which events no evaluation episode has held, and what there is instead."""
        held = {name for row in rows for name in self._unheard if row.get(name) is not None}
        for name in sorted(self._unheard - held):
            there = ", ".join(sorted(self._info_names)) or "nothing"
            self._note(f"note: no episode's last info holds a number called {name!r} so far; it holds {there}")
        self._unheard = set()

    def _tell_perturbations(self, step: int) -> None:
        """Note, once, what has changed by this step: after a checkpoint of the very step it has not yet."""
        while self._perturbations and self._perturbations[0][0] < step:
            begin, text = self._perturbations.pop(0)
            self._note(f"perturbed from step {begin + 1:,} on: {text}")


def _seeds(seeds: Sequence[int]) -> str:
    return f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"
