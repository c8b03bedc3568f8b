"""Write the rows of one run to its tables, TensorBoard and W&B."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.record.run import TABLES
from csac.record.statistics import best_return, is_case
from csac.record.summaries import events_in
from csac.record.wandb import WandbLog

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from csac.record.run import RunDirectory, Table


class Recorder:
    """Write the rows of one run, in batches of a few hundred steps.

    `begin` is the step that the run continues from; `wandb` may name the W&B project that gets TensorBoard's values.
    `note` receives a line if W&B fails.
    """

    def __init__(
        self,
        run: RunDirectory,
        begin: int,
        tensorboard: bool,
        wandb: bool | str = False,
        note: Callable[[str], None] | None = None,
    ) -> None:
        self.run, self._note = run, note or run.log
        self._queued: dict[Table, list[dict[str, Any]]] = defaultdict(list)
        rows = run.evaluations
        self.best = best_return(rows) if run.policy_file("best").exists() else -np.inf
        self._log = self._wandb = None
        if tensorboard or wandb:
            from csac.record.tensorboard import TensorBoardLog  # slow to import

            episodes = run.rows("episodes")
            recent = [dict(zip(episodes.dtype.names or (), row, strict=True)) for row in episodes.tolist()[-100:]]
            cases = [name for name in events_in(rows) if is_case(rows[name])]
            self._log = TensorBoardLog(run.tensorboard, begin, recent, cases)
        if wandb:
            self._wandb = self._call_wandb(WandbLog, run, wandb)

    def add(self, table: Table, rows: Sequence[dict[str, Any]]) -> None:
        """Queue rows of a table until the next `flush`."""
        self._queued[table] += rows

    def flush(self, *tables: Table) -> None:
        """Write the queued rows, of all tables unless some are given. Raises OSError."""
        for table in tables or TABLES:
            if rows := self._queued.pop(table, []):
                rows = _merged_by_step(rows) if table == "metrics" else rows
                self.run.append(table, rows)
                points = self._log.write(table, rows) if self._log else {}
                if self._wandb:
                    self._call_wandb(self._wandb.write, points)

    def sync(self) -> None:
        """Write the queued rows and TensorBoard's buffer: a resume does not repeat rows from before the checkpoint."""
        self.flush()
        if self._log:
            self._log.flush()

    def close(self) -> None:
        """Close the TensorBoard file, and finish the W&B run."""
        if self._log:
            self._log.close()
        if self._wandb:
            self._call_wandb(self._wandb.close)

    def _call_wandb(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of a W&B call; if it fails, stop logging to W&B and continue the run."""
        try:
            return call(*arguments)
        except Exception as error:
            self._wandb = None
            reason = " ".join(str(error).split())
            self._note(f"warning: W&B gets no more of seed {self.run.seed}: {type(error).__name__}: {reason}")


def _merged_by_step(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Merge the rows of each step into one: the algorithm's metrics and what callbacks log."""
    merged: dict[int, dict[str, Any]] = {}
    for row in rows:
        merged[row["step"]] = {**merged.get(row["step"], {}), **row}
    return [merged[step] for step in sorted(merged)]
