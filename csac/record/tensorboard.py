"""TensorBoard files of a run: one sub-directory per seed, with Stable-Baselines3's tag names."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event as TensorBoardEvent  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.proto.event_pb2 import SessionLog  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]

from csac.record.csv_tables import COLUMNS
from csac.record.statistics import is_case, mean_over_episodes

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    Row = Mapping[str, Any]

FLUSH_SECONDS = 30
EPISODES_AVERAGED = 100  # as Stable-Baselines3's rollout/ep_rew_mean


class TensorBoardLog:
    """Writes the rows of a run's tables to `path/seed_<k>` as well, each group of rows at its own steps.

    `rollout/ep_rew_mean` and `rollout/ep_len_mean` are means over the last 100 training episodes, `eval/mean_reward`,
    `eval/mean_ep_length`, `eval/success_rate` and `eval/<event>` over one evaluation's episodes; `time/fps` is
    environment steps per second of this seed since the log was made, for a run that goes on from step `begin` since
    then.

    Whatever writes raises OSError where the disk is full.
    """

    def __init__(
        self, path: Path, seeds: Sequence[int], begin: int = 0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        purge = begin + 1 if begin else None  # what a run wrote after the step that it goes on from
        self._files = {seed: _SeedFile(path / f"seed_{seed}", purge) for seed in seeds}
        self._begin = begin
        self._recent: dict[int, deque[tuple[float, int]]] = {seed: deque(maxlen=EPISODES_AVERAGED) for seed in seeds}
        self._cases: set[str] = set()  # events that happen or do not: where nobody speaks of one, it did not
        self._clock, self._began = clock, clock()

    def episodes(self, rows: Sequence[Row]) -> None:
        """Write one point per seed for the training episodes that ended, rows of episodes.csv."""
        for (seed, _), ended in _grouped(rows).items():
            self._recent[seed].extend((row["return"], row["length"]) for row in ended)
        for seed, step in {row["seed"]: row["step"] for row in rows}.items():
            returns, lengths = np.array(self._recent[seed]).T
            self._write(seed, step, {"rollout/ep_rew_mean": returns.mean(), "rollout/ep_len_mean": lengths.mean()})

    def metrics(self, rows: Sequence[Row]) -> None:
        """Write each metric of rows of metrics.csv, and the speed."""
        elapsed = self._clock() - self._began
        for row in rows:
            values = {f"train/{name}": value for name, value in row.items() if name not in ("seed", "step")}
            if elapsed > 0:
                values["time/fps"] = (row["step"] - self._begin) / elapsed
            self._write(row["seed"], row["step"], values)

    def evaluations(self, rows: Sequence[Row]) -> None:
        """Write the means over each evaluation's episodes, rows of evaluations.csv."""
        for (seed, step), episodes in _grouped(rows).items():
            values: dict[str, Any] = {
                "eval/mean_reward": np.mean([row["return"] for row in episodes]),
                "eval/mean_ep_length": np.mean([row["length"] for row in episodes]),
            }
            for name in ("success", *(name for name in episodes[0] if name not in COLUMNS["evaluations"])):
                told = np.array([row.get(name) for row in episodes], float)
                if is_case(told):
                    self._cases.add(name)
                elif not np.isnan(told).all():
                    self._cases.discard(name)
                mean = mean_over_episodes(told, name in self._cases)
                if not np.isnan(mean):
                    values["eval/success_rate" if name == "success" else f"eval/{name}"] = mean
            self._write(seed, step, values)

    def close(self) -> None:
        """Write what still waits and close the files. May be called again."""
        for file in self._files.values():
            file.close()

    def _write(self, seed: int, step: int, values: Mapping[str, Any]) -> None:
        for tag, value in values.items():
            self._files[seed].add(TensorBoardEvent(step=step, summary=Summary(value=[_value(tag, value)])))


class _SeedFile:
    """One seed's file.

    Not tensorboardX's own writer: its thread dies of a full disk, and whoever adds to its queue then waits for ever.
    """

    def __init__(self, folder: Path, purge_step: int | None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._writer: EventsWriter | None = EventsWriter(str(folder / "events"))
        self._flushed = time.monotonic()
        if purge_step is not None:
            self.add(TensorBoardEvent(step=purge_step, session_log=SessionLog(status=SessionLog.START)))

    def add(self, record: TensorBoardEvent) -> None:
        assert self._writer
        record.wall_time = time.time()
        self._writer.write_event(record)
        if time.monotonic() - self._flushed >= FLUSH_SECONDS:
            self._writer.flush()
            self._flushed = time.monotonic()

    def close(self) -> None:
        """Close the file; what cannot be written is left out, since nothing depends on it."""
        writer, self._writer = self._writer, None
        if writer:
            with suppress(OSError):
                writer.close()


def _value(tag: str, value: float) -> Summary.Value:
    return Summary.Value(tag=tag, simple_value=float(value))


def _grouped(rows: Sequence[Row]) -> dict[tuple[int, int], list[Row]]:
    """Return the rows of each (seed, step)."""
    groups: dict[tuple[int, int], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row["seed"], row["step"]].append(row)
    return groups
