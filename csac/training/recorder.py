"""Turns what the groups yield into the files of a run, in an order that does not depend on which group was faster."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.training.groups import GroupCrashed
from csac.training.loop import Ended, Evaluated, Failed, Progress, Rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.deploy.policy import Policy
    from csac.record.run import RunDirectory
    from csac.training.logs import TensorBoardLog
    from csac.training.loop import Event
    from csac.training.progress import Reporter

OVER = np.iinfo(np.int64).max  # the step of a group that is over: it holds nobody back


class Recorder:
    """The only writer of a run directory. Rows wait until every group has passed their step, then go out in order."""

    def __init__(
        self,
        run: RunDirectory,
        groups: Sequence[Sequence[int]],
        reporter: Reporter | None,
        tensorboard: TensorBoardLog | None,
    ) -> None:
        self.run, self.groups, self.reporter, self.tensorboard = run, groups, reporter, tensorboard
        self.failures: dict[int, str] = {}
        self.evaluated: list[tuple[int, dict[int, float]]] = []  # since the caller last emptied it
        self._passed = [0] * len(groups)
        self._steps = dict.fromkeys((seed for group in groups for seed in group), 0)
        self._pending: dict[str, list[dict[str, Any]]] = defaultdict(list)
        self._best: dict[int, float] = {}

    def handle(self, group: int, event: Event | GroupCrashed) -> None:
        """Take one event of one group."""
        match event:
            case Rows(table, rows):
                self._pending[table] += rows
            case Evaluated():
                self._evaluated(event)
            case Failed():
                self._failed(event)
            case Progress(step):
                self._progress(group, step)
            case Ended(step, policies):
                self._progress(group, step)
                self._save(policies)
                self._passed[group] = OVER
                self._flush()
            case GroupCrashed():
                self._crashed(group, event)

    def close(self) -> None:
        """Write what still waits."""
        self._passed = [OVER] * len(self.groups)
        self._flush()
        self.run.update_manifest(steps_done=max(self._steps.values()))

    def _evaluated(self, event: Evaluated) -> None:
        self._pending["evaluations"] += event.rows
        self._save(event.policies)
        for seed, value in _mean_returns(event.rows).items():
            if value > self._best.get(seed, -np.inf):
                self._best[seed] = value
                event.policies[seed].save(self.run.path / "policy" / f"seed_{seed}.best.safetensors")

    def _failed(self, event: Failed) -> None:
        if event.policy is not None:
            self._save({event.seed: event.policy})
        self._note_failure(event.seed, event.step, event.reason, event.details)

    def _crashed(self, group: int, event: GroupCrashed) -> None:
        for seed in self.groups[group]:
            self._note_failure(seed, self._steps[seed], event.reason, event.details)
        self._passed[group] = OVER
        self._flush()

    def _note_failure(self, seed: int, step: int, reason: str, details: str) -> None:
        self.failures[seed] = f"step {step}: {reason}"
        self.run.log(f"seed {seed} stopped at step {step}: {reason}\n{details}".rstrip())
        self.run.update_manifest(failures=self.failures)
        if self.reporter:
            self.reporter.failed(seed, step, reason)

    def _progress(self, group: int, step: int) -> None:
        self._passed[group] = step
        self._steps.update({seed: step for seed in self.groups[group] if seed not in self.failures})
        self._flush()
        if self.reporter:
            self.reporter.progress(self._steps)

    def _save(self, policies: dict[int, Policy]) -> None:
        for seed, policy in policies.items():
            contract = self.run.path / "policy" / "contract.json"
            if not contract.exists():
                contract.parent.mkdir(exist_ok=True)
                policy.contract.save(contract)
            policy.save(self.run.path / "policy" / f"seed_{seed}.safetensors")

    def _flush(self) -> None:
        """Write the rows that no group can precede any more."""
        limit = min(self._passed)
        for table in ("episodes", "metrics", "evaluations"):
            waiting = self._pending[table]
            ready = [row for row in waiting if row["step"] <= limit]
            if not ready:
                continue
            self._pending[table] = [row for row in waiting if row["step"] > limit]
            ready.sort(key=lambda row: (row["step"], row["seed"], row.get("episode", 0)))
            self.run.append(table, ready)
            if self.tensorboard:
                getattr(self.tensorboard, table)(ready)
            if table == "evaluations":
                self._announce(ready)

    def _announce(self, rows: list[dict[str, Any]]) -> None:
        """Tell whoever watches of each evaluation that every group has passed."""
        for step in sorted({row["step"] for row in rows}):
            returns = _mean_returns([row for row in rows if row["step"] == step])
            self.evaluated.append((step, returns))
            self.run.log(f"step {step}: " + ", ".join(f"seed {seed} {value:.1f}" for seed, value in returns.items()))
            self.run.update_manifest(steps_done=step)
            if self.reporter:
                self.reporter.evaluated(step, returns)


def _mean_returns(rows: list[dict[str, Any]]) -> dict[int, float]:
    returns: dict[int, list[float]] = defaultdict(list)
    for row in rows:
        returns[row["seed"]].append(row["return"])
    return {seed: float(np.mean(values)) for seed, values in returns.items()}
