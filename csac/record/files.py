"""Files that are whole or not there, whenever the process that writes them is killed."""

from __future__ import annotations

import os
import secrets
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


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
