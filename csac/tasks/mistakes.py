"""What is wrong with a user's own environment, in words: where it raised, and what `reset` and `step` are to return."""

from __future__ import annotations

import inspect
import re
import sysconfig
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from csac.tasks.spaces import EnvironmentFailure, one_line
from csac.types import InputError

if TYPE_CHECKING:
    from types import FrameType

_LIBRARIES = frozenset({"csac", "gymnasium", "numpy"})
_STANDARD_LIBRARY = sysconfig.get_path("stdlib")

_RESET = "reset must return (observation, info)"
_STEP = "step must return five values (observation, reward, terminated, truncated, info)"

# Who takes apart what `reset` and `step` give, and what Python says where that cannot be done.
_UNPACKING = ("csac.tasks.environment", "gymnasium.core", "gymnasium.wrappers.")
_UNPACKED = re.compile(
    r"(?:not enough|too many) values to unpack \(expected (?P<count>\d+)(?:, got (?P<given>\d+))?\)"
    r"|cannot unpack non-iterable (?P<kind>\w+) object"
)


def raised(error: BaseException) -> str:
    """Return an error in one line, with the place in the user's own code that it came from, if it came from there."""
    own = [(frame, line) for frame, line in traceback.walk_tb(error.__traceback__) if _is_own(frame)]
    return one_line(error) + (f" ({Path(own[-1][0].f_code.co_filename).name}, line {own[-1][1]})" if own else "")


def failed_reset(error: BaseException) -> EnvironmentFailure:
    """Return the failure of an environment whose `reset` raised, or gave what a wrapper could not take apart."""
    if _misreturned(error, 2) is None:
        return EnvironmentFailure(f"reset raised {raised(error)}")
    return EnvironmentFailure(f"{_RESET}: in old Gym it was the observation alone")


def failed_step(error: BaseException) -> EnvironmentFailure:
    """Return the failure of an environment whose `step` raised, or gave other than five values."""
    given = _misreturned(error, 5)
    if given is None:
        return EnvironmentFailure(f"step raised {raised(error)}")
    hint = ": the one `done` of old Gym is terminated or truncated" if given == "4" else ""
    return EnvironmentFailure(f"{_STEP}{given and f', not {given}'}{hint}")


def first_observation(given: Any) -> Any:
    """Return the observation out of what `reset` gave. Raises EnvironmentFailure where that is no pair with an info."""
    if isinstance(given, tuple | list) and len(given) == 2 and isinstance(given[1], Mapping | None):
        return given[0]
    raise EnvironmentFailure(f"{_RESET}, not {_described(given)}: in old Gym it was the observation alone")


def check_reset(environment: gymnasium.Env) -> None:
    """Raise InputError where `reset` does not take a seed, or the options that Gymnasium's wrappers hand on."""
    asked = ["seed"]
    while isinstance(environment, gymnasium.Wrapper) and _module_of(environment.reset).startswith("gymnasium."):
        environment, asked = environment.env, ["seed", "options"]
    try:
        parameters = inspect.signature(environment.reset).parameters
    except (TypeError, ValueError):  # one that is not written in Python
        return
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    if missing := [name for name in asked if name not in parameters]:
        raise InputError(f"reset takes no {missing[0]}: write it as def reset(self, *, seed=None, options=None)")


def _misreturned(error: BaseException, count: int) -> str | None:
    """Return what was given in place of so many values, "" where Python does not say, or None for any other error."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    match = _UNPACKED.fullmatch(str(error)) if isinstance(error, ValueError | TypeError) else None
    if match is None or match["count"] not in (None, str(count)) or not _name_of(frame).startswith(_UNPACKING):
        return None
    if kind := match["kind"]:
        return "None" if kind == "NoneType" else f"a {kind}"
    return match["given"] or ""


def _described(given: Any) -> str:
    if isinstance(given, np.ndarray):
        return f"an array of shape {given.shape}"
    if isinstance(given, tuple) and len(given) <= 3:
        return f"({', '.join(type(part).__name__ for part in given)})"
    if isinstance(given, tuple | list):
        return f"a {type(given).__name__} of {len(given)}"
    return "None" if given is None else f"a {type(given).__name__}"


def _is_own(frame: FrameType) -> bool:
    """Whether a frame is in code that no library has brought."""
    path = frame.f_code.co_filename
    if _name_of(frame).partition(".")[0] in _LIBRARIES or path.startswith("<frozen"):
        return False
    return not (path.startswith(_STANDARD_LIBRARY) or {"site-packages", "dist-packages"} & {*Path(path).parts})


def _name_of(frame: FrameType) -> str:
    """Return the name of the module that a frame is in."""
    return str(frame.f_globals.get("__name__"))


def _module_of(function: Any) -> str:
    return getattr(function, "__module__", None) or ""
