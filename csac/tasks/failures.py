"""Format an environment's exceptions in one line, with the file and line that raised."""

from __future__ import annotations

import os
import re
import sysconfig
from collections.abc import Sequence
from pathlib import Path
from traceback import walk_tb

from csac.types import Failure

_CSAC = f"{Path(__file__).parents[1]}{os.sep}"
_PACKAGES = re.compile(r"\b(site|dist)-packages\b")
_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[@-~]|[\x00-\x1f\x7f-\x9f]")  # a terminal's colours and controls
_SKIPPED_PATHS = (sysconfig.get_path("stdlib"), "<frozen")


class EnvironmentFailure(Failure):
    """An environment raised, or returned a non-finite value or a wrong shape. The message is one line."""


def failure_of(call: str, error: BaseException) -> EnvironmentFailure:
    """Return the failure of an environment whose method `call` raised, even a panic of native code or `sys.exit`.

    Raise the error itself if it is a KeyboardInterrupt or GeneratorExit.
    """
    raise_interrupt(error)
    return EnvironmentFailure(f"{call} raised {raised(error)}")


def raise_interrupt(error: BaseException) -> None:
    """Re-raise a KeyboardInterrupt or GeneratorExit, which is no error of the environment."""
    if isinstance(error, KeyboardInterrupt | GeneratorExit):
        raise error


def raised(error: BaseException) -> str:
    """Return type, message and place of an error in one line; `place_of` chooses the place."""
    origin = error
    while origin.__cause__:  # Gymnasium raises its own error from that of a constructor
        origin = origin.__cause__
    places = [(frame.f_code.co_filename, line) for frame, line in walk_tb(origin.__traceback__)]
    return one_line(error) + place_of(places)


def place_of(places: Sequence[tuple[str, int]]) -> str:
    """Return the innermost frame in the user's code, or else in a library, as " (file.py:12)", or an empty string."""
    external = [place for place in places if _PACKAGES.search(place[0]) or not place[0].startswith(_SKIPPED_PATHS)]
    external = [place for place in external if not place[0].startswith(_CSAC)]
    in_user_code = [place for place in external if not _PACKAGES.search(place[0])]
    return "".join(f" ({Path(path).name}:{line})" for path, line in (in_user_code or external)[-1:])


def one_line(error: BaseException) -> str:
    """Return an error's type and message in one line."""
    text = message(error)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def message(error: BaseException) -> str:
    """Return an error's message in one line that is safe for every file and terminal."""
    text = str(error).encode("utf-8", "backslashreplace").decode()
    return " ".join(_ESCAPES.sub(" ", text).split())
