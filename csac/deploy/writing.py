"""An artefact as files: written to a folder of its own, and put in its place once it is whole and has been tested."""

from __future__ import annotations

import dataclasses
import os
import shutil
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from csac.deploy import tensors
from csac.deploy.artefact_contract import CONTRACT, POLICY_FILES, sha256_of
from csac.deploy.contract import read_json
from csac.deploy.parameters import to_tensors
from csac.deploy.templates import LOADER
from csac.record.files import write_atomically
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from csac.deploy.artefact_contract import ArtefactContract
    from csac.types import PolicyNetwork

CARD = "README.md"
CURVE = "curve.png"

# What may lie beside an artefact's policy, with what Python leaves where the loader was imported.
_BESIDE = {CONTRACT, CARD, CURVE, LOADER.name, "__pycache__"}


def write_artefact(folder: Path, network: PolicyNetwork, contract: ArtefactContract) -> ArtefactContract:
    """Write an artefact into a folder that is there; return its contract, with the hash of the policy's file.

    Raises:
        InputError: what the format cannot have, or a package that it needs is not installed.
    """
    path = folder / contract.file
    match contract.format:
        case "numpy":
            write_atomically(path, tensors.encode(to_tensors(network.parameters)))
            write_atomically(folder / LOADER.name, LOADER.read_bytes())
        case "onnx":
            from csac.deploy.onnx_graph import onnx_model

            write_atomically(path, onnx_model(network, contract))
        case "c":
            from csac.deploy.c_source import c_header

            write_atomically(path, c_header(network, contract).encode())
    contract = dataclasses.replace(contract, sha256=sha256_of(path))
    write_contract(folder, contract)
    return contract


def write_contract(folder: Path, contract: ArtefactContract) -> None:
    """Write contract.json into the folder of an artefact."""
    write_atomically(folder / CONTRACT, contract.text().encode())


def check_place(place: Path) -> None:
    """Raise InputError where an artefact cannot be put: over anything but an artefact, or where nothing is written."""
    try:
        _check_writable(place)
        names = {entry.name for entry in place.iterdir()} if place.is_dir() else set()
    except OSError as error:
        raise _not_written(place, error) from None
    if names and names - _BESIDE != {_policy_file(place)}:
        raise InputError(f"{place} holds something else than an artefact: choose a new or an empty folder")


def _check_writable(place: Path) -> None:
    """Raise OSError, or InputError, where no folder can be put aside for a new one."""
    if place.exists() and not place.is_dir():
        raise InputError(f"{place} is a file: choose a folder for the artefact")
    if place.exists() and (place.is_mount() or place.samefile(os.curdir)):
        raise InputError(
            f"{place} is where you are, or where a disk is mounted, and cannot be replaced: choose another"
        )
    parent = next(folder for folder in Path(os.path.realpath(place)).parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise InputError(f"cannot write into {parent}: choose a folder that is yours to write")


def _not_written(place: Path, error: OSError) -> InputError:
    return InputError(f"cannot write to {place}: {error.strerror or error}; choose another place")


def _policy_file(folder: Path) -> str | None:
    """Return the policy's file that an artefact's contract in a folder names, of whatever version; None without one.

    A policy that was saved by itself has a contract too, which names no file.
    """
    try:
        fields = read_json(folder / CONTRACT)
    except InputError:
        return None
    is_artefact = isinstance(fields, dict) and "artefact_version" in fields
    return next((name for name in POLICY_FILES.values() if is_artefact and name == fields.get("file")), None)


@contextmanager
def placed(place: Path) -> Iterator[Path]:
    """Yield a new folder that takes the place of `place` at the end, or is removed where something is raised.

    Raises:
        InputError: as `check_place`, or the place cannot be written.
    """
    check_place(place)
    place = Path(os.path.realpath(place))  # a link stays one
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))
    except OSError as error:
        raise _not_written(place, error) from None
    new, old = aside / "new", aside / "old"
    try:
        new.mkdir()
        yield new
        with suppress(FileNotFoundError):
            os.rename(place, old)
        os.rename(new, place)
    except OSError as error:
        raise _not_written(place, error) from error
    finally:
        with suppress(OSError):  # what was raised is told; an older artefact that cannot be put back stays aside
            if old.exists() and not place.exists():
                os.rename(old, place)
            shutil.rmtree(aside, ignore_errors=True)
