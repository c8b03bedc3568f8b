"""Whose modules may be imported: only those that the person at this keyboard has named, never those a run names.

A task `module:Id` runs the code of its module. Who types it, to train or with `--trust-task`, wants that; who
evaluates, plays or resumes a run that somebody else made may not know of it. What was named once is noted outside of
any run, one small file for each module and the place that it was found in, below $XDG_STATE_HOME/csac or
~/.local/state/csac.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
from contextlib import suppress
from importlib.machinery import ModuleSpec
from pathlib import Path

from csac.checks import check_flag
from csac.types import InputError


def module_of(task: object) -> str:
    """Return the module that a task given as `module:Id` would import, or nothing."""
    return task.rpartition(":")[0] if isinstance(task, str) else ""


def remember(task: object) -> None:
    """Note that the person at this keyboard has named this task, and so its module, if it can be noted."""
    place = _place(module_of(task))
    note = _note(module_of(task), place) if place else None
    if note is None or os.path.exists(note):
        return
    with suppress(OSError):
        note.parent.mkdir(parents=True, exist_ok=True)
        note.write_text(f"{module_of(task)}\n{place}\n", encoding="utf-8", errors="replace")


def refuse_untrusted(task: object, run: str | Path, trust_task: bool = False) -> None:
    """Refuse to import the module of the task that a run names, unless it was named before, or is with `trust_task`.

    What this process has imported already is not run again, so that it is not asked about.

    Raises:
        InputError: nobody has named the module; the message says where it is and how to. Or `trust_task` is no bool.
    """
    check_flag("trust_task", trust_task)
    module = module_of(task)
    if not module or module in sys.modules:
        return
    if trust_task:
        remember(task)
        return
    place = _place(module)
    if place is None:
        raise InputError(f"{run} needs the module {module}, which is not found here: begin where it is, or install it")
    note = _note(module, place)
    if note is None or not os.path.exists(note):
        raise InputError(
            f"{run} wants to run the code of {place} (its task is {task}), which you have not named before: "
            "look at it, and if you trust it, add --trust-task (in Python: trust_task=True)"
        )


def _note(module: str, place: str) -> Path | None:
    """Return the file that is there once this module, found in this place, has been named."""
    try:
        state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    except RuntimeError:  # nobody's home is known
        return None
    name = hashlib.sha256(f"{module}\n{place}".encode(errors="surrogatepass")).hexdigest()[:32]
    return state / "csac" / "trusted_tasks" / name


def _place(module: str) -> str | None:
    """Return where a module's code is, or None where there is none. Runs nothing of it, nor of its packages."""
    try:
        spec = _spec(module)
    except (ImportError, ValueError, AttributeError, TypeError):
        return None
    if spec is None:
        return None
    places = [spec.origin] if spec.has_location and spec.origin else list(spec.submodule_search_locations or [])
    return os.pathsep.join(os.path.realpath(place) for place in places) or spec.origin


def _spec(module: str) -> ModuleSpec | None:
    """Return what the import system knows of a module, or None.

    `importlib.util.find_spec` would import what is around a part: only the first part, with nothing around, is for it.
    """
    first, *ends = _ends(module)
    spec = importlib.util.find_spec(module[:first])
    for end in ends:
        path = spec.submodule_search_locations if spec else None
        if path is None:  # a plain module has no parts
            return None
        spec = _find(module[:end], list(path))
    return spec


def _ends(module: str) -> list[int]:
    return [*(index for index, letter in enumerate(module) if letter == "."), len(module)]


def _find(name: str, path: list[str]) -> ModuleSpec | None:
    """Return what is known of a part of a package whose code is in these places."""
    for finder in sys.meta_path:
        try:
            spec = finder.find_spec(name, path)
        except KeyError:  # a folder without __init__.py: importlib wants the package around it to be imported
            spec = _namespace(name, path)
        if spec:
            return spec
    return None


def _namespace(name: str, path: list[str]) -> ModuleSpec | None:
    """Return the spec of a namespace package, whose places are the folders of its name that are there, if any."""
    folders = [os.path.join(place, name.rpartition(".")[2]) for place in path]
    spec = ModuleSpec(name, None, is_package=True)
    spec.submodule_search_locations = [folder for folder in folders if os.path.isdir(folder)]
    return spec if spec.submodule_search_locations else None
