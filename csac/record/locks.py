"""Locks of files, which the system gives back when a process dies."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import IO
from weakref import WeakSet

from csac.types import InputError

try:
    import fcntl
except ImportError:  # Windows: nothing keeps two processes apart there
    fcntl = None

SECONDS_FOR_LOCK = 0.2  # whoever asks whether a lock is held holds it for an instant

# Files whose locks are this process's own; a closed one may stay.
_own: WeakSet[IO[str]] = WeakSet()


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
