"""A run directory: its manifest, its tables, its log, and what its files are called."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import time
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, TextIO, TypeVar
from weakref import WeakSet

import numpy as np

from csac.checks import check_path
from csac.record import manifest as manifests
from csac.record.atomic import create_atomically, write_atomically
from csac.record.csv_tables import COLUMNS, append_rows, read_rows, structured
from csac.types import InputError

try:
    import fcntl
except ImportError:  # Windows: nothing keeps two processes apart there
    fcntl = None

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from csac.record.manifest import Manifest

Table = Literal["episodes", "metrics", "evaluations"]
Which = Literal["last", "best"]

_File = TypeVar("_File", bound=IO[str])

LOCK = ".lock"
MANIFEST = "manifest.json"

# Whoever looks whether a lock is held (`is_locked`) holds it for an instant: that is waited for.
_LOOKS = 20
_SECONDS_OF_A_LOOK = 0.01


class StorageFailure(RuntimeError):
    """A run directory can no longer be written. The message says why, in one line."""


class Occupied(InputError):
    """There is something in a directory already."""


class RunDirectory:
    """One run on disk."""

    def __init__(self, path: Path, manifest: Manifest) -> None:
        self.path = path
        self.manifest = manifest

    def __repr__(self) -> str:
        return f"RunDirectory({str(self.path)!r})"

    @classmethod
    def create(cls, path: str | Path, manifest: Manifest) -> RunDirectory:
        """Start a run in a new or empty directory; the moment is noted in its manifest.

        Raises InputError, and leaves no trace, where `path` holds a run, holds anything else, or cannot be written.
        """
        path = Path(path)
        content = manifests.written(dataclasses.replace(manifest, created=manifest.created or now()))
        try:
            _claim(path, content)
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(f"cannot write to {path}: {reason}; choose another directory") from None
        return cls(path, manifests.read(content))

    @classmethod
    def create_by_date(cls, task_name: str, manifest: Manifest) -> RunDirectory:
        """As `create`, in `runs/<task>/<algorithm>/<date-time>`, or `<date-time>-2` and so on where that is taken."""
        moment = datetime.now().strftime("%Y%m%d-%H%M%S")
        first = Path("runs", task_name.replace("/", "-"), manifest.algorithm, moment)
        path, number = first, 1
        while True:
            if not os.path.lexists(path):
                with suppress(Occupied):  # by a process that began in the same second
                    return cls.create(path, manifest)
            number += 1
            path = first.with_name(f"{moment}-{number}")

    @classmethod
    def open(cls, path: str | Path) -> RunDirectory:
        """Open a run that exists. Raises InputError where there is none or its manifest cannot be used."""
        check_path("a run directory", path)
        path = Path(path)
        try:
            return cls(path, manifests.read((path / MANIFEST).read_bytes()))
        except (FileNotFoundError, NotADirectoryError):
            what = "holds no run" if path.exists() else "does not exist"
            raise InputError(f"{path} {what}; give a run directory ('csac runs' lists them)") from None
        except OSError as error:
            raise InputError(f"cannot read {path / MANIFEST}: {error.strerror}; check its permissions") from None
        except manifests.NewerError as error:
            raise InputError(f"{path / MANIFEST} was written by a newer csac: {error}; upgrade csac") from None
        except InputError as error:
            raise InputError(f"{path / MANIFEST} is broken: {error}; restore it or train again") from None

    def discard(self) -> None:
        """Remove the directory with all that is in it, as far as that can be."""
        shutil.rmtree(self.path, ignore_errors=True)

    def read_again(self) -> None:
        """Take the manifest as it is on disk now. Raises InputError where it is gone or broken."""
        self.manifest = RunDirectory.open(self.path).manifest

    def update_manifest(self, **changes: Any) -> None:
        """Change fields of the manifest, on disk and in `manifest`, at one stroke."""
        content = manifests.written(dataclasses.replace(self.manifest, **changes))
        write_atomically(self.path / MANIFEST, content)
        self.manifest = manifests.read(content)

    @property
    def state(self) -> str:
        """The state of the manifest; "killed" where that says "running" and no process holds the run's lock."""
        state = self.manifest.state
        return "killed" if state == "running" and fcntl and not is_locked(self.path / LOCK) else state

    @property
    def checkpoints(self) -> Path:
        """The folder of its checkpoints."""
        return self.path / "checkpoint"

    @property
    def tensorboard(self) -> Path:
        """The folder of its TensorBoard files."""
        return self.path / "tensorboard"

    @property
    def wandb(self) -> Path:
        """The folder of what W&B keeps of it."""
        return self.path / "wandb"

    @property
    def curve(self) -> Path:
        """The picture of its evaluations."""
        return self.path / "curve.png"

    @property
    def contract(self) -> Path:
        """What its policies and its task agree on."""
        return self.path / "policy" / "contract.json"

    def policy(self, seed: int, which: Which = "last") -> Path:
        """Return the file of a seed's last or best policy."""
        return self.path / "policy" / f"seed_{seed}{'.best' if which == 'best' else ''}.safetensors"

    def seeds_with_policies(self) -> list[int]:
        """Return the labels of the seeds whose last policy is there, in order."""
        names = (re.fullmatch(r"seed_(\d+)\.safetensors", path.name) for path in self.contract.parent.glob("seed_*"))
        return sorted(int(match[1]) for match in names if match)

    def append(self, name: Table, rows: Sequence[Mapping[str, Any]]) -> None:
        """Add rows to `<name>.csv`, flushed on return; the first rows written fix its columns (see `append_rows`)."""
        append_rows(self._table(name), COLUMNS[name], rows)

    def rows(self, name: Table) -> np.ndarray:
        """Every row of `<name>.csv` as a structured array; an empty one where nothing was written yet."""
        path = self._table(name)
        rows = read_rows(path) if path.exists() else structured(COLUMNS[name], [])
        if missing := set(COLUMNS[name]) - set(rows.dtype.names or ()):
            raise InputError(f"{path} is damaged: it has no column {min(missing)}; restore it")
        return rows

    @property
    def evaluations(self) -> np.ndarray:
        """The rows of evaluations.csv: one per evaluation episode, in the order written."""
        return self.rows("evaluations")

    @property
    def sound_evaluations(self) -> np.ndarray:
        """The rows of evaluations.csv without those of seeds that have failed: what means over seeds are made of."""
        rows = self.evaluations
        return rows[~np.isin(rows["seed"], list(self.manifest.failures))]

    def log(self, line: str) -> None:
        """Add a line to log.txt, after the time of now."""
        moment = datetime.now().astimezone().isoformat(timespec="seconds")
        # A traceback has lines of the task's own, which may be no UTF-8.
        with open(self.path / "log.txt", "a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"{moment} {line.rstrip()}\n")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from writing to this run. The system gives the lock back if this process dies.

        Raises InputError where another process holds it, or the file system has none to give.
        """
        with self._open_lock() as file:
            if fcntl:
                try:
                    _take(file)
                except BlockingIOError:
                    file.seek(0)
                    holder = file.read().strip() or "unknown"
                    raise InputError(f"{self.path} is in use by process {holder}: wait for it, or stop it") from None
                except OSError as error:  # Lustre, or NFS, where nobody serves them
                    raise InputError(
                        f"the file system of {self.path} has no locks ({error.strerror}): choose a directory on another"
                    ) from None
            file.truncate(0)
            file.write(f"{os.getpid()}\n")
            file.flush()
            yield

    def _open_lock(self) -> TextIO:
        try:
            return kept_from_children(open(self.path / LOCK, "a+"))
        except OSError as error:
            raise InputError(f"cannot write to {self.path}: {error.strerror}; check its permissions") from None

    def _table(self, name: Table) -> Path:
        return self.path / f"{name}.csv"


# Files whose locks are this process's own; one that was closed may stay, since nothing happens to it.
_own: WeakSet[IO[str]] = WeakSet()


def kept_from_children(file: _File) -> _File:
    """Return a file that is closed in every process forked from this one.

    A lock belongs to the open file, which such a child shares: a task's helper that outlives this process would keep
    its lock for as long as it lives.
    """
    _own.add(file)
    return file


def _close_own() -> None:
    for file in list(_own):
        file.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_own)


def _take(file: TextIO) -> None:
    """Take a file's lock. Raises BlockingIOError where another process has it, and keeps it."""
    assert fcntl
    for _ in range(_LOOKS):
        with suppress(BlockingIOError):
            return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        time.sleep(_SECONDS_OF_A_LOOK)
    return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def now() -> str:
    """Return the moment, to the second, with its offset from universal time."""
    return datetime.now().astimezone().isoformat(timespec="seconds")


def is_locked(path: str | Path) -> bool:
    """Whether a process holds the lock of this file, on this machine or on another that shares the folder."""
    if fcntl is None:  # Windows
        return False
    try:
        with open(path) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def is_run(path: str | Path) -> bool:
    """Whether there is a run in this directory, sound or not."""
    return os.path.exists(Path(path) / MANIFEST)  # unlike Path.exists, it raises for no name


def find_runs(directory: str | Path, on_damaged: Callable[[InputError], None] | None = None) -> list[RunDirectory]:
    """Return every readable run in `directory` and below, sorted by path; `on_damaged` is told why another is not.

    Raises:
        InputError: there is no such directory.
    """
    directory = Path(directory)
    if not os.path.isdir(directory):
        raise InputError(f"there is no directory {directory}; give one that holds runs")
    runs = []
    for folder, below, files in os.walk(directory):
        if MANIFEST in files:
            try:
                runs.append(RunDirectory.open(folder))
                below.clear()
            except InputError as error:
                if on_damaged and "evaluations.csv" in files:  # else it is the manifest of something else
                    on_damaged(error)
    return sorted(runs, key=lambda run: run.path)


def _claim(path: Path, manifest: bytes) -> None:
    """Make `path` a run, or raise and leave it as it was."""
    _refuse_occupied(path)
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
        # Of two processes that found the same empty directory, only one gets past this line.
        create_atomically(path / MANIFEST, manifest)
    except FileExistsError:
        _refuse_occupied(path)
        raise
    except BaseException:
        for folder in made:
            with suppress(OSError):
                folder.rmdir()
        raise


def _is_left_over(path: Path) -> bool:
    """Whether this is what a process leaves that is killed while it creates a run."""
    return path.name.startswith((f".{MANIFEST}.", f"..{MANIFEST}."))


def _refuse_occupied(path: Path) -> None:
    if (path / MANIFEST).exists():
        raise Occupied(f"{path} already holds a run; resume it, or choose another directory")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path} is a file; choose another directory")
    if path.exists() and not all(_is_left_over(entry) for entry in path.iterdir()):
        raise InputError(f"{path} is not empty and holds no run; choose a new or an empty directory")
