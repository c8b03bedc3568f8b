"""Checkpoints: all that a run needs to go on exactly, in safetensors and JSON, whole or not there.

    checkpoint/step_<n>.json                      the checkpoint itself: which files it is made of, with their checksums
    checkpoint/step_<n>.seed_<k>.safetensors      what seed k has learnt, its environment and its counters
    checkpoint/step_<n>.seed_<k>.best.safetensors its best policy so far
    checkpoint/step_<n>.<table>.csv               the tables of the run by then
    checkpoint/replay/seed_<k>.<a>-<b>.safetensors  the transitions a to b - 1 of seed k
    checkpoint/replay/seed_<k>.<a>-<b>.parity       what mends that file where it is damaged in one place

Transitions never change once they are made, so each checkpoint only adds those that are new: its cost does not grow
with the replay. All checkpoints share them, which is why they alone have a parity; what each checkpoint has for itself
is there twice, since two are kept. The JSON file is written last, so a checkpoint that was cut off does not exist.
"""

from __future__ import annotations

import errno
import json
import os
import re
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import safetensors.numpy

from csac.record.atomic import write_atomically
from csac.record.redundancy import mended
from csac.training.seed_files import content_of, is_unchanged, parity_name, sha256, shards_of
from csac.types import InputError, Snapshot

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from csac.training.seed_files import Files

SCHEMA_VERSION = 3
FOLDER = "checkpoint"
BEST = ".best.safetensors"

_NUMBER = r"[0-9]{1,15}"
_FILE_NAME = re.compile(
    rf"step_{_NUMBER}\.(seed_{_NUMBER}(\.best)?\.safetensors|(evaluations|episodes|metrics)\.csv)"
    rf"|replay/seed_{_NUMBER}\.{_NUMBER}-{_NUMBER}\.(safetensors|parity)"
)


class Damaged(InputError):
    """A checkpoint's file is missing, cut off or changed. The message names it."""


class Unread(Damaged):
    """A checkpoint's file may be sound and could not be read this time, or by this csac: no other takes its place."""


# What reading a file that is gone, or lies where the disk is broken, is answered with; anything else may pass.
_LOST = (errno.ENOENT, errno.EIO, errno.ENOTDIR, errno.EISDIR)


