"""From a task's name to a Gymnasium environment: ids, modules, callables, and nobody's warnings in the user's way."""

from __future__ import annotations

import importlib
import logging
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import gymnasium

from csac.checks import did_you_mean
from csac.tasks import known
from csac.tasks.silence import quietly
from csac.tasks.spaces import RAISED, message, one_line
from csac.types import InputError

Task = str | Callable[..., gymnasium.Env]

_log = logging.getLogger(__name__)


def make(task: Task, arguments: dict[str, Any]) -> gymnasium.Env:
    """Return a new environment. Raises InputError where there is no such task or it refuses its arguments."""
    _check_task(task)
    name = task if isinstance(task, str) else _name_of(task) or "the task"
    adapter = known.adapter_of(task)
    _silence_mujoco()
    with _gymnasium_silenced(), quietly() if adapter or "pybullet" in sys.modules else nullcontext():
        id_there = registered(task) if isinstance(task, str) else None
        try:
            if id_there is not None:
                environment = gymnasium.make(id_there, disable_env_checker=True, **arguments)
                environment = adapter.wrap(environment) if adapter and adapter.wrap else environment
            else:
                environment = task(**arguments)  # pyright: ignore[reportCallIssue]
        except (gymnasium.error.DependencyNotInstalled, ImportError) as error:
            if adapter:
                raise InputError(known.missing(name, error)) from error
            raise InputError(f"{name} needs a package that is not installed: {message(error)}") from error
        except RAISED as error:
            given = f" with the arguments {arguments}" if arguments else ""
            raise InputError(f"{name} could not be made{given}: {one_line(error)}") from error
    if not isinstance(environment, gymnasium.Env):
        raise InputError(f"{name} returned {environment!r:.40}: a task's callable returns a gymnasium.Env")
    return environment


def _check_task(task: object) -> None:
    if isinstance(task, gymnasium.Env):
        raise InputError(
            f"the task is an environment already made ({type(task).__name__}), and csac makes several: "
            "give its id, or a function that makes one, such as lambda: gymnasium.make(...)"
        )
    if not isinstance(task, str) and not callable(task):
        raise InputError(f"a task is a Gymnasium id or a function that makes an environment, not {task!r}")


def registered(task: str) -> str:
    """Return the registered id of a task, after importing its module where one is named. Raises InputError."""
    module, _, name = task.rpartition(":")
    if module:
        try:
            importlib.import_module(module)
        except RAISED as error:
            raise InputError(f"{task}: the module {module} cannot be imported: {one_line(error)}") from error
    known.register(name)
    if name in gymnasium.registry and not _is_gone(gymnasium.registry[name]):
        return name
    ids = sorted({*known.ADAPTERS, *(id for id, spec in gymnasium.registry.items() if not _is_gone(spec))})
    family = name.rpartition("-v")[0] or name
    versions = [id for id in ids if id.rpartition("-v")[0] == family]
    others = f"did you mean {' or '.join(versions)}?" if versions else did_you_mean(name, ids, most=3)
    otherwise = f"{module} registers none of that name" if module else "write module:Id for one that a module registers"
    raise InputError(f"no task is called {task}: {others or otherwise}")


def _is_gone(spec: Any) -> bool:
    """Whether Gymnasium registers the id only to say that it has moved (MuJoCo's v2 and v3)."""
    return getattr(spec.entry_point, "__name__", "") == "_raise_mujoco_py_error"


def _silence_mujoco() -> None:
    """Send MuJoCo's warnings to the log: by itself it prints them, and writes MUJOCO_LOG.TXT where the user works."""
    try:
        mujoco = importlib.import_module("mujoco")
    except Exception:  # a task that needs it says so
        return
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_log.info)


@contextmanager
def _gymnasium_silenced() -> Iterator[None]:
    """Hide Gymnasium's own warnings, such as that an id has a newer version, and nobody else's."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r".*WARN: ")
        yield


def _name_of(task: Callable[..., gymnasium.Env]) -> str:
    name = getattr(task, "__name__", "")
    return "" if name == "<lambda>" else name


def task_name(task: Task, environment: gymnasium.Env) -> str:
    """Return the id, or what a callable or its environment is called."""
    if isinstance(task, str):
        return task
    return _name_of(task) or (environment.spec.id if environment.spec else type(environment.unwrapped).__name__)


def check_render_mode(environment: gymnasium.Env, render_mode: str | None) -> None:
    """Raise InputError for a render mode that the environment does not have."""
    known = environment.metadata.get("render_modes", [])
    if render_mode is not None and render_mode not in known:
        raise InputError(f"no render mode {render_mode!r}: it has {', '.join(known) or 'none'}")
