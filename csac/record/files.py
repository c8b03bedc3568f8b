"""Files that are whole or not there, whenever their writer is killed, and locks, which a dying process gives back."""

from __future__ import annotations

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

try:
    import fcntl
except ImportError:  # Windows: nothing keeps two processes apart there
    fcntl = None

SECONDS_FOR_LOCK = 0.2  # whoever asks whether a lock is held holds it for an instant

# Files whose locks are this process's own; a closed one may stay.
_own: WeakSet[IO[str]] = WeakSet()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise InputError where what a user wants at `path` cannot be written in this block."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}; choose another place") from error


def write_atomically(path: Path, data: bytes) -> None:
    """Write beside `path`, sync, rename: a reader meets the old file or the whole new one, never a part.

    Of several writers, on machines that share the folder too, one is the last.
    """
    aside = name_aside(path)
    try:
        with open(aside, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def name_aside(path: Path) -> Path:
    """Return what a file is called until it is whole: a name that no other writer takes, on whatever machine."""
    unique = secrets.token_hex(4)  # containers on several machines often have the same process number
    return path.with_name(f".{path.name}.{unique}.{os.getpid()}")


def kept_from_children(file: IO[str]) -> IO[str]:
    """Return a file that is closed in every forked process: a task's helper would keep the lock while it lives."""
    _own.add(file)
    return file


def _close_own() -> None:
    for file in list(_own):
        file.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_own)


def take(file: IO[str], path: Path) -> None:
    """Take a run's lock. Raises InputError where another process has it, and keeps it."""
    if fcntl is None:
        return
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
    """Return whether a process holds the lock of this file, on this machine or one that shares the folder.

    Where the system has no locks, say so of every file: nobody is known to have died.
    """
    if fcntl is None:
        return True
    try:
        with open(path) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
