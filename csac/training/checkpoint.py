"""Checkpoints: all that a run needs to go on exactly, in safetensors and JSON, whole or not there.

    checkpoint/step_<n>.json                      the checkpoint itself: which files it is made of, with their checksums
    checkpoint/step_<n>.seed_<k>.safetensors      what seed k has learnt, its environment and its counters
    checkpoint/step_<n>.seed_<k>.best.safetensors its best policy so far
    checkpoint/replay/seed_<k>.<a>-<b>.safetensors  the transitions a to b - 1 of seed k

Transitions never change once they are made, so each checkpoint only adds those that are new: its cost does not grow
with the replay. The JSON file is written last, so a checkpoint that was cut off does not exist.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import safetensors.numpy

from csac.record.files import write_atomically
from csac.types import InputError, Ring, Snapshot

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

SCHEMA_VERSION = 2
FOLDER = "checkpoint"

_NUMBER = r"[0-9]{1,15}"
_FILE_NAME = re.compile(
    rf"(step_{_NUMBER}\.seed_{_NUMBER}(\.best)?|replay/seed_{_NUMBER}\.{_NUMBER}-{_NUMBER})\.safetensors"
)

Files = dict[str, dict[str, Any]]  # name below the folder -> {"bytes": size, "sha256": checksum}


class Damaged(InputError):
    """A checkpoint's file is missing, cut off or changed. The message names it."""


class SeedFiles:
    """Writes the files of one seed, and remembers which transitions are on disk already.

    Args:
        folder: the run's checkpoint folder.
        seed: the seed's label.
        known: the files of the checkpoint that the run goes on from.
    """

    def __init__(self, folder: Path, seed: int, known: Mapping[str, dict[str, Any]]) -> None:
        self.folder, self.seed = folder, seed
        self._shards = {name: known[name] for _, _, name in _shards(known, seed)}

    def write(self, step: int, saved: Snapshot, memory: Ring) -> Files:
        """Write what is new at this step; return every file that the seed needs now.

        Raises:
            OSError: the disk is full, or the folder is gone.
        """
        for folder in (self.folder, self.folder / "replay"):  # not their parents: a run that was deleted stays so
            folder.mkdir(exist_ok=True)
        self._write_new_rows(memory)
        name = f"step_{step}.seed_{self.seed}.safetensors"
        content = safetensors.numpy.save(
            {key: np.asarray(array, order="C") for key, array in saved.arrays.items()},
            metadata={"values": json.dumps(saved.values)},
        )
        return {name: _write(self.folder, name, content), **self._shards}

    def _write_new_rows(self, memory: Ring) -> None:
        capacity, oldest = len(memory.rows), memory.count - len(memory.rows)
        last = max((last for _, last, _ in _shards(self._shards, self.seed)), default=0)
        first = max(last, oldest)
        if first < memory.count:
            rows = memory.rows[np.arange(first, memory.count) % capacity]
            name = f"replay/seed_{self.seed}.{first}-{memory.count}.safetensors"
            self._shards[name] = _write(self.folder, name, safetensors.numpy.save({"rows": rows}))
        for _, last, name in _shards(self._shards, self.seed):
            if last <= oldest:
                del self._shards[name]


