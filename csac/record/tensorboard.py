"""Write TensorBoard files from rows of a run's tables, with Stable-Baselines3's tags."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]

from csac.record.statistics import is_case, mean_over_episodes
from csac.record.tables import COLUMNS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from csac.record.run import Table

    Row = Mapping[str, Any]

EPISODES_AVERAGED = 100  # as in Stable-Baselines3's rollout/ep_rew_mean
FLUSH_SECONDS = 30


class TensorBoardLog:
    """Write the curves of a run that continues from step `begin`, after the training episodes `before`.

    `cases` are the events that were cases in earlier evaluations: an episode that does not report one counts as 0.

    `rollout/*` are means over the last 100 training episodes, `eval/*` over the episodes of one evaluation, `train/*`
    the metrics, `time/fps` environment steps per second since the log was opened. tensorboardX's own writer is not
    used: on a full disk its thread dies, and adding to its queue then blocks forever.
    """

    def __init__(self, folder: Path, begin: int = 0, before: Sequence[Row] = (), cases: Iterable[str] = ()) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        earlier = len([*folder.glob("events.*")])  # a file of the same second would overwrite one
        self._writer = EventsWriter(str(folder / "events"), f".{earlier}")
        self._begin, self._began = begin, time.monotonic()
        self._flushed = self._began
        self._recent: deque[Row] = deque(before, maxlen=EPISODES_AVERAGED)
        self._cases = set(cases)
        if begin or earlier:  # TensorBoard drops what was written after the step that the run continues from
            self._add(Event(step=begin + 1, session_log=SessionLog(status=SessionLog.START)))

    def write(self, table: Table, rows: Sequence[Row]) -> dict[int, dict[str, float]]:
        """Write the values of these rows, and return them by step and tag. Raises OSError."""
        steps: dict[int, list[Row]] = defaultdict(list)
        for row in rows:
            steps[row["step"]].append(row)
        scalars = {"episodes": self._episodes, "metrics": self._metrics, "evaluations": self._evaluations}[table]
        points = {step: scalars(rows_of_step) for step, rows_of_step in steps.items()}
        for step, values in points.items():
            summary = Summary(value=[Summary.Value(tag=tag, simple_value=value) for tag, value in values.items()])
            self._add(Event(step=step, summary=summary))
        return points

    def flush(self) -> None:
        """Write everything buffered to the file. Raises OSError."""
        self._writer.flush()
        self._flushed = time.monotonic()

    def close(self) -> None:
        """Close the file; a write error is ignored, since nothing depends on this file."""
        with suppress(OSError, ValueError):  # ValueError: it is closed already
            self._writer.close()

    def _add(self, event: Event) -> None:
        event.wall_time = time.time()
        self._writer.write_event(event)
        if time.monotonic() - self._flushed >= FLUSH_SECONDS:
            self.flush()

    def _episodes(self, rows: Sequence[Row]) -> dict[str, float]:
        self._recent.extend(rows)
        tags = {"rollout/ep_rew_mean": "return", "rollout/ep_len_mean": "length"}
        tags |= {f"rollout/{name}": name for name in rows[-1] if name not in COLUMNS["episodes"]}
        columns = {tag: np.array([row.get(name) for row in self._recent], float) for tag, name in tags.items()}
        return {tag: float(np.nanmean(values)) for tag, values in columns.items() if not np.isnan(values).all()}

    def _metrics(self, rows: Sequence[Row]) -> dict[str, float]:
        row, elapsed = rows[-1], time.monotonic() - self._began
        metrics = {name: value for name, value in row.items() if name not in COLUMNS["metrics"]}
        values = {name if "/" in name else f"train/{name}": float(value) for name, value in metrics.items()}
        return {**values, "time/fps": (row["step"] - self._begin) / max(elapsed, 1e-9)}

    def _evaluations(self, rows: Sequence[Row]) -> dict[str, float]:
        values = {
            "eval/mean_reward": float(np.mean([row["return"] for row in rows])),
            "eval/mean_ep_length": float(np.mean([row["length"] for row in rows])),
        }
        for name in ("success", *(name for name in rows[0] if name not in COLUMNS["evaluations"])):
            column = np.array([row.get(name) for row in rows], float)
            if is_case(column):
                self._cases.add(name)
            elif not np.isnan(column).all():
                self._cases.discard(name)
            mean = mean_over_episodes(column, name in self._cases)
            if not np.isnan(mean):
                values["eval/success_rate" if name == "success" else f"eval/{name}"] = mean
        return values
