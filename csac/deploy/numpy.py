"""A policy for NumPy alone: `templates/policy.py`, which is copied beside its safetensors and runs them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from csac.deploy.contract import read_file
from csac.deploy.templates import FOLDER
from csac.deploy.templates.policy import Policy as Loader
from csac.types import InputError

if TYPE_CHECKING:
    from pathlib import Path


def loader() -> bytes:
    """Return the file of the loader, which is the same for every policy."""
    return (FOLDER / "policy.py").read_bytes()


def open_loader(path: Path) -> Loader:
    """Return csac's own copy of the loader in a folder. Raises InputError if the one there is another."""
    if read_file(path) != loader():
        raise InputError(f"{path} is not the loader of this csac, which runs no other code: export it again")
    return Loader(path.parent)
