"""Allow importing only modules that the user has named on this machine, not those that only a run names.

A task `module:Id` or an algorithm `module:Class` runs the code of its module. A user who types it, to train or with
`--trust-task`, wants that; one who evaluates, plays or resumes somebody else's run may not know of it. Each named
module is recorded, with the location of its package, in a file below $XDG_STATE_HOME/csac or ~/.local/state/csac.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
from contextlib import suppress
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TYPE_CHECKING

from csac.checks import check_flag
from csac.types import InputError

if TYPE_CHECKING:
    from csac.record.config import RunConfig


def module_of(task: object) -> str:
    """Return the module that a task `module:Id` would import, or an empty string."""
    return task.rpartition(":")[0] if isinstance(task, str) else ""


def remember(task: object) -> None:
    """Record that the user has named this task, and so its module. Do nothing if the file cannot be written."""
    module = module_of(task)
    location = _location(module)
    if not location:
        return
    with suppress(OSError, RuntimeError):  # RuntimeError: the home directory is unknown
        record = _record_path(module, location)
        record.parent.mkdir(parents=True, exist_ok=True)
        record.write_text(f"{module}\n{location}\n", encoding="utf-8", errors="replace")


def refuse_untrusted(task: object, run: str | Path, trust_task: bool = False) -> None:
    """Raise InputError unless the user has named the module of a run's task before, or passes `trust_task` now.

    A module that this process has already imported is allowed.
    """
    check_flag("trust_task", trust_task)
    module = module_of(task)
    if not module or module in sys.modules:
        return
    if trust_task:
        remember(task)
        return
    location = _location(module)
    if not location:
        raise InputError(f"{run} needs the module {module}, which is not found here: begin where it is, or install it")
    with suppress(OSError, RuntimeError):
        if _record_path(module, location).exists():
            return
    raise InputError(
        f"{run} wants to run the code of the module {module} in {location}, which you have not named before: "
        "look at it, and if you trust it, add --trust-task (in Python: trust_task=True)"
    )


def named_task(config: RunConfig, run: str | Path, trust_task: bool, instead: str) -> str:
    """Return the task of a run. Raise InputError, which says what to do `instead`, if it may not be created here."""
    if config.task_is_callable:
        raise InputError(f"the task of {run} was made by a Python function, {config.task}: {instead}")
    refuse_untrusted(config.task, run, trust_task)
    return config.task


def _record_path(module: str, location: str) -> Path:
    """Return the path of the file that records this module at this location."""
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    name = hashlib.sha256(f"{module}\n{location}".encode(errors="surrogatepass")).hexdigest()[:32]
    return state / "csac" / "trusted_tasks" / name


def _location(module: str) -> str:
    """Return the location of a module's top-level package or file, or an empty string, without importing anything."""
    first = module.partition(".")[0]
    try:
        spec = importlib.util.find_spec(first) or PathFinder.find_spec(first, [os.getcwd()])
    except (ImportError, ValueError, OSError):
        return ""
    if spec is None:
        return ""
    places = [spec.origin] if spec.has_location and spec.origin else list(spec.submodule_search_locations or [])
    return os.pathsep.join(os.path.realpath(location) for location in places) or spec.origin or ""
