"""Checkpoints of one run: all that it needs to resume exactly, in safetensors and JSON, complete or absent.

    checkpoint/step_<n>/checkpoint.json     the list of its files, with their checksums, and a few values
    checkpoint/step_<n>/state.safetensors   the learner's state, the environment's state and the run's counters
    checkpoint/step_<n>/<table>.csv         the tables so far; best.safetensors, the best policy; manifest.json
    checkpoint/replay/<a>-<b>.safetensors   the transitions a to b - 1

Transitions never change, so each checkpoint only adds the new ones: its cost does not grow with the replay buffer. The
folder gets its name once it is complete, so an interrupted write leaves no checkpoint.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import safetensors.numpy

from csac.record.files import TEMPORARY, temporary_path, write_atomically
from csac.types import InputError, Snapshot

if TYPE_CHECKING:
    from collections.abc import Mapping

    from csac.types import Ring

SCHEMA_VERSION = 4
LIST, STATE, REPLAY = "checkpoint.json", "state.safetensors", "replay"

Facts = dict[str, Any]  # of a file: {"bytes": size, "sha256": checksum}

_LOST_FILE_ERRORS = (errno.ENOENT, errno.EIO, errno.ENOTDIR, errno.EISDIR)


class Damaged(InputError):
    """A file of a checkpoint is missing, truncated or changed. The message names it."""


class Checkpoint(NamedTuple):
    """One checkpoint on disk."""

    folder: Path
    """The run's `checkpoint/`."""
    step: int
    files: dict[str, Facts]
    """The checkpoint's own files, by name, and its replay files, as `replay/<a>-<b>.safetensors`."""
    transitions: tuple[int, int]
    """The first transition in the replay buffer, and one past the last."""
    values: dict[str, Any]

    @classmethod
    def open(cls, folder: Path, step: int) -> Checkpoint:
        """Read the list of a checkpoint's files. Raises Damaged."""
        path = folder / f"step_{step}" / LIST
        try:
            fields = json.loads(_read(path))
            if fields.pop("sha256") != _checksum(fields) or fields["step"] != step:
                raise Damaged(f"{path} has changed since it was written")
            if fields["schema_version"] != SCHEMA_VERSION:
                raise Damaged(f"{path} has schema {fields['schema_version']!r} and this csac reads {SCHEMA_VERSION}")
            if any(not re.fullmatch(r"(replay/)?[a-z0-9-]+\.[a-z]+", name) for name in fields["files"]):
                raise Damaged(f"{path} names a file that is none of a checkpoint")
            first, last = fields["transitions"]
            return cls(folder, step, fields["files"], (first, last), fields["values"])
        except Damaged:
            raise
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise Damaged(f"{path} is not a checkpoint ({type(error).__name__}: {error})") from error

    def read(self, name: str) -> bytes:
        """Return a file's content. Raises Damaged."""
        content = _read(path := self._path(name))
        if facts_of(content) != self.files[name]:
            raise Damaged(f"{path} has changed since it was written")
        return content

    def state(self) -> Snapshot:
        """Return everything that was saved except the transitions. Raises Damaged."""
        try:
            return Snapshot(safetensors.numpy.load(self.read(STATE)), self.values)
        except (safetensors.SafetensorError, ValueError) as error:
            raise Damaged(f"{self._path(STATE)} is not what csac writes ({error})") from error

    def fill(self, rows: np.ndarray) -> list[str]:
        """Put the transitions into a ring [capacity, width]; return a message for each replay file that is lost.

        Copies of other transitions replace lost ones, so that only real transitions are sampled. Raises Damaged if none
        is left.
        """
        first, last = self.transitions
        first = max(first, last - len(rows))  # a fork's memory may be smaller
        known, lost = np.zeros(last - first, bool), []
        for begin, end, name in shards(self.files):
            if end <= first:
                continue
            try:
                shard = safetensors.numpy.load(self.read(name))["rows"]
                if shard.shape != (end - begin, rows.shape[1]) or shard.dtype != rows.dtype:
                    raise ValueError(f"{shard.dtype} {shard.shape} where the memory has {rows.dtype} {rows.shape}")
            except (Damaged, safetensors.SafetensorError, ValueError, KeyError) as error:
                lost.append(f"{error}: its transitions are lost, and others stand in for them")
                continue
            numbers = np.arange(max(begin, first), min(end, last))
            rows[numbers % len(rows)] = shard[numbers - begin]
            known[numbers - first] = True
        missing, present = first + np.flatnonzero(~known), first + np.flatnonzero(known)
        if len(missing) and not len(present):
            raise Damaged(f"{self.folder / REPLAY} has none of the transitions of step {self.step}")
        rows[missing % len(rows)] = rows[np.resize(present, len(missing)) % len(rows)]
        return lost

    def _path(self, name: str) -> Path:
        return self.folder / name if name.startswith(f"{REPLAY}/") else self.folder / f"step_{self.step}" / name


