"""What `csac study` refuses before anything starts: folders that are none, or that nobody may write."""

from __future__ import annotations

import errno
import os
from typing import TYPE_CHECKING

from csac.types import InputError

if TYPE_CHECKING:
    from pathlib import Path

    from csac.studies.cells import Store


def refuse_file(directory: Path) -> None:
    """Raise InputError where a folder is wanted and a file is there."""
    if os.path.exists(directory) and not os.path.isdir(directory):
        raise InputError(f"{directory} is a file; choose another directory")


def refuse_unwritable(directory: Path, folder: Path | None = None) -> None:
    """Make `folder` in a directory, by default the directory itself. Raises InputError where nobody may write there."""
    folder = folder or directory
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to {directory}: {error.strerror}; choose another directory") from None
    if not os.access(folder, os.W_OK | os.X_OK):  # it was there already
        raise InputError(f"cannot write to {directory}: {os.strerror(errno.EACCES)}; choose another directory")


def refuse_as_results(directory: Path, store: Store) -> None:
    """Raise InputError where results cannot lie, before hours are spent on them."""
    cells = directory / "cells"
    if cells.resolve() == store.root.resolve():
        raise InputError(f"--results {directory} is where the runs themselves lie: choose another directory")
    refuse_unwritable(directory, cells)
