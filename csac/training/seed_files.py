"""The files of one seed in a checkpoint: what it has learnt, and its transitions, each written once."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import safetensors.numpy

from csac.record.atomic import write_atomically
from csac.record.redundancy import parity_of

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from csac.types import Ring, Snapshot

Files = dict[str, dict[str, Any]]  # name below the checkpoint's folder -> {"bytes": size, "sha256": checksum}

_BLOCK = 4096  # bytes that are read at a time where the disk cannot read all


class SeedFiles:
    """Writes the files of one seed, and remembers which transitions are on disk already.

    Args:
        folder: the run's checkpoint folder.
        seed: the seed's label.
        known: the files of the checkpoint that the run goes on from.
    """

    def __init__(self, folder: Path, seed: int, known: Mapping[str, dict[str, Any]]) -> None:
        self.folder, self.seed = folder, seed
        shards = [name for _, _, name in shards_of(known, seed)]
        self._shards = {name: known[name] for name in [*shards, *map(parity_name, shards)] if name in known}

    def write(self, step: int, saved: Snapshot, memory: Ring) -> Files:
        """Write what is new at this step; return every file that the seed needs now.

        Raises:
            OSError: the disk is full, or the folder is gone.
        """
        for folder in (self.folder, self.folder / "replay"):  # not their parents: a run that was deleted stays so
            folder.mkdir(exist_ok=True)
        oldest = max(memory.added - len(memory.rows), 0)
        self._write_new_rows(memory, oldest)
        name = f"step_{step}.seed_{self.seed}.safetensors"
        content = safetensors.numpy.save(
            {key: np.asarray(array, order="C") for key, array in saved.arrays.items()},
            # One entry: of several the library chooses the order anew each time, and equal runs have equal files.
            metadata={"saved": json.dumps({"values": saved.values, "transitions": [oldest, memory.added]})},
        )
        return {name: write_file(self.folder, name, content), **self._shards}

    def _write_new_rows(self, memory: Ring, oldest: int) -> None:
        last = max((last for _, last, _ in shards_of(self._shards, self.seed)), default=0)
        first = max(last, oldest)
        if first < memory.added:
            rows = memory.rows[np.arange(first, memory.added) % len(memory.rows)]
            content = safetensors.numpy.save({"rows": rows})
            name = f"replay/seed_{self.seed}.{first}-{memory.added}.safetensors"
            self._shards[name] = write_file(self.folder, name, content)
            self._shards[parity_name(name)] = write_file(self.folder, parity_name(name), parity_of(content))
        for _, last, name in shards_of(self._shards, self.seed):
            if last <= oldest:
                del self._shards[name]
                self._shards.pop(parity_name(name), None)


def write_file(folder: Path, name: str, content: bytes) -> dict[str, Any]:
    """Write a file of a checkpoint; return its size and checksum for `Checkpoints.commit`."""
    write_atomically(folder / name, content)
    return {"bytes": len(content), "sha256": sha256(content)}


def content_of(path: Path) -> bytes:
    """Return the bytes of a file, with zeros for the blocks that the disk cannot read."""
    try:
        return path.read_bytes()
    except OSError as error:
        if error.errno != errno.EIO:
            raise
    with open(path, "rb", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        return b"".join(_block(file.fileno(), place, min(_BLOCK, size - place)) for place in range(0, size, _BLOCK))


def _block(descriptor: int, place: int, size: int) -> bytes:
    try:
        return os.pread(descriptor, size, place).ljust(size, b"\0")
    except OSError:
        return bytes(size)


def is_unchanged(content: bytes, facts: dict[str, Any]) -> bool:
    """Whether a file holds what was written."""
    return len(content) == facts["bytes"] and sha256(content) == facts["sha256"]


def parity_name(name: str) -> str:
    """Return the name of the file that mends a file of transitions."""
    return name.removesuffix(".safetensors") + ".parity"


def shards_of(files: Mapping[str, Any], seed: int) -> list[tuple[int, int, str]]:
    """Return (first, last + 1, name) of each file of a seed's transitions."""
    names = (re.fullmatch(rf"replay/seed_{seed}\.(\d+)-(\d+)\.safetensors", name) for name in files)
    return [(int(match[1]), int(match[2]), match[0]) for match in names if match]


def sha256(content: bytes) -> str:
    """Return a checksum in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()
