"""From command lines to dataclasses: tyro, with every complaint in one line."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import re
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar, get_type_hints

import tyro
from tyro.conf import DisallowNone, FlagCreatePairsOff, Positional
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from csac.checks import did_you_mean
from csac.synonyms import called_here
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

# What is written otherwise here, and how, where the command has the options that are named.
_MISWRITTEN = (
    (r"(--\S*hidden-sizes)", r"\1 needs at least one number, as 256 256"),
    (r"(--\S*hidden-sizes) .*[,[(].*", r"write the numbers with blanks between: \1 400 300"),
    (r"--seeds (\S*,.*|\d+( \d+)+)", r"--seeds is how many: --seeds 3"),
    (r"--perturb (\S+=\S+) (\S+=\S+).*", r"write --perturb before each: --perturb \1 --perturb \2"),
    (r"--device cuda.*", r"--device takes cpu or gpu (cuda is gpu here)"),
    (r"(--(?:relative-)?entropy-weight) auto\w+.*", r"write \1 auto"),
    (r"--reference-policy previous", r"write --reference-policy average --reference-rate 1"),
    (r"--reference-policy algorithm1", r"write --reference-policy periodic --reference-period 1"),
)

_PLACES = ("--directory", "--results", "--from")  # of folders that are written to, or learnt from

_DASHED_NUMBER = re.compile("-(inf(inity)?|nan)", re.IGNORECASE)


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
    if mistake := _mistake(arguments, command) or _stranger(arguments, command, elsewhere):
        raise InputError(f"{mistake} ({program} --help)")
    complaint = io.StringIO()
    try:
        # With standard output elsewhere too, tyro takes it for one that cannot show boxes.
        with _wide_terminal(), redirect_stderr(complaint), redirect_stdout(io.StringIO()):
            parsed, unknown = run(return_unknown_args=True)
    except SystemExit:
        told = _one_line(complaint.getvalue())
        told += _swallowed(arguments) if told.endswith(" is missing") else ""
        raise InputError(f"{told} ({program} --help)") from None
    if unknown:
        raise InputError(
            f"{_unknown(unknown[0], command, elsewhere, _option_before(unknown[0], arguments))} ({program} --help)"
        )
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
    hint = did_you_mean(word, known, most=2)
    return f"; {hint}" if hint else ""


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


def _mistake(arguments: list[str], command: type[Any]) -> str | None:
    """Return how an option is called or written here that is given as other libraries have it."""
    known = _options(command)
    for words in re.split(r"\0(?=--)", "\0".join(arguments)):
        option, *values = re.split(r"[=\0]", words, maxsplit=1)
        option, text = option.replace("_", "-"), " ".join(values).replace("\0", " ")
        if option not in known and (hint := called_here(option, known)):
            return f"there is no option {option}; {hint}"
        if option in _PLACES and values and not values[0].partition("\0")[0]:
            return f"{option} was given an empty value, which would be the folder that you are in: write . for that"
        if known.get(option) and text.split(" ")[0].lower() in ("true", "false"):
            return f"{option} takes no value; {known[option]}"
        for pattern, template in _MISWRITTEN:
            match = re.fullmatch(pattern, f"{option} {text}".strip())
            if match and {option, *re.findall(r"--[a-z-]+", said := match.expand(template))} <= known.keys():
                return said
    return None


def _swallowed(arguments: list[str]) -> str:
    """Return which option took what a command misses, where one that takes several values stands before it."""
    taken = re.search(r"(--[^\0]*hidden[-_]sizes)((?:\0[\d_]+)+)\0([^-\d\0][^\0]*)", "\0".join(arguments))
    return f": {taken[1]} took {taken[3]}, so write it before the options" if taken else ""


def _stranger(arguments: list[str], command: type[Any], elsewhere: Mapping[str, type[Any]]) -> str | None:
    """Return what is wrong with the first option that there is not, which tyro tells last of all that is wrong."""
    own, before = _options(command), ""
    known = own | {f"--no-{option[2:]}": "" for option, off in own.items() if off.startswith("--no-")}
    for word in arguments:
        option = word.partition("=")[0].replace("_", "-")
        if word == "--":
            break
        if re.match(r"--?[A-Za-z]", word) and option not in known and not _DASHED_NUMBER.fullmatch(word):
            if own.get(before) == "" and (" " in option or not word.startswith("--")):
                return f"{before} needs a value; one that begins with a dash is written {before}={word}"
            return _unknown(word, command, elsewhere)
        before = option
    return None


def _option_before(argument: str, arguments: list[str]) -> str:
    """Return the option that an argument stands behind, where there is nothing between the two."""
    before = arguments[arguments.index(argument) - 1] if argument in arguments[1:] else ""
    return before.replace("_", "-") if before.startswith("--") else ""


def _unknown(argument: str, command: type[Any], elsewhere: Mapping[str, type[Any]], before: str = "") -> str:
    known = _options(command)
    if not argument.startswith("-"):
        if known.get(before):
            return f"there is no place for {argument!r}: {before} takes no value"
        several = "" if "--env-kwargs" not in known else ": one task a run; several: csac study"
        return f"there is no place for {argument!r}{several}"
    option = argument.partition("=")[0].replace("_", "-")
    if names := [name for name, kind in elsewhere.items() if option in _options(kind)]:
        if "--algorithm" not in known:
            return f"a run keeps its hyperparameters: begin another with csac train TASK --from DIR {option} X"
        *most, last = names
        if most:
            return f"{option} is an option of {', '.join(most)} and {last}, which --algorithm chooses"
        return f"{option} is an option of {last}, which --algorithm {last} chooses"
    return f"there is no option {option}{nearest(option, known)}"


def _options(kind: type[Any]) -> dict[str, str]:
    """Return the options that tyro makes of a dataclass, each with what turns it off where it is a flag.

    Those of a dataclass within have no prefix.
    """
    names: dict[str, str] = {}
    annotations = get_type_hints(kind, include_extras=True)
    for item in dataclasses.fields(kind):
        if dataclasses.is_dataclass(item.default):
            names |= _options(type(item.default))
            continue
        hint = annotations[item.name]
        extras = getattr(hint, "__metadata__", ())
        if Positional[Any].__metadata__[0] not in extras:
            own = next((extra.name for extra in extras if isinstance(getattr(extra, "name", None), str)), item.name)
            option = own.replace("_", "-")
            off = {bool: f"--no-{option} turns it off", FlagCreatePairsOff[bool]: "without it, it is off"}
            names[f"--{option}"] = off.get(hint, "")
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