class Checkpoint:
    """One checkpoint on disk. `values` is what the run as a whole noted down with it.

    `mended` are the files of transitions that were read, found damaged and mended; on disk they still are as they were.
    """

    def __init__(self, folder: Path, step: int, files: Files, values: dict[str, Any]) -> None:
        self.folder, self.step, self.files, self.values = folder, step, files, values
        self.mended: set[str] = set()

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
            is_changed = checksum != sha256(_encoded(fields)) or fields.get("step") != step
            if fields["schema_version"] != SCHEMA_VERSION:
                raise (Damaged if is_changed else Unread)(
                    f"{path} is of schema {fields['schema_version']!r} and this csac reads {SCHEMA_VERSION}: "
                    "go on with the csac that wrote it"
                )
            if is_changed:
                raise Damaged(f"{path} has changed since it was written")
            return cls(folder, step, _checked_files(fields["files"]), _checked_values(fields["values"]))
        except Damaged:
            raise
        except OSError as error:
            raise _unreadable(path, error) from error
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise Damaged(f"{path} is not a checkpoint ({type(error).__name__}: {error})") from error

    def verify(self) -> None:
        """Read every file once that learning goes on from, and the tables.

        Raises:
            Damaged: one is missing, cut off or changed, and cannot be mended. Best policies are not looked at.
        """
        for name in self.files:
            if not name.endswith((BEST, ".parity")):
                self.read(name)

    def read(self, name: str) -> bytes:
        """Return the content of one of the files. Raises Damaged.

        Where it is damaged, transitions are mended, and of a table or a best policy the run itself may have the same.
        """
        path, facts = self.folder / name, self.files[name]
        try:
            content = content_of(path)
        except OSError as error:
            if (right := self._original(name)) is not None:
                return right
            raise _unreadable(path, error) from error
        if is_unchanged(content, facts):
            return content
        if (right := self._mended(name, content)) is not None:
            self.mended.add(name)
            return right
        if (right := self._original(name)) is not None:
            return right
        if len(content) != facts["bytes"]:
            raise Damaged(f"{path} has {len(content)} bytes instead of {facts['bytes']}")
        raise Damaged(f"{path} has changed since it was written: its checksum is another")

    def seed(self, seed: int) -> Snapshot:
        """Return what was saved of a seed. Raises Damaged."""
        return self._read_seed(seed)[0]

    def memory(self, seed: int, rows: np.ndarray) -> None:
        """Put a seed's transitions into a ring [capacity, width]. Raises Damaged."""
        _, (reached, count) = self._read_seed(seed)
        for first, last, name in sorted(shards_of(self.files, seed)):
            if last <= reached:
                continue
            if first > reached:
                raise Damaged(f"{self.folder} lacks the transitions {reached} to {first - 1} of seed {seed}")
            try:
                shard = safetensors.numpy.load(self.read(name))["rows"]
                if shard.shape != (last - first, rows.shape[1]) or shard.dtype != rows.dtype:
                    raise ValueError(f"{shard.dtype} {shard.shape} where the memory has {rows.dtype} {rows.shape}")
                rows[np.arange(first, last) % len(rows)] = shard
            except (safetensors.SafetensorError, ValueError, KeyError) as error:
                raise Damaged(f"{self.folder / name} does not fit: {error}") from error
            reached = last
        if reached != count:
            raise Damaged(f"{self.folder} has {reached} transitions of seed {seed} at step {self.step}, not {count}")

    def _read_seed(self, seed: int) -> tuple[Snapshot, tuple[int, int]]:
        """Return what was saved of a seed, and the transitions [first, last + 1] that its memory held."""
        name = f"step_{self.step}.seed_{seed}.safetensors"
        if name not in self.files:
            raise Damaged(f"{self.folder} has nothing of seed {seed} at step {self.step}")
        content = self.read(name)
        try:
            # The header: eight bytes of length, then JSON. The library gives the metadata of files alone.
            metadata = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]
            saved = json.loads(metadata["saved"])
            first, last = saved["transitions"]
            return Snapshot(safetensors.numpy.load(content), saved["values"]), (int(first), int(last))
        except (safetensors.SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise Damaged(f"{self.folder / name} is not what csac writes ({error})") from error

    def _mended(self, name: str, content: bytes) -> bytes | None:
        """Return the content of a damaged file of transitions as it was, if its parity can tell."""
        parity, facts = parity_name(name), self.files[name]
        if not name.startswith("replay/") or parity not in self.files:
            return None
        with suppress(OSError):
            return mended(
                content, facts["bytes"], (self.folder / parity).read_bytes(), lambda guess: is_unchanged(guess, facts)
            )
        return None

    def _original(self, name: str) -> bytes | None:
        """Return what the file of the run that a file is a copy of holds, if that is still the same."""
        path = original_of(self.folder.parent, name)
        with suppress(OSError):
            if path and is_unchanged(content := path.read_bytes()[: self.files[name]["bytes"]], self.files[name]):
                return content
        return None


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
            self.pin(self.newest)

    def pin(self, step: int) -> None:
        """Keep the checkpoint of this step for good, which may still have to be committed."""
        self.pinned.add(step)

    def commit(self, step: int, files: Files, values: dict[str, Any]) -> None:
        """Make a checkpoint of files that are written already, then remove what no checkpoint needs any more."""
        values = {**values, "pinned": sorted(self.pinned)}
        # As it will be read: the checksum is of keys in order, and JSON has numbers as texts, where "10" precedes "9".
        values = json.loads(json.dumps(values))
        fields = {"schema_version": SCHEMA_VERSION, "step": step, "files": files, "values": values}
        content = json.dumps({**fields, "sha256": sha256(_encoded(fields))}, indent=1).encode()
        write_atomically(self.folder / f"step_{step}.json", content)
        _sync_folder(self.folder)
        self.newest = step
        self._prune(step)

    def discard_after(self, step: int) -> None:
        """Remove what was written after a step, cut off or not. Nobody else may be writing."""
        hidden = [path for path in self.folder.glob("**/.*") if not path.is_dir()]  # a folder is somebody else's
        later = [self.folder / f"step_{n}.json" for n in steps_in(self.folder) if n > step]
        for path in [*hidden, *later]:
            path.unlink()
        self.newest = max(steps_in(self.folder), default=None)
        self._prune(None)

    def _prune(self, newest: int | None) -> None:
        """Remove what no kept checkpoint needs; of later steps than `newest` other groups may have written already."""
        steps = steps_in(self.folder)
        needed: set[str] = set()
        unread: set[int] = set()
        for step in {*steps[-self.keep :], *self.pinned.intersection(steps)}:
            try:
                needed |= {f"step_{step}.json", *Checkpoint.open(self.folder, step).files}
            except Damaged:  # or the disk failed only this time: all that it may need stays
                unread.add(step)
        for path in [*self.folder.glob("step_*"), *self.folder.glob("replay/seed_*")]:
            at = _step_of(path.name)
            is_later = newest is not None and at > newest
            may_be_needed = at in unread or (path.parent != self.folder and at <= max(unread, default=-1))
            if not (is_later or may_be_needed or path.relative_to(self.folder).as_posix() in needed):
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
    """Return the newest checkpoint whose every file is as it was written, and what is wrong with those after it.

    Raises:
        Unread: one of those after it may be sound; without it, whoever goes on from an earlier one would discard it.
    """
    complaints = []
    for step in reversed(steps_in(folder)):
        try:
            checkpoint = Checkpoint.open(folder, step)
            checkpoint.verify()
            return checkpoint, complaints
        except Unread:
            raise
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


def _unreadable(path: Path, error: OSError) -> Damaged:
    if error.errno in _LOST:
        return Damaged(f"{path} cannot be read: {error.strerror}")
    return Unread(f"{path} cannot be read: {error.strerror}; the same line goes on once that is mended")


def original_of(run: Path, name: str) -> Path | None:
    """Return the file of a run that a file of its checkpoint is a copy of, a table or a best policy."""
    own = name.partition(".")[2]
    if name.endswith(".csv"):
        return run / own
    return run / "policy" / own if name.endswith(BEST) else None


def _checked_files(files: Any) -> Files:
    for name, facts in files.items():
        if not _FILE_NAME.fullmatch(name):
            raise ValueError(f"{name!r} is no file of a checkpoint")
        if not _is_count(facts["bytes"]) or not isinstance(facts["sha256"], str):
            raise TypeError(f"{name!r} has no size and checksum")
    return files


def _checked_values(values: Any) -> dict[str, Any]:
    values = {"log_bytes": 0, "failures": {}, "pinned": [], "groups": [], **values}
    if not _is_count(values["log_bytes"]) or not all(map(_is_count, values["pinned"])):
        raise TypeError("the log's size or pinned steps are not numbers")
    if not isinstance(values["groups"], list):
        raise TypeError("groups are not a list")
    if not all(re.fullmatch(_NUMBER, seed) and isinstance(text, str) for seed, text in values["failures"].items()):
        raise TypeError("failures are not texts by the numbers of seeds")
    return values


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**53


def _encoded(fields: dict[str, Any]) -> bytes:
    return json.dumps(fields, sort_keys=True).encode()


def _sync_folder(folder: Path) -> None:
    """Push the names of the files in a folder to the disk as well."""
    for place in (folder, folder / "replay"):
        if place.is_dir() and hasattr(os, "O_DIRECTORY"):
            descriptor = os.open(place, os.O_DIRECTORY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
