"""Files that are whole or not there, whenever the process that writes them is killed."""

from __future__ import annotations

import os
import secrets
from contextlib import contextmanager
from typing import TYPE_CHECKING

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


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
