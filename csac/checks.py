"""Checks of user input that several packages share. Each raises InputError with a one-line message."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Mapping

import numpy as np

from csac.types import InputError

_CONTROLS = re.compile(rb"\\u(?:0000)?00(0[0-8bcef]|1[0-9a-f]|7f|[89][0-9a-f])|\x7f|\xc2[\x80-\x9f]", re.IGNORECASE)


def without_controls(content: bytes) -> bytes:
    """Return JSON or TOML without control characters: an untrusted file may hold a terminal's escape sequences."""
    return _CONTROLS.sub(rb"\\ufffd", content)


def check_whole(name: str, value: object, least: int, most: int) -> None:
    """Raise InputError unless the value is a whole number from `least` to `most`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise InputError(f"{name} must be a whole number of {least:,} or more, not {value!r:.40}")
    if value > most:
        raise InputError(f"{name} must be at most {most:,}")


def check_flag(name: str, value: object) -> None:
    """Raise InputError unless the value is True or False: "no" would count as true."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} is True or False, not {value!r:.40}")


def check_callable(name: str, value: object) -> None:
    """Raise InputError unless the value is None or callable."""
    if value is not None and not callable(value):
        raise InputError(f"{name} must be a function, not {value!r:.40}")


def check_path(name: str, value: object) -> None:
    """Raise InputError unless the value is a path without control characters."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{name} is a path such as 'runs/first', not {value!r:.40}")
    if not str(value) or re.search(r"[\x00-\x1f\x7f-\x9f]", str(value)):  # could control a terminal
        raise InputError(f"{name} cannot be {value!r:.40}: give a path such as 'runs/first'")


def check_arguments(name: str, value: object) -> None:
    """Raise InputError unless the value is None or keyword arguments."""
    if value is not None and not (isinstance(value, Mapping) and all(isinstance(key, str) for key in value)):
        raise InputError(f"{name} are keyword arguments such as {{'g': 9.0}}, not {value!r:.40}")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return "did you mean ...?" with the known word closest to `word`, or an empty string."""
    matches = closest(word, known)
    return f"did you mean {matches[0]}?" if matches else ""


def closest(word: str, known: Iterable[str], most: int = 1) -> list[str]:
    """Return the known words closest to `word`, ignoring case."""
    names = {name.lower().lstrip("-"): name for name in known}  # leading dashes would make all options similar
    word = word.lower().lstrip("-")
    completions = [name for name in names if len(word) >= 3 and name.startswith(word)]
    exact = [word] if word in names else completions if len(completions) == 1 else []
    return [names[match] for match in exact or difflib.get_close_matches(word, names, n=most)]
