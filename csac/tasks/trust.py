"""Whose modules may be imported: only those that the person at this keyboard has named, never those that a run names.

A task `module:Id` or an algorithm `module:Class` runs the code of its module. Who types it, to train or with
`--trust-task`, wants that; who evaluates, plays or resumes somebody else's run may not know of it. Each module that was
named is noted, with the place of its package, in a file below $XDG_STATE_HOME/csac or ~/.local/state/csac.
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
    """Return the module that a task given as `module:Id` would import, or nothing."""
    return task.rpartition(":")[0] if isinstance(task, str) else ""


def remember(task: object) -> None:
    """Note that the person at this keyboard has named this task, and so its module, if it can be noted."""
    module = module_of(task)
    place = _place(module)
    if not place:
        return
    with suppress(OSError, RuntimeError):  # the latter: nobody's home is known
        note = _note(module, place)
        note.parent.mkdir(parents=True, exist_ok=True)
        note.write_text(f"{module}\n{place}\n", encoding="utf-8", errors="replace")


def refuse_untrusted(task: object, run: str | Path, trust_task: bool = False) -> None:
    """Refuse to import the module of the task that a run names, unless it was named before, or is with `trust_task`.

    What this process has imported already is not asked about.
    """
    check_flag("trust_task", trust_task)
    module = module_of(task)
    if not module or module in sys.modules:
        return
    if trust_task:
        remember(task)
        return
    place = _place(module)
    if not place:
        raise InputError(f"{run} needs the module {module}, which is not found here: begin where it is, or install it")
    with suppress(OSError, RuntimeError):
        if _note(module, place).exists():
            return
    raise InputError(
        f"{run} wants to run the code of the module {module} in {place}, which you have not named before: "
        "look at it, and if you trust it, add --trust-task (in Python: trust_task=True)"
    )


def named_task(config: RunConfig, run: str | Path, trust_task: bool, instead: str) -> str:
    """Return the task of a run, which may be made here. Raises InputError, with what to do `instead`, where not."""
    if config.task_is_callable:
        raise InputError(f"the task of {run} was made by a Python function, {config.task}: {instead}")
    refuse_untrusted(config.task, run, trust_task)
    return config.task


def _note(module: str, place: str) -> Path:
    """Return the file that is there once this module, found in this place, has been named."""
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    name = hashlib.sha256(f"{module}\n{place}".encode(errors="surrogatepass")).hexdigest()[:32]
    return state / "csac" / "trusted_tasks" / name


def _place(module: str) -> str:
    """Return where the package or file is that a module is in, or nothing. Imports nothing."""
    first = module.partition(".")[0]
    try:
        spec = importlib.util.find_spec(first) or PathFinder.find_spec(first, [os.getcwd()])
    except (ImportError, ValueError, OSError):
        return ""
    if spec is None:
        return ""
    places = [spec.origin] if spec.has_location and spec.origin else list(spec.submodule_search_locations or [])
    return os.pathsep.join(os.path.realpath(place) for place in places) or spec.origin or ""
