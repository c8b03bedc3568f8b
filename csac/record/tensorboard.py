"""TensorBoard files of a run: one sub-directory per seed, with the tags of `scalars`."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import TYPE_CHECKING

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event as TensorBoardEvent  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.proto.event_pb2 import SessionLog  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]

from csac.record.scalars import Scalars

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from csac.record.scalars import Tables

FLUSH_SECONDS = 30


class TensorBoardLog:
    """Writes the curves of a run that goes on from step `begin`, after the rows `before`, to `path/seed_<k>`.

    Whatever writes raises OSError where the disk is full.
    """

    def __init__(
        self,
        path: Path,
        seeds: Sequence[int],
        begin: int = 0,
        before: Tables | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._files = {seed: _SeedFile(path / f"seed_{seed}", begin) for seed in seeds}
        self._scalars = Scalars(seeds, begin, before, clock)

    def write(self, tables: Tables) -> Sequence[str]:
        """Write the points of these rows, by table."""
        for seed, step, values in self._scalars.points(tables):
            for tag, value in values.items():
                record = TensorBoardEvent(step=step, summary=Summary(value=[_value(tag, value)]))
                self._files[seed].add(record)
        return ()

    def flush(self) -> None:
        """Have everything in the files: what comes before a checkpoint is not made again after a crash."""
        for file in self._files.values():
            file.flush()

    def close(self) -> Sequence[str]:
        """Write what still waits and close the files. May be called again."""
        for file in self._files.values():
            file.close()
        return ()


class _SeedFile:
    """One seed's file.

    Not tensorboardX's own writer: its thread dies of a full disk, and whoever adds to its queue then waits for ever.
    """

    def __init__(self, folder: Path, begin: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        has_earlier = any(folder.glob("events.*"))
        self._writer: EventsWriter | None = EventsWriter(str(folder / "events"))
        self._flushed = time.monotonic()
        if begin or has_earlier:  # TensorBoard drops what was written after the step that the run goes on from
            self.add(TensorBoardEvent(step=begin + 1, session_log=SessionLog(status=SessionLog.START)))

    def add(self, record: TensorBoardEvent) -> None:
        assert self._writer
        record.wall_time = time.time()
        self._writer.write_event(record)
        if time.monotonic() - self._flushed >= FLUSH_SECONDS:
            self.flush()

    def flush(self) -> None:
        assert self._writer
        self._writer.flush()
        self._flushed = time.monotonic()

    def close(self) -> None:
        """Close the file; what cannot be written is left out, since nothing depends on it."""
        writer, self._writer = self._writer, None
        if writer:
            with suppress(OSError):
                writer.close()


def _value(tag: str, value: float) -> Summary.Value:
    return Summary.Value(tag=tag, simple_value=value)
