"""Parse command lines into dataclasses with tyro, and reduce its error messages to one line."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import re
from contextlib import redirect_stderr, redirect_stdout, suppress
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints
from unittest.mock import patch

import tyro
from tyro.conf import DisallowNone
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from csac.checks import did_you_mean
from csac.synonyms import option_hint
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

Command = TypeVar("Command")


class HelpShown(Exception):
    """Raised once the help of a command has been printed."""


def parse(
    command: type[Command], words: list[str], program: str, hint_for: Callable[[str], str] = lambda option: ""
) -> Command:
    """Parse `words` into a `command`; if they ask for help, print it and raise HelpShown.

    `hint_for(option)` returns a hint for an option that the command lacks, or an empty string.
    """
    rules: Any = {"prog": program, "args": words, "registry": _numbers(), "config": (DisallowNone,)}
    if {"-h", "--help"} & {*words}:
        with suppress(BrokenPipeError, SystemExit):
            tyro.cli(command, **rules)
        raise HelpShown
    complaint = io.StringIO()
    try:
        # A wide terminal keeps tyro from wrapping the words that it quotes.
        with patch.dict(os.environ, COLUMNS="10000"), redirect_stderr(complaint), redirect_stdout(io.StringIO()):
            return tyro.cli(command, **rules)
    except SystemExit:
        raise InputError(f"{_one_line(complaint.getvalue(), command, hint_for)} ({program} --help)") from None


def value_of(words: list[str], option: str) -> Any:
    """Return the value of an option before parsing, since it decides which other options exist; None without it."""
    value = None
    for word, following in zip_longest(words, words[1:]):
        if word == option and following is not None:
            value = following
        elif word.startswith(f"{option}="):
            value = word.partition("=")[2]
    return value


def chosen_algorithm(words: list[str], begun_with: str | None) -> tuple[str, Any]:
    """Return the name and the class of the algorithm: from the words, else from the runs of `--from`, else CSAC.

    A `module:Class` is imported only if the words name it, never because a run's manifest does.
    """
    from csac.algorithms import ALGORITHMS

    typed = value_of(words, "--algorithm")
    name = typed or begun_with or "csac"
    if name in ALGORITHMS:
        return name, ALGORITHMS[name]
    if ":" not in name:
        hint = did_you_mean(name, ALGORITHMS) or f"choose {' or '.join(ALGORITHMS)}, or module:Class"
        raise InputError(f"no algorithm is called {name!r}: {hint}")
    if not typed:
        raise InputError(f"{value_of(words, '--from')} was trained by {name}: to run its code, add --algorithm {name}")
    from csac.training.config import class_typed  # imports Gymnasium

    return name, class_typed(name)


JSON = PrimitiveConstructorSpec(
    nargs=1,
    metavar="JSON",
    instance_from_str=lambda words: json.loads(words[0]),
    is_instance=lambda value: isinstance(value, dict),
    str_from_instance=lambda value: [json.dumps(value)],
)


def _numbers() -> ConstructorRegistry:
    """Return tyro's rule for numbers: 1_000_000 and 1e6 count as integers too."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        if info.type not in (int, float):
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar="N" if info.type is int else "X",
            instance_from_str=lambda words: _whole(words[0]) if info.type is int else float(words[0]),
            is_instance=lambda value: isinstance(value, int | info.type),
            str_from_instance=lambda value: [f"{value:_}" if info.type is int else str(value)],
        )

    return registry


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        if not float(text).is_integer():
            raise
        return int(float(text))


def options_of(kind: type[Any]) -> set[str]:
    """Return the options that tyro derives from a dataclass; those of a nested dataclass have no prefix."""
    options, hints = set(), get_type_hints(kind, include_extras=True)
    for item in dataclasses.fields(kind):
        given = [name for extra in get_args(hints[item.name])[1:] if (name := getattr(extra, "name", None))]
        name = given[0] if given else item.name.replace("_", "-")
        options |= options_of(type(item.default)) if dataclasses.is_dataclass(item.default) else {f"--{name}"}
    return options


def _one_line(complaint: str, command: type[Any], hint_for: Callable[[str], str]) -> str:
    """Return tyro's error in one line. It writes a title, the error and suggestions, with rules between them."""
    _, what, more, *_ = [*re.split(r"^ *-{5,} *$", complaint, flags=re.MULTILINE), "", ""]
    what = " ".join(what.split())
    unknown = re.match(r"Unrecognized options: (.+?)(, |$)", what)
    if not unknown:
        what = re.sub(r"^Error parsing ([A-Za-z]\w*: )?", "", what)
        what = re.sub(r"no type matching (\S+) could be instantiated from \['(.*?)'\].*", r"give \1, not \2", what)
        return re.sub(r"^Missing from [^:]*: (\S+).*", r"\1 is missing", what)
    option = unknown[1].partition("=")[0].replace("_", "-") if unknown[1].startswith("-") else unknown[1]
    meant = re.findall(r"^ *(--[a-z-]+)", more, re.MULTILINE)[:2]
    hint = option_hint(option, options_of(command)) or hint_for(option)
    hint = hint or (f"did you mean {' or '.join(meant)}?" if meant else "")
    return f"there is no {option} here" + (f": {hint}" if hint else "")
