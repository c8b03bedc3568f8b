"""From command lines to dataclasses: tyro, with every complaint in one line."""

from __future__ import annotations

import dataclasses
import difflib
import io
import json
import os
import re
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar, get_type_hints

import tyro
from tyro.conf import DisallowNone, Positional
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

Command = TypeVar("Command")

# What tyro says, and how we say it; what is not here is passed on in tyro's own words.
_COMPLAINTS = (
    (r"Missing from .*?: (\S+).*", r"\1 is missing"),
    (r"Missing value for argument '(.*?)'.*", r"\1 needs a value"),
    (r"invalid choice '(.*?)' for argument '(.*?)'. Expected one of \((.*?),?\) ?\.?", r"\2: '\1' is not one of \3"),
    (r"Error parsing (--\S+): .*Got errors: .*: (.*)", r"\1: \2"),
    (r"Error parsing (--\S+): Could not find valid parse for arguments: (.*)", r"\1 does not take \2"),
    (r"Error parsing (--\S+): (.*)", r"\1: \2"),
    (r"Error parsing \S+: (.*)", r"\1"),
)

# What papers and other libraries call our options.
_CALLED_OTHERWISE = MappingProxyType(
    {
        "--tau": ("--relative-entropy-weight", "--target-rate"),
        "--sigma": ("--entropy-weight",),
        "--alpha": ("--entropy-weight",),
        "--ent-coef": ("--entropy-weight",),
        "--gamma": ("--discount",),
        "--polyak": ("--target-rate",),
        "--learning-starts": ("--warmup-steps",),
        "--buffer-size": ("--replay-size",),
        "--train-freq": ("--update-interval",),
        "--gradient-steps": ("--updates-per-step",),
        "--total-timesteps": ("--steps",),
    }
)


class HelpShown(Exception):
    """A command's help was asked for, and is printed."""


def parse(
    command: type[Command],
    arguments: list[str],
    program: str,
    elsewhere: Mapping[str, type[Any]] = MappingProxyType({}),
) -> Command:
    """Return the parsed arguments; print the help and raise HelpShown where it is asked for.

    `elsewhere` are the dataclasses that other values of --algorithm would have, so that their options are known.

    Raises:
        InputError: tyro's complaint as one line, or an option that there is not.
    """

    def run(**options: Any) -> Any:
        return tyro.cli(command, prog=program, args=arguments, registry=_numbers(), config=(DisallowNone,), **options)

    if {"-h", "--help"} & set(arguments):
        with suppress(BrokenPipeError, SystemExit):
            run()
        raise HelpShown
    complaint = io.StringIO()
    try:
        # With standard output elsewhere too, tyro takes it for one that cannot show boxes.
        with _wide_terminal(), redirect_stderr(complaint), redirect_stdout(io.StringIO()):
            parsed, unknown = run(return_unknown_args=True)
    except SystemExit:
        raise InputError(f"{_one_line(complaint.getvalue())} ({program} --help)") from None
    if unknown:
        raise InputError(f"{_unknown(unknown[0], command, elsewhere)} ({program} --help)")
    return parsed


def peek(arguments: list[str], option: str, default: Any) -> Any:
    """Return the value of an option that decides which other options there are."""
    value = default
    for index, word in enumerate(arguments):
        if word == option and index + 1 < len(arguments):
            value = arguments[index + 1]
        elif word.startswith(option + "="):
            value = word.partition("=")[2]
    return value


def options_in(arguments: list[str]) -> list[str]:
    """Return the names of the options that are given, as fields are called: `--target-rate=1` is target_rate."""
    return [word.partition("=")[0][2:].replace("-", "_") for word in arguments if word.startswith("--")]


def json_object(option: str, text: str) -> dict[str, Any]:
    """Return the JSON object that an option was given. Raises InputError where it is none."""
    try:
        value = json.loads(text)
    except ValueError as error:
        raise InputError(f"{option} is not JSON ({error}): write it as '{{\"name\": 1.5}}'") from None
    if not isinstance(value, dict):
        raise InputError(f"{option} takes a JSON object such as '{{\"name\": 1.5}}', not {text}")
    return value


def nearest(word: str, known: Iterable[str]) -> str:
    """Return "; did you mean ...?" with what resembles `word` most, or nothing."""
    matches = difflib.get_close_matches(word, list(known), n=2)
    return f"; did you mean {' or '.join(matches)}?" if matches else ""


def _numbers() -> ConstructorRegistry:
    """Return how numbers are read: 1_000_000 and 1e6 are whole numbers too."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        if info.type not in (int, float):
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar="N" if info.type is int else "X",
            instance_from_str=lambda words: _whole_number(words[0]) if info.type is int else _number(words[0]),
            is_instance=lambda value: isinstance(value, int | info.type),
            str_from_instance=lambda value: [f"{value:_}" if info.type is int else str(value)],
        )

    return registry


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{text!r} is not a number") from None


def _whole_number(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        value = _number(text)
    if not value.is_integer():
        raise ValueError(f"{text!r} is not a whole number")
    return int(value)


def _one_line(complaint: str) -> str:
    """Return what tyro complains of in one line. It writes a title, a rule, what is wrong, a rule, and more."""
    sections = re.split(r"^ *-{5,} *$", complaint, flags=re.MULTILINE)
    text = " ".join(sections[1 if len(sections) > 1 else 0].split())
    for pattern, template in _COMPLAINTS:
        if match := re.fullmatch(pattern, text):
            return _with_choices_in_order(match.expand(template))
    return text


def _with_choices_in_order(text: str) -> str:
    """Put what may be chosen in an order, which tyro does not, without None, which leaving the option out chooses."""
    told, between, choices = text.partition(" is not one of ")
    return told + between + ", ".join(sorted({*choices.split(", ")} - {"'None'"})) if between else text


def _unknown(argument: str, command: type[Any], elsewhere: Mapping[str, type[Any]]) -> str:
    if not argument.startswith("-"):
        return f"there is no place for {argument!r}"
    option = argument.partition("=")[0].replace("_", "-")
    for name, kind in elsewhere.items():
        if option in _options(kind):
            return f"{option} is an option of {name}, which --algorithm {name} chooses"
    known = _options(command)
    meant = [name for name in _CALLED_OTHERWISE.get(option, ()) if name in known]
    return f"there is no option {option}" + (f"; it is {' or '.join(meant)} here" if meant else nearest(option, known))


def _options(kind: type[Any]) -> list[str]:
    """Return the options that tyro makes of a dataclass; those of a dataclass within have no prefix."""
    names: list[str] = []
    annotations = get_type_hints(kind, include_extras=True)
    for item in dataclasses.fields(kind):
        if dataclasses.is_dataclass(item.default):
            names += _options(type(item.default))
            continue
        extras = getattr(annotations[item.name], "__metadata__", ())
        if Positional[Any].__metadata__[0] not in extras:
            own = next((extra.name for extra in extras if isinstance(getattr(extra, "name", None), str)), item.name)
            names.append("--" + own.replace("_", "-"))
    return names


@contextmanager
def _wide_terminal() -> Iterator[None]:
    """Keep tyro from breaking its lines, which would break what they quote."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
