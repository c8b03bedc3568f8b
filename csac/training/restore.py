"""Copies a run's tables and best policies into a checkpoint, and puts them and the length of its log back."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from typing import TYPE_CHECKING, get_args

from csac.deploy.contract import write_with_checksum
from csac.record.atomic import write_atomically
from csac.record.run import Table
from csac.training.checkpoint import BEST, FOLDER, Damaged, original_of
from csac.training.seed_files import write_file

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from csac.training.checkpoint import Checkpoint
    from csac.training.seed_files import Files

LOG = "log.txt"


def keep_tables(run: Path, step: int) -> Files:
    """Copy the tables of a run into its checkpoint of this step. Raises OSError."""
    tables = {table: run / f"{table}.csv" for table in get_args(Table)}
    names = {f"step_{step}.{table}.csv": path for table, path in tables.items() if path.exists()}
    return {name: write_file(run / FOLDER, name, path.read_bytes()) for name, path in names.items()}


def keep_best_policies(run: Path, seeds: Sequence[int], step: int) -> Files:
    """Copy the best policies that these seeds have into a run's checkpoint of this step. Raises OSError."""
    paths = {f"step_{step}.seed_{seed}{BEST}": run / "policy" / f"seed_{seed}{BEST}" for seed in seeds}
    return {name: write_file(run / FOLDER, name, path.read_bytes()) for name, path in paths.items() if path.exists()}


def restore(run: Path, checkpoint: Checkpoint | None) -> list[str]:
    """Bring a run's files back to a checkpoint, or to its beginning; return a line for each that was damaged.

    Raises:
        Damaged: a table is lost.
    """
    told, kept = [], set()
    for name in checkpoint.files if checkpoint else ():
        if checkpoint and (path := original_of(run, name)):
            try:
                content = checkpoint.read(name)
            except Damaged as error:
                if not name.endswith(BEST):
                    raise
                told.append(f"{error}; the best policy is one of later evaluations")
                continue
            kept.add(path)
            if name.endswith(BEST):
                path.parent.mkdir(exist_ok=True)
                write_with_checksum(path, content)
            elif not _cut_back(path, content):
                told.append(f"{path} had changed since the checkpoint; it is restored")
    for path in {*(run / f"{table}.csv" for table in get_args(Table)), *run.glob(f"policy/seed_*{BEST}")} - kept:
        path.unlink(missing_ok=True)
    _cut_log(run / LOG, checkpoint)
    return told + (_mend(checkpoint) if checkpoint else [])


def copy(checkpoint: Checkpoint, run: Path, seeds: Sequence[int]) -> Files:
    """Give a new run the tables, the log and the files of another's checkpoint, of these seeds; return the files.

    Transitions, which are never written again, get a second name where the file system has such a thing.

    Raises:
        Damaged: a file is damaged that it cannot go on without.
    """
    (run / FOLDER / "replay").mkdir(parents=True, exist_ok=True)
    files = dict(checkpoint.files)
    for name in checkpoint.files:
        if (of := re.search(r"seed_(\d+)\.", name)) and int(of[1]) not in seeds:
            del files[name]
            continue
        try:
            content = checkpoint.read(name)
        except Damaged:
            if not name.endswith((BEST, ".parity")):
                raise
            del files[name]
            continue
        if name.endswith(".csv"):
            content = _rows_of(content, seeds)
            files[name] = write_file(run / FOLDER, name, content)
            write_atomically(run / name.partition(".")[2], content)
            continue
        is_shared = name.startswith("replay/") and name not in checkpoint.mended
        if not (is_shared and _link(checkpoint.folder / name, run / FOLDER / name)):
            write_atomically(run / FOLDER / name, content)
    with suppress(FileNotFoundError), open(checkpoint.folder.parent / LOG, "rb") as log:
        write_atomically(run / LOG, log.read(checkpoint.values["log_bytes"]))
    return files


def _rows_of(content: bytes, seeds: Sequence[int]) -> bytes:
    """Return the header of a table and the rows of these seeds, whose labels are its first column."""
    header, *rows = content.splitlines(keepends=True)
    return b"".join([header, *(row for row in rows if int(row.partition(b",")[0]) in seeds)])


def _cut_back(path: Path, content: bytes) -> bool:
    """Let a file be what a checkpoint has of it, by cutting off what came after; false where it began otherwise."""
    with suppress(OSError):
        with open(path, "rb") as file:
            is_sound = file.read(len(content)) == content
        if is_sound:
            os.truncate(path, len(content))
            return True
    write_atomically(path, content)
    return False


def _cut_log(path: Path, checkpoint: Checkpoint | None) -> None:
    if not checkpoint:
        path.unlink(missing_ok=True)
    elif path.exists() and path.stat().st_size > checkpoint.values["log_bytes"]:
        os.truncate(path, checkpoint.values["log_bytes"])


def _mend(checkpoint: Checkpoint) -> list[str]:
    """Write the transitions that were damaged as they were."""
    told = []
    for name in sorted(checkpoint.mended):
        write_atomically(checkpoint.folder / name, checkpoint.read(name))
        told.append(f"{checkpoint.folder / name} was damaged in one place; it is mended from its parity")
    return told


def _link(source: Path, target: Path) -> bool:
    """Give a file that is only ever replaced whole a second name; false where the file system has no links."""
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        return False
    return True
