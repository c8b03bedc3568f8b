"""What `csac study` refuses before anything starts: folders, tasks and a device that every cell would fail at."""

from __future__ import annotations

import errno
import json
import os
from contextlib import closing
from typing import TYPE_CHECKING

from csac.processes import Child, die_with_parent
from csac.studies.cells import is_final
from csac.tasks.environment import Environment
from csac.tasks.perturbations import perturbations_of
from csac.tasks.preflight import try_task
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from multiprocessing.connection import Connection
    from pathlib import Path

    from csac.studies.cells import Cell, Store
    from csac.studies.job import Job


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


def refuse_tasks(jobs: Iterable[Job]) -> None:
    """Raise InputError where a task cannot be made here, with what is to be trained; what is final needs none.

    Each is made once, whatever its methods and seeds, and changed in every way that its conditions ask for.
    """
    cells: dict[tuple[str, str], list[Cell]] = {}
    for job in jobs:
        if not is_final(job.path):
            arguments = json.dumps(job.cell.environment_arguments, sort_keys=True)
            cells.setdefault((job.cell.task, arguments), []).append(job.cell)
    refused = {}
    for (task, _), several in cells.items():
        try:
            _try(several)
        except InputError as error:
            refused.setdefault(task, error)
    if refused:
        others = dict.fromkeys(task for task, _ in cells if task not in refused)
        without = f" (--tasks {','.join(others)} runs the others)" if others else ""
        raise InputError(f"{next(iter(refused.values()))}{without}")


def _try(cells: list[Cell]) -> None:
    """Make the task that these have in common. Raises InputError."""
    conditions = dict.fromkeys(cell.perturbations for cell in cells)
    changes = {item.kind: item.value for condition in conditions for item in perturbations_of(condition)}
    with closing(Environment(cells[0].task, cells[0].environment_arguments)) as environment:
        try_task(environment, cells[0].environment_arguments)
        for kind, value in changes.items():
            environment.perturb({kind: value})


def refuse_device(device: str, beside: bool) -> None:
    """Raise InputError where there is no such device for cells that are trained here or, one each, `beside`.

    The GPU is looked for where cells are trained: a process that has looked keeps some of its memory.
    """
    if not beside:
        _choose(device)
    elif device != "cpu":
        child = Child(_look, device, daemon=True)
        try:
            problem = child.connection.recv()
        except EOFError:
            problem = child.cause_of_death()
        finally:
            child.kill()
        if problem:
            raise InputError(problem)


def _look(connection: Connection, device: str) -> None:
    die_with_parent()
    try:
        _choose(device)
        connection.send("")
    except InputError as error:
        connection.send(str(error))


def _choose(device: str) -> None:
    from csac.training.devices import choose_device  # JAX

    choose_device(device)
