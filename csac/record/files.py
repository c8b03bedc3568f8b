"""Atomic file writes, safe against a kill at any time, and file locks, which a dying process releases."""

from __future__ import annotations

import fcntl
import os
import secrets
import time
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING
from weakref import WeakSet

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

TEMPORARY = f".*.{'[0-9a-f]' * 8}.[0-9]*"  # what `temporary_path` returns
SECONDS_FOR_LOCK = 0.2  # `is_locked` in another process holds a lock for an instant

# Files whose locks this process holds; closed ones may stay in the set.
_held_locks: WeakSet[IO[str]] = WeakSet()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise InputError, naming `path`, for an OSError of this block."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}; choose another place") from error


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file beside `path`, sync it and rename it: readers see the old file or the whole new one, never a part.

    If there are several writers, even on machines that share the folder, the last one wins.
    """
    aside = temporary_path(path)
    try:
        with open(aside, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def temporary_path(path: Path) -> Path:
    """Return the temporary name of a file until it is complete, unique among all writers on all machines."""
    unique = secrets.token_hex(4)  # containers on several machines often have equal process ids
    return path.with_name(f".{path.name}.{unique}.{os.getpid()}")


def closed_in_children(file: IO[str]) -> IO[str]:
    """Return the file, which forked processes will close: a task's helper process would otherwise keep its lock."""
    _held_locks.add(file)
    return file


def _close_held_locks() -> None:
    for file in list(_held_locks):
        file.close()


os.register_at_fork(after_in_child=_close_held_locks)


def take(file: IO[str], path: Path) -> None:
    """Take a run's lock. Raises InputError if another process holds it and does not release it."""
    deadline = time.monotonic() + SECONDS_FOR_LOCK
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() > deadline:
                holder = file.read().strip() or "unknown"
                raise InputError(f"{path} is in use by process {holder}: wait for it, or stop it") from None
            time.sleep(0.01)
        except OSError as error:  # Lustre or NFS without a lock service
            raise InputError(f"the file system of {path} has no locks ({error.strerror}): use another") from None


def is_locked(path: str | Path) -> bool:
    """Return whether a process holds the lock of this file, on this machine or one that shares the folder."""
    try:
        with open(path) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