class Writer:
    """Writes the checkpoints of one run, and remembers which transitions are on disk.

    `known` are the files of the checkpoint that the run resumes from, if its transitions are complete.
    """

    def __init__(self, folder: Path, known: Mapping[str, Facts]) -> None:
        self.folder = folder
        self._shards = {name: facts for name, facts in known.items() if name.startswith(f"{REPLAY}/")}

    def write(self, step: int, saved: Snapshot, memory: Ring, others: Mapping[str, bytes]) -> None:
        """Write a checkpoint. Raises OSError."""
        (self.folder / REPLAY).mkdir(parents=True, exist_ok=True)
        oldest = max(memory.added - len(memory.rows), 0)
        self._write_new_rows(memory, oldest)
        arrays = {name: np.asarray(array, order="C") for name, array in saved.arrays.items()}
        contents = {STATE: safetensors.numpy.save(arrays), **others}
        files = {name: facts_of(content) for name, content in contents.items()} | self._shards
        fields = {
            "schema_version": SCHEMA_VERSION,
            "step": step,
            "files": files,
            "transitions": [oldest, memory.added],
            "values": saved.values,
        }
        fields = json.loads(json.dumps(fields))  # the checksum covers the fields as they will be read
        contents[LIST] = json.dumps({**fields, "sha256": _checksum(fields)}, indent=1).encode()
        write_folder(self.folder / f"step_{step}", contents)

    def _write_new_rows(self, memory: Ring, oldest: int) -> None:
        first = max([end for _, end, _ in shards(self._shards)] + [oldest])
        if first < memory.added:
            rows = memory.rows[np.arange(first, memory.added) % len(memory.rows)]
            content, name = safetensors.numpy.save({"rows": rows}), f"{REPLAY}/{first}-{memory.added}.safetensors"
            write_atomically(self.folder / name, content)
            self._shards[name] = facts_of(content)
        self._shards = {name: self._shards[name] for _, end, name in shards(self._shards) if end > oldest}


def write_folder(path: Path, contents: Mapping[str, bytes]) -> None:
    """Write a folder next to `path`, sync and rename it, so that it is complete or absent. Raises OSError."""
    aside = temporary_path(path)
    aside.mkdir()
    for name, content in contents.items():
        write_atomically(aside / name, content)
    shutil.rmtree(path, ignore_errors=True)  # only now: the disk may have been full
    aside.rename(path)
    for folder in (path, path.parent, path.parent / REPLAY):
        descriptor = os.open(folder, os.O_DIRECTORY)
        os.fsync(descriptor)
        os.close(descriptor)


def prune(folder: Path, keep: int, newest: int | None = None) -> None:
    """Keep the last `keep` checkpoints (0: all) up to step `newest`, with their transitions, and remove the others."""
    steps = [step for step in steps_in(folder) if newest is None or step <= newest]
    kept = steps[-keep:] if keep else steps
    needed: set[str] = set()
    for step in kept:
        try:
            needed.update(Checkpoint.open(folder, step).files)
        except InputError:  # damaged, or a temporary disk failure: keep whatever it may need
            return
    others = [folder / f"step_{step}" for step in steps_in(folder) if step not in kept]
    for path in [*others, *folder.glob(TEMPORARY)]:
        shutil.rmtree(path, ignore_errors=True)
    for path in (folder / REPLAY).glob("*"):
        if f"{REPLAY}/{path.name}" not in needed:
            path.unlink(missing_ok=True)


def steps_in(folder: Path) -> list[int]:
    """Return the steps of a folder's checkpoints in order, including damaged ones."""
    names = (re.fullmatch(r"step_(\d{1,15})", path.name) for path in folder.glob("step_*"))
    return sorted(int(match[1]) for match in names if match)


def newest_sound(folder: Path, until: int | None = None) -> tuple[Checkpoint | None, list[str]]:
    """Return the newest checkpoint (of step `until` at most) that can be read, and what is wrong with newer ones.

    Raises InputError if a newer one cannot be read now but may be sound.
    """
    complaints = []
    for step in reversed(steps_in(folder)):
        if until is not None and step > until:
            continue
        try:
            checkpoint = Checkpoint.open(folder, step)
            for name in checkpoint.files:
                if not name.startswith(f"{REPLAY}/") and name != "best.safetensors":
                    checkpoint.read(name)
            return checkpoint, complaints
        except Damaged as error:
            complaints.append(str(error))
    return None, complaints


def checkpoint_of(folder: Path, step: int | None) -> Checkpoint:
    """Return the checkpoint of a step, by default the newest sound one. Raises InputError if there is none."""
    checkpoint, complaints = newest_sound(folder, step)
    if checkpoint is None or step not in (None, checkpoint.step):
        known = ", ".join(map(str, steps_in(folder))) or "none"
        wanted = "" if step is None else f" of step {step}"
        raise InputError("; ".join(complaints) or f"{folder.parent} has no checkpoint{wanted}; it has {known}")
    return checkpoint


def shards(files: Mapping[str, Any]) -> list[tuple[int, int, str]]:
    """Return (first, last + 1, name) of each replay file, in order of transitions."""
    names = (re.fullmatch(rf"{REPLAY}/(\d+)-(\d+)\.safetensors", name) for name in files)
    return sorted((int(match[1]), int(match[2]), match[0]) for match in names if match)


def facts_of(content: bytes) -> Facts:
    """Return the size and the checksum of a file's content."""
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _read(path: Path) -> bytes:
    """Return a file's bytes. Raises Damaged if it is lost, InputError if it may be sound but cannot be read now."""
    try:
        return path.read_bytes()
    except OSError as error:
        kind = Damaged if error.errno in _LOST_FILE_ERRORS else InputError
        raise kind(f"{path} cannot be read: {error.strerror}") from error


def _checksum(fields: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()
