"""Create Gymnasium environments from ids, modules and callables, and look up the settings of known tasks."""

from __future__ import annotations

import importlib
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import gymnasium

from csac.checks import closest
from csac.processes import safe_path
from csac.tasks.failures import message, raise_interrupt, raised
from csac.tasks.pybullet import ADAPTERS, FAMILIES, Adapter, quietly
from csac.tasks.trust import module_of
from csac.types import InputError

Task = str | Callable[..., gymnasium.Env]

INSTALL = "pip install '.[robots]' in a clone of csac"
# Columns of evaluations.csv and TensorBoard tags that always exist.
_RESERVED = {"seed", "step", "episode", "return", "length", "success", "mean_reward", "mean_ep_length", "success_rate"}

_log = logging.getLogger(__name__)


def make(task: Task, arguments: dict[str, Any]) -> gymnasium.Env:
    """Return a new environment. Raise InputError if the task does not exist or rejects its arguments."""
    if isinstance(task, gymnasium.Env) or not (isinstance(task, str) or callable(task)):
        raise InputError(f"a task is a Gymnasium id or a function that makes an environment, not {task!r:.60}")
    name = task if isinstance(task, str) else _name_of(task) or "the task"
    adapter = adapter_of(task)
    _silence_mujoco()
    with _isolated(bool(adapter) or "pybullet" in sys.modules):
        known = registered(task) if isinstance(task, str) else task
        try:
            if isinstance(known, str):
                environment = gymnasium.make(known, disable_env_checker=True, **arguments)
            else:
                environment = known(**arguments)
            if adapter and adapter.wrap:
                environment = adapter.wrap(environment)
        except (gymnasium.error.DependencyNotInstalled, ImportError) as error:
            raise InputError(_missing_package(name, error, adapter)) from error
        except BaseException as error:
            raise_interrupt(error)
            given = f" with the arguments {arguments}" if arguments else ""
            raise InputError(f"{name} could not be made{given}: {raised(error)}") from error
    if isinstance(environment, gymnasium.vector.VectorEnv):
        raise InputError(f"{name} makes several environments at once: give what makes one, and `environments`")
    if not isinstance(environment, gymnasium.Env):
        raise InputError(f"{name} returned {environment!r:.40}: a task's callable returns a gymnasium.Env")
    return environment


def registered(task: str) -> str:
    """Return the registered id of a task, after importing its module if it names one. Raise InputError if unknown."""
    module, _, name = task.rpartition(":")
    if module:
        import_module_of(task)
    _register_known(name)
    if name in gymnasium.registry:
        return name
    similar = [task.removesuffix(name) + id for id in closest(name, sorted({*ADAPTERS, *gymnasium.registry}), most=2)]
    otherwise = f"{module} registers none of that name" if module else "write module:Id for one that a module registers"
    hint = f"did you mean {' or '.join(similar)}?" if similar else otherwise
    raise InputError(f"no task is called {task}: {hint}")


def import_module_of(name: str) -> Any:
    """Import and return the module of a task or an algorithm that the user has named. Raise InputError if that fails.

    The working directory is appended to `sys.path`, so that it is searched last, and stays there for later imports of
    the module. Modules that the user has not named are never looked up there.
    """
    module = module_of(name)
    if os.sep in module:
        hint = f"{os.path.basename(module).removesuffix('.py')}:{name.rpartition(':')[2]}"
        raise InputError(f"{name}: write the module's name, not its path: {hint} in its folder")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        return importlib.import_module(module)
    except BaseException as error:
        raise_interrupt(error)
        raise InputError(f"{name}: the module {module} cannot be imported: {raised(error)}") from error


def adapter_of(task: object) -> Adapter | None:
    """Return the adapter for a task id, with or without its module, or None."""
    name = task.rpartition(":")[2] if isinstance(task, str) else ""
    families = (adapter for prefix, adapter in FAMILIES.items() if name.startswith(prefix))
    return ADAPTERS.get(name) or next(families, None)


def _register_known(name: str) -> None:
    """Import the module that registers a known task. Raise InputError if its package is missing or lacks the task."""
    adapter = adapter_of(name)
    if adapter is None or name in gymnasium.registry:
        return
    try:
        importlib.import_module(adapter.module)
    except ImportError as error:
        if name in ADAPTERS:
            raise InputError(_missing_package(name, error, adapter)) from error
    if name in ADAPTERS and name not in gymnasium.registry:
        raise InputError(f"the {adapter.module.partition('.')[0]} that is installed has no {name}: {INSTALL}")


def _missing_package(name: str, error: Exception, adapter: Adapter | None) -> str:
    hint = f": {INSTALL}" if adapter else ""
    return f"{name} needs a package that is not installed ({message(error)}){hint}"


def task_name(task: Task, environment: gymnasium.Env) -> str:
    """Return the id, or the name of the callable or of its environment."""
    if isinstance(task, str):
        return task
    return _name_of(task) or (environment.spec.id if environment.spec else type(environment.unwrapped).__name__)


def _name_of(task: Callable[..., gymnasium.Env]) -> str:
    return getattr(task, "__name__", "").replace("<lambda>", "")


def is_pybullet(environment: gymnasium.Env) -> bool:
    """Return whether this is an environment of PyFlyt or panda-gym, or derived from one."""
    return bool(_packages(environment) & {"PyFlyt", "panda_gym"})


def has_memory(task: object, environment: gymnasium.Env) -> bool:
    """Return whether an episode depends on earlier ones; assume so for panda-gym tasks without an adapter."""
    adapter = ADAPTERS.get(task.rpartition(":")[2]) if isinstance(task, str) else None
    return adapter.has_memory if adapter else "panda_gym" in _packages(environment)


def _packages(environment: gymnasium.Env) -> set[str]:
    return {kind.__module__.partition(".")[0] for kind in type(environment.unwrapped).__mro__}


def events_of(task: object, more: Iterable[str] = ()) -> tuple[str, ...]:
    """Return the names of a known task's default events, then `more`, without duplicates."""
    adapter = adapter_of(task)
    return tuple(dict.fromkeys([*(adapter.events if adapter else ()), *more]))


def check_events(events: Sequence[str]) -> None:
    """Raise InputError for a name that cannot be a column of evaluations.csv and a TensorBoard tag."""
    if isinstance(events, str) or not isinstance(events, Iterable):
        raise InputError(f"events are a list of names such as ('collision',), not {events!r:.40}")
    for name in events:
        if not is_column(name):
            raise InputError(f"{name!r} cannot name an event: it is no plain word, or a column that there is anyway")


def is_column(name: object) -> bool:
    """Return whether a name can be a new column: a plain word that is not reserved."""
    is_word = isinstance(name, str) and name.isprintable() and name and not {*name} & {*" ,;\"'#"}
    return bool(is_word) and name not in _RESERVED


@contextmanager
def _isolated(is_pybullet: bool) -> Iterator[None]:
    """Hide Gymnasium's warnings and PyBullet's output in this block, and restore the working directory afterwards."""
    with ExitStack() as stack, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r".*WARN: ")  # such as: an id has a newer version
        stack.callback(os.chdir, os.getcwd())
        if is_pybullet:
            stack.enter_context(quietly())
        yield


def _silence_mujoco() -> None:
    """Send MuJoCo's warnings to the log instead of the terminal and MUJOCO_LOG.TXT in the working directory."""
    try:
        with safe_path():  # importing GLFW, the renderers' library, starts another Python to find its version
            mujoco = importlib.import_module("mujoco")
            importlib.import_module("glfw")
    except Exception:  # a task that needs MuJoCo reports it
        return
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_log.info)
