"""How an environment's errors are told: in one line, with the place in the code that raised."""

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
_PASSED_OVER = (sysconfig.get_path("stdlib"), "<frozen")


class EnvironmentFailure(Failure):
    """An environment raised, or gave what is not a finite number of the right shape. The message is one line."""


def failure_of(call: str, error: BaseException) -> EnvironmentFailure:
    """Return the failure of an environment whose `call` raised, be it a panic of native code or `sys.exit`.

    Raises the error itself if it is a KeyboardInterrupt or GeneratorExit.
    """
    raise_interrupt(error)
    return EnvironmentFailure(f"{call} raised {raised(error)}")


def raise_interrupt(error: BaseException) -> None:
    """Raise an error again that is none of the code that raised it: KeyboardInterrupt or GeneratorExit."""
    if isinstance(error, KeyboardInterrupt | GeneratorExit):
        raise error


def raised(error: BaseException) -> str:
    """Return an error's type, message and place in one line: the last frame of the user's code, else of a library's."""
    origin = error
    while origin.__cause__:  # Gymnasium raises another one from what a constructor raised
        origin = origin.__cause__
    places = [(frame.f_code.co_filename, line) for frame, line in walk_tb(origin.__traceback__)]
    return one_line(error) + place_of(places)


def place_of(places: Sequence[tuple[str, int]]) -> str:
    """Return the innermost of files and lines that is the user's, else a library's, as " (file.py:12)", or nothing."""
    foreign = [place for place in places if _PACKAGES.search(place[0]) or not place[0].startswith(_PASSED_OVER)]
    foreign = [place for place in foreign if not place[0].startswith(_CSAC)]
    own = [place for place in foreign if not _PACKAGES.search(place[0])]
    return "".join(f" ({Path(path).name}:{line})" for path, line in (own or foreign)[-1:])


def one_line(error: BaseException) -> str:
    """Return an error's type and message in one line."""
    text = message(error)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def message(error: BaseException) -> str:
    """Return an error's message in one line that every file and terminal takes."""
    try:
        text = str(error)
    except Exception as unsaid:
        text = f"(its message cannot be had: {type(unsaid).__name__})"
    return " ".join(_ESCAPES.sub(" ", text.encode("utf-8", "backslashreplace").decode()).split())
