"""Read and write the directory of one run (one seed): its manifest, tables, log, lock and file names."""

from __future__ import annotations

import dataclasses
import os
import warnings
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from csac.checks import check_path
from csac.record import manifest as manifests
from csac.record.files import closed_in_children, is_locked, take, write_atomically, writing
from csac.record.tables import COLUMNS, append_rows, read_rows, structured
from csac.types import Failure, InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import numpy as np

    from csac.record.config import RunConfig
    from csac.record.manifest import Manifest

Table = Literal["episodes", "metrics", "evaluations"]
TABLES: tuple[Table, ...] = ("episodes", "metrics", "evaluations")
Which = Literal["last", "best"]

LOCK = ".lock"
LOG = "log.txt"
MANIFEST = "manifest.json"


class StorageFailure(Failure):
    """A run directory can no longer be written. The message says why."""


class RunDirectory:
    """The directory of one run (one seed).

    `checkpoints`, `tensorboard` and `policies` are its folders; `policies` also holds the policies' contract.
    """

    def __init__(self, path: Path, manifest: Manifest) -> None:
        self.path, self.manifest = path, manifest
        self.checkpoints, self.tensorboard, self.policies = path / "checkpoint", path / "tensorboard", path / "policy"

    def __repr__(self) -> str:
        return f"RunDirectory({str(self.path)!r})"

    def __fspath__(self) -> str:
        return str(self.path)

    @classmethod
    def create(cls, path: str | Path, manifest: Manifest) -> RunDirectory:
        """Create a run in a new or empty directory. Raises InputError if it is not empty or cannot be written."""
        path = Path(os.path.abspath(path))
        content = manifests.written(dataclasses.replace(manifest, created=manifest.created or now()))
        with writing(path):
            path.mkdir(parents=True, exist_ok=True)
            if any(not entry.name.startswith(".") for entry in path.iterdir()):
                raise InputError(f"{path} is not empty; choose a new or an empty directory")
            write_atomically(path / MANIFEST, content)
        return cls(path, manifests.read(content))

    def rename(self, path: Path) -> None:
        """Move the run to a new or empty directory. Raises InputError if that is not empty."""
        try:
            os.rename(self.path, path)
        except OSError:
            raise InputError(f"{path} is not empty; choose another directory") from None

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> RunDirectory:
        """Open an existing run; if its manifest is lost or damaged, use the copy in its newest checkpoint.

        Raises InputError if there is no run, or no usable manifest.
        """
        check_path("a run directory", path)
        path = Path(os.path.abspath(path))
        reason = "does not exist"
        for place in (path / MANIFEST, *_manifest_copies(path)):
            try:
                manifest = manifests.read(place.read_bytes())
                if place.parent != path:
                    warnings.warn(f"{path / MANIFEST} is lost or damaged: a checkpoint's copy is read", stacklevel=2)
                return cls(path, manifest)
            except (FileNotFoundError, NotADirectoryError):
                reason = "holds no run" if path.exists() else reason
            except OSError as error:
                raise InputError(f"cannot read {place}: {error.strerror}; check its permissions") from None
            except InputError as error:
                reason = f"has a {MANIFEST} that cannot be read: {error}"
        raise InputError(f"{path} {reason}; give a run directory ('csac runs' lists them)")

    @property
    def config(self) -> RunConfig:
        """The configuration of the run."""
        return self.manifest.config

    @property
    def seed(self) -> int:
        """The run's seed."""
        return self.manifest.config.seed

    def update_manifest(self, **changes: Any) -> None:
        """Change fields of the manifest, on disk and in memory."""
        content = manifests.written(dataclasses.replace(self.manifest, **changes))
        write_atomically(self.path / MANIFEST, content)
        self.manifest = manifests.read(content)

    @property
    def state(self) -> str:
        """The state in the manifest; if that is "running" but no process holds the lock, "killed" or "waiting"."""
        state = self.manifest.state
        if state != "running" or is_locked(self.path / LOCK):
            return state
        return "waiting" if self.manifest.process is None else "killed"

    def policy_file(self, which: Which = "last") -> Path:
        """Return the path of the last or the best policy."""
        return self.policies / f"{which}.safetensors"

    def table(self, name: Table) -> Path:
        """Return the path of a table."""
        return self.path / f"{name}.csv"

    def append(self, name: Table, rows: Sequence[Mapping[str, Any]]) -> None:
        """Append rows to a table, flushed on return (see `append_rows`)."""
        append_rows(self.table(name), COLUMNS[name], rows)

    def rows(self, name: Table) -> np.ndarray:
        """Return all rows of a table as a structured array, empty if nothing was written yet.

        If the file is damaged, return the rows of its copy in the newest checkpoint, with a warning.
        """
        path = self.table(name)
        try:
            return read_rows(path) if path.exists() else structured(COLUMNS[name], [])
        except InputError:
            copies = [manifest.with_name(path.name) for manifest in _manifest_copies(self.path)]
            if not copies:
                raise
            warnings.warn(f"{path} is damaged: its copy in the newest checkpoint is read", stacklevel=3)
            return read_rows(copies[0])

    @property
    def evaluations(self) -> np.ndarray:
        """The rows of evaluations.csv, one per evaluation episode; of a fork to another task those on it alone."""
        rows, origin = self.rows("evaluations"), self.manifest.forked_from
        return rows[rows["step"] > origin.task_since] if origin else rows

    def log(self, line: str) -> None:
        """Append a line to log.txt, with a timestamp."""
        with open(self.path / LOG, "a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"{now()} {line.rstrip()}\n")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the run's lock, which keeps other processes from writing to it. Raises InputError if that fails."""
        for path in [*self.path.iterdir(), *self.checkpoints.glob("*")]:
            if path.is_symlink():  # what it points to would be overwritten
                raise InputError(f"{path} is a link: replace it by what it points to")
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
        try:
            file = closed_in_children(os.fdopen(os.open(self.path / LOCK, flags, 0o666), "r+"))
        except OSError as error:
            raise InputError(f"cannot write to {self.path}: {error.strerror}; check its permissions") from None
        with file:
            take(file, self.path)
            file.truncate(0)
            file.write(f"{os.getpid()}\n")
            file.flush()
            yield


def now() -> str:
    """Return the current local time, to the second, with its UTC offset."""
    return datetime.now().astimezone().isoformat(timespec="seconds")


def is_run(path: str | Path) -> bool:
    """Return whether there is a run in this directory, intact or damaged."""
    return os.path.exists(Path(path) / MANIFEST) or bool(_manifest_copies(Path(path)))


def _manifest_copies(path: Path) -> list[Path]:
    """Return the paths of the manifest's copies in a run's checkpoints, newest first."""
    copies = [copy for copy in path.glob(f"checkpoint/step_*/{MANIFEST}") if copy.parent.name[5:].isdecimal()]
    return sorted(copies, key=lambda copy: int(copy.parent.name[5:]), reverse=True)
