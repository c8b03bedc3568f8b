"""What W&B would send of its offline files: LevelDB's log format, with a protobuf message in each record."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any, NamedTuple

import wandb
from wandb.proto.wandb_internal_pb2 import Record  # pyright: ignore[reportAttributeAccessIssue]

BLOCK, FILE_HEADER, HEADER = 32768, 7, 7
FULL, FIRST, MIDDLE, LAST = 1, 2, 3, 4


class OfflineRun(NamedTuple):
    """One W&B run, or one part of it."""

    id: str
    group: str
    project: str
    config: dict[str, Any]
    history: list[dict[str, Any]]
    """Each row with W&B's own `_step`."""

    def curve(self, tag: str) -> list[tuple[int, float]]:
        return [(row["_step"], row[tag]) for row in self.history if tag in row]


def offline_runs(folder: Path) -> list[OfflineRun]:
    """Return the runs in a folder `wandb`, in the order in which they were begun.

    Ends W&B's own process first: a run's `finish` comes back before that process has written the end of its file.
    """
    wandb.teardown()
    return [
        _read(path) for path in sorted(folder.glob("offline-run-*/*.wandb"), key=lambda path: path.stat().st_ctime_ns)
    ]


def _read(path: Path) -> OfflineRun:
    run, history = None, []
    for data in _records(path.read_bytes()):
        record = Record.FromString(data)
        kind = record.WhichOneof("record_type")
        if kind == "run":
            run = record.run
        elif kind == "history":
            history.append(
                {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in record.history.item}
            )
    assert run
    config = {item.key: json.loads(item.value_json) for item in run.config.update}
    return OfflineRun(run.run_id, run.run_group, run.project, config, history)


def _records(data: bytes) -> list[bytes]:
    records, part, position = [], b"", FILE_HEADER
    while position + HEADER <= len(data):
        if BLOCK - position % BLOCK < HEADER:
            position += BLOCK - position % BLOCK
            continue
        _, length, kind = struct.unpack_from("<IHB", data, position)
        part += data[position + HEADER : position + HEADER + length]
        position += HEADER + length
        if kind in (FULL, LAST):
            records.append(part)
            part = b""
    return records