class Checkpoint:
    """One checkpoint on disk. `values` is what the run as a whole noted down with it."""

    def __init__(self, folder: Path, step: int, files: Files, values: dict[str, Any]) -> None:
        self.folder, self.step, self.files, self.values = folder, step, files, values

    @classmethod
    def open(cls, folder: Path, step: int) -> Checkpoint:
        """Read the list of a checkpoint's files.

        Raises:
            Damaged: it is not what was written.
        """
        path = folder / f"step_{step}.json"
        try:
            fields = json.loads(path.read_bytes())
            checksum = fields.pop("sha256")
            if fields["schema_version"] != SCHEMA_VERSION:
                raise Damaged(f"{path} is of schema {fields['schema_version']!r}, and this csac reads {SCHEMA_VERSION}")
            if checksum != _sha256(_encoded(fields)) or fields["step"] != step:
                raise Damaged(f"{path} has changed since it was written")
            return cls(folder, step, _checked_files(fields["files"]), _checked_values(fields["values"]))
        except OSError as error:
            raise Damaged(f"{path} cannot be read: {error.strerror}") from error
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise Damaged(f"{path} is not a checkpoint ({type(error).__name__}: {error})") from error

    def verify(self) -> None:
        """Read every file once.

        Raises:
            Damaged: one is missing, cut off or changed.
        """
        for name, facts in self.files.items():
            _read(self.folder, name, facts)

    def seed(self, seed: int) -> Snapshot:
        """Return what was saved of a seed. Raises Damaged."""
        name = f"step_{self.step}.seed_{seed}.safetensors"
        if name not in self.files:
            raise Damaged(f"{self.folder} has nothing of seed {seed} at step {self.step}")
        content = _read(self.folder, name, self.files[name])
        try:
            # The header: eight bytes of length, then JSON. The library gives the metadata of files alone.
            header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
            return Snapshot(safetensors.numpy.load(content), json.loads(header["__metadata__"]["values"]))
        except (safetensors.SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise Damaged(f"{self.folder / name} is not what csac writes ({error})") from error

    def memory(self, seed: int, rows: np.ndarray) -> None:
        """Put a seed's transitions into a ring [capacity, width]. Raises Damaged."""
        for first, last, name in sorted(_shards(self.files, seed)):
            try:
                shard = safetensors.numpy.load(_read(self.folder, name, self.files[name]))["rows"]
                if shard.shape != (last - first, rows.shape[1]) or shard.dtype != rows.dtype:
                    raise ValueError(f"{shard.dtype} {shard.shape} where the memory has {rows.dtype} {rows.shape}")
                rows[np.arange(first, last) % len(rows)] = shard
            except (safetensors.SafetensorError, ValueError, KeyError) as error:
                raise Damaged(f"{self.folder / name} does not fit: {error}") from error


class Checkpoints:
    """The checkpoints of one run. `newest` is the step of the last one that is complete, or None.

    Args:
        folder: where they are.
        keep: how many to keep; 0 keeps all.
        pinned: the steps of others to keep.
    """

    def __init__(self, folder: Path, keep: int, pinned: Iterable[int] = ()) -> None:
        self.folder, self.keep, self.pinned = folder, keep, set(pinned)
        self.newest: int | None = max(steps_in(folder), default=None)

    def pin_newest(self) -> None:
        """Keep the newest checkpoint for good: a seed failed after it, and its last sound state is there."""
        if self.newest is not None:
            self.pinned.add(self.newest)

    def commit(self, step: int, files: Files, values: dict[str, Any]) -> None:
        """Make a checkpoint of files that are written already, then remove what no checkpoint needs any more."""
        values = {**values, "pinned": sorted(self.pinned)}
        fields = {"schema_version": SCHEMA_VERSION, "step": step, "files": files, "values": values}
        content = json.dumps({**fields, "sha256": _sha256(_encoded(fields))}, indent=1).encode()
        write_atomically(self.folder / f"step_{step}.json", content)
        _sync_folder(self.folder)
        self.newest = step
        self._prune(step)

    def discard_after(self, step: int) -> None:
        """Remove what was written after a step, cut off or not. Nobody else may be writing."""
        for path in [*self.folder.glob("**/.*"), *(self.folder / f"step_{n}.json" for n in steps_in(self.folder))]:
            if path.name.startswith(".") or _step_of(path.name) > step:
                path.unlink()
        self.newest = max(steps_in(self.folder), default=None)
        self._prune(None)

    def _prune(self, newest: int | None) -> None:
        """Remove what no kept checkpoint needs; of later steps than `newest` other groups may have written already."""
        steps = steps_in(self.folder)
        needed: set[str] = set()
        for step in {*steps[-self.keep :], *self.pinned.intersection(steps)}:
            try:
                needed |= {f"step_{step}.json", *Checkpoint.open(self.folder, step).files}
            except Damaged:
                needed.add(f"step_{step}.json")  # for a person to look at
        for path in [*self.folder.glob("step_*"), *self.folder.glob("replay/seed_*")]:
            is_later = newest is not None and _step_of(path.name) > newest
            if not is_later and path.relative_to(self.folder).as_posix() not in needed:
                path.unlink(missing_ok=True)


@contextmanager
def taken_back(checkpoint: Checkpoint) -> Iterator[None]:
    """Raise Damaged where a checkpoint whose checksums are right does not hold what csac saves."""
    try:
        yield
    except InputError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        where = checkpoint.folder / f"step_{checkpoint.step}.json"
        raise Damaged(f"{where} is not what csac writes ({type(error).__name__}: {error})") from error


def steps_in(folder: Path) -> list[int]:
    """Return the steps that a folder has checkpoints of, in order, sound or not."""
    names = (re.fullmatch(r"step_(\d+)\.json", path.name) for path in folder.glob("step_*.json"))
    return sorted(int(match[1]) for match in names if match)


def remove_unfinished(folder: Path, process: int | None) -> None:
    """Remove what a process that is no more was writing when it died."""
    for path in folder.glob(f"**/.*.{process}"):
        path.unlink(missing_ok=True)


def _step_of(name: str) -> int:
    """Return the step that a file of a checkpoint, or of transitions, was written at."""
    match = re.match(r"step_(\d+)\.|seed_\d+\.\d+-(\d+)\.", name)
    return int(match[1] or match[2]) if match else -1


def newest_sound(folder: Path) -> tuple[Checkpoint | None, list[str]]:
    """Return the newest checkpoint whose every file is as it was written, and what is wrong with those after it."""
    complaints = []
    for step in reversed(steps_in(folder)):
        try:
            checkpoint = Checkpoint.open(folder, step)
            checkpoint.verify()
            return checkpoint, complaints
        except Damaged as error:
            complaints.append(str(error))
    return None, complaints


def sound_at(folder: Path, step: int) -> Checkpoint:
    """Return the checkpoint of one step. Raises InputError where there is none or it is damaged."""
    if step not in steps_in(folder):
        known = ", ".join(map(str, steps_in(folder))) or "none"
        raise InputError(f"{folder} has no checkpoint of step {step}; it has {known}")
    try:
        checkpoint = Checkpoint.open(folder, step)
        checkpoint.verify()
        return checkpoint
    except Damaged as error:
        raise InputError(f"{error}: choose another of the steps {', '.join(map(str, steps_in(folder)))}") from None


def link(source: Path, target: Path) -> None:
    """Give a file that is only ever replaced whole a second name; a copy where the file system has no links."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        write_atomically(target, source.read_bytes())


def facts_of(path: Path) -> dict[str, Any]:
    """Return the size and checksum of a file."""
    content = path.read_bytes()
    return {"bytes": len(content), "sha256": _sha256(content)}


def _write(folder: Path, name: str, content: bytes) -> dict[str, Any]:
    write_atomically(folder / name, content)
    return {"bytes": len(content), "sha256": _sha256(content)}


def _read(folder: Path, name: str, facts: dict[str, Any]) -> bytes:
    path = folder / name
    try:
        content = path.read_bytes()
    except OSError as error:
        raise Damaged(f"{path} cannot be read: {error.strerror}") from error
    if len(content) != facts["bytes"]:
        raise Damaged(f"{path} has {len(content)} bytes instead of {facts['bytes']}")
    if _sha256(content) != facts["sha256"]:
        raise Damaged(f"{path} has changed since it was written: its checksum is another")
    return content


def _shards(files: Mapping[str, Any], seed: int) -> list[tuple[int, int, str]]:
    """Return (first, last + 1, name) of each file of a seed's transitions."""
    names = (re.fullmatch(rf"replay/seed_{seed}\.(\d+)-(\d+)\.safetensors", name) for name in files)
    return [(int(match[1]), int(match[2]), match[0]) for match in names if match]


def _checked_files(files: Any) -> Files:
    for name, facts in files.items():
        if not _FILE_NAME.fullmatch(name):
            raise ValueError(f"{name!r} is no file of a checkpoint")
        if type(facts["bytes"]) is not int or not isinstance(facts["sha256"], str):
            raise TypeError(f"{name!r} has no size and checksum")
    return files


def _checked_values(values: Any) -> dict[str, Any]:
    values = {"sizes": {}, "failures": {}, "pinned": [], **values}
    for name, kind in (("sizes", int), ("failures", str)):
        if not all(type(value) is kind for value in values[name].values()):
            raise TypeError(f"{name} are not of type {kind.__name__}")
    if not all(type(step) is int for step in values["pinned"]) or not all(map(str.isdigit, values["failures"])):
        raise TypeError("pinned steps or failed seeds are not numbers")
    return values


def _encoded(fields: dict[str, Any]) -> bytes:
    return json.dumps(fields, sort_keys=True).encode()


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _sync_folder(folder: Path) -> None:
    """Push the names of the files in a folder to the disk as well."""
    for place in (folder, folder / "replay"):
        if place.is_dir() and hasattr(os, "O_DIRECTORY"):
            descriptor = os.open(place, os.O_DIRECTORY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
