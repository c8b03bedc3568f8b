"""From a task's name to a Gymnasium environment: ids, modules, callables, and nobody's warnings in the user's way."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import gymnasium

from csac.checks import closest
from csac.tasks import known
from csac.tasks.mistakes import raised
from csac.tasks.silence import quietly
from csac.tasks.spaces import RAISED, message
from csac.types import InputError

Task = str | Callable[..., gymnasium.Env]

_MOST_NAMED = 5  # tasks of a module
_DRAWN_BY_PYGAME = tuple(f"gymnasium.envs.{kind}." for kind in ("box2d", "classic_control", "toy_text"))

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
            raise InputError(f"{name} could not be made{given}: {raised(error)}") from error
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
    before = {*gymnasium.registry}
    if module:
        try:
            importlib.import_module(module)
        except RAISED as error:
            raise InputError(f"{task}: the module {module} cannot be imported: {raised(error)}") from error
    known.register(name)
    if name in gymnasium.registry and not _is_gone(gymnasium.registry[name]):
        return name
    raise InputError(f"no task is called {task}: {_others(module, name, before)}")


def _others(module: str, name: str, before: set[str]) -> str:
    """Say what may have been meant by a name that there is not; `before` were there before the module was imported."""
    there = {id: spec for id, spec in gymnasium.registry.items() if not _is_gone(spec)}
    if module and (own := [id for id in there if id not in before or _is_made_by(module, there[id])]):
        named = ", ".join(f"{module}:{id}" for id in own[:_MOST_NAMED])
        more = ", ..." if len(own) > _MOST_NAMED else ""
        return _similar(name, own, f"{module}:") or f"{module} registers {named}{more}"
    otherwise = f"{module} registers none of that name" if module else "write module:Id for one that a module registers"
    return _similar(name, sorted({*known.ADAPTERS, *there})) or otherwise


def _similar(name: str, ids: list[str], prefix: str = "") -> str:
    """Return "did you mean ...?" with other versions of a task, or what resembles its name, or nothing."""
    family = name.rpartition("-v")[0] or name
    versions = [id for id in ids if id.rpartition("-v")[0] == family]
    meant = versions or closest(name, ids, most=3)
    return f"did you mean {' or '.join(prefix + id for id in meant)}?" if meant else ""


def _is_made_by(module: str, spec: Any) -> bool:
    """Whether what makes a task is in a module, or below it: it may have been imported, and registered it, before."""
    creator = spec.entry_point
    place = creator.partition(":")[0] if isinstance(creator, str) else getattr(creator, "__module__", "")
    return f"{place}.".startswith(f"{module}.")


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


def can_be_drawn(task: str) -> bool:
    """Whether a video can be made of a task of which this process has made an environment, as far as is known of it."""
    spec = gymnasium.registry.get(task.rpartition(":")[2])
    creator: Any = spec.entry_point if spec else None
    place = creator if isinstance(creator, str) else f"{getattr(creator, '__module__', '')}"
    if place.startswith(_DRAWN_BY_PYGAME) and importlib.util.find_spec("pygame") is None:
        return False
    if isinstance(creator, str):
        module, _, name = creator.partition(":")
        creator = getattr(sys.modules.get(module), name, None)
    modes = (getattr(creator, "metadata", None) or {}).get("render_modes")
    return modes is None or "rgb_array" in modes


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
