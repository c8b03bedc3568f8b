"""Writes what one run has to tell: tables, TensorBoard, policies and log."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.record.run import TABLES
from csac.record.statistics import best_returns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.record.run import RunDirectory, Table


class Recorder:
    """Writes the rows of one run, a few hundred steps at a time.

    Args:
        run: the run directory.
        begin: the step that it goes on from; 0 for its beginning.
        tensorboard: whether to write TensorBoard files too.
    """

    def __init__(self, run: RunDirectory, begin: int, tensorboard: bool) -> None:
        self.run = run
        self._waiting: dict[Table, list[dict[str, Any]]] = defaultdict(list)
        origin, known = run.manifest.forked_from, run.evaluations
        if origin and origin.changed("task ", "environment_arguments"):  # whose returns are of another task
            known = known[known["step"] > origin.step]
        self.best = best_returns(known).get(run.seed, -np.inf) if run.policy_file("best").exists() else -np.inf
        self._log = None
        if tensorboard:
            from csac.record.tensorboard import TensorBoardLog  # slow to import

            episodes = run.rows("episodes")
            before = [dict(zip(episodes.dtype.names or (), row, strict=True)) for row in episodes.tolist()[-100:]]
            self._log = TensorBoardLog(run.tensorboard, begin, before)

    def add(self, table: Table, rows: Sequence[dict[str, Any]]) -> None:
        """Take rows of a table, to be written at the next `flush`."""
        self._waiting[table] += rows

    def flush(self) -> None:
        """Write the rows that wait. Raises OSError."""
        for table in TABLES:
            if rows := self._waiting.pop(table, []):
                self.run.append(table, rows)
                if self._log:
                    self._log.write(table, rows)

    def sync(self) -> None:
        """Write the rows that wait, and TensorBoard's: what comes before a checkpoint is not made again."""
        self.flush()
        if self._log:
            self._log.flush()

    def close(self) -> None:
        """Close the TensorBoard file."""
        if self._log:
            self._log.close()
