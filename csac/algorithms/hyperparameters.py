"""The ranges that hyperparameters may take: each stands beside its field, as `Annotated[float, RATE]`."""

from __future__ import annotations

import dataclasses
import math
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np

from csac.synonyms import written_in_python
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence


class Limit(NamedTuple):
    """What a value must fulfil, and how to say so after "must be"."""

    accepts: Callable[[Any], bool]
    words: str


POSITIVE = Limit(lambda value: value > 0, "more than 0")
NOT_NEGATIVE = Limit(lambda value: value >= 0, "0 or more")
COUNT = Limit(lambda value: value >= 1, "at least 1")
RATE = Limit(lambda value: 0 < value <= 1, "more than 0 and at most 1")
SHARE = Limit(lambda value: 0 <= value <= 1, "from 0 to 1")
DISCOUNT = Limit(lambda value: 0 <= value < 1, "at least 0 and less than 1")
WIDTHS = Limit(
    lambda value: isinstance(value, tuple) and all(_is_whole(width) and width >= 1 for width in value),
    "a tuple of whole numbers of at least 1",
)


LARGEST = 2**31 - 1  # compiled programs count in 32 bits
# They compute in 32 as well: what is smaller than the first is 0 there.
SMALLEST_FLOAT, LARGEST_FLOAT = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)


def check_hyperparameters(algorithm: Any, incompatible: Iterable[tuple[Mapping[str, Sequence[Any]], str]] = ()) -> None:
    """Take an algorithm's fields as plain Python values, and refuse one outside its range or its choices.

    NumPy's scalars become Python's, lists tuples, and a whole number a float where that is asked for, so that what is
    recorded does not depend on how it was given.
    `incompatible` are values of fields that make no sense together, and why.

    Raises:
        InputError: the first such field, its value and what it may be; fields that make no sense together; a replay
            that holds less than a batch; or a batch of one to normalise over.
    """
    hints = get_type_hints(type(algorithm), include_extras=True)
    for field in dataclasses.fields(algorithm):
        value = _plain(getattr(algorithm, field.name))
        if words := _what_it_must_be(value, hints[field.name]):
            hint = written_in_python(field.name, value)
            raise InputError(f"{field.name} must be {words}, not {value!r}{hint and f': {hint}'}")
        object.__setattr__(algorithm, field.name, float(value) if _is_float(value, hints[field.name]) else value)
    for values, why in incompatible:
        if all(getattr(algorithm, name) in refused for name, refused in values.items()):
            told = " with ".join(f"{name} {getattr(algorithm, name)}" for name in values)
            raise InputError(f"{told} makes no sense: {why}")
    if getattr(algorithm, "critic_normalisation", "none") == "batch" and algorithm.batch_size == 1:
        raise InputError("critic_normalisation batch needs a batch_size of at least 2: one transition has no spread")
    if hasattr(algorithm, "replay_size") and algorithm.replay_size < algorithm.batch_size:
        raise InputError(
            f"replay_size must be at least batch_size, {algorithm.batch_size:,}, not {algorithm.replay_size:,}"
        )


def _is_one_of(value: Any, choices: tuple[str, ...]) -> bool:
    return isinstance(value, str) and value in choices  # an array's comparison has no truth value


def _what_it_must_be(value: Any, hint: Any) -> str | None:
    """Say what a value of this type and these limits must be, or return None where it is."""
    if get_origin(hint) in (Union, UnionType) and NoneType not in get_args(hint):
        found = [_what_it_must_be(value, kind) for kind in get_args(hint)]
        return None if None in found else ", or ".join(filter(None, found))
    hint, *limits = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    if get_origin(hint) is Literal and not _is_one_of(value, get_args(hint)):
        return f"{'one of ' * (len(get_args(hint)) > 1)}{', '.join(get_args(hint))}"
    if hint is bool and not isinstance(value, bool):
        return "true or false"
    if hint is int and not _is_whole(value):
        return "a whole number"
    if hint is int and value > LARGEST:
        return f"at most {LARGEST:,}"
    if hint in (float, float | None) and not (value is None and hint == float | None):
        if not _is_finite(value):
            return "a finite number"
        if value and not SMALLEST_FLOAT <= abs(value) <= LARGEST_FLOAT:
            return f"a number that 32 bits can hold, {SMALLEST_FLOAT:.1e} to {LARGEST_FLOAT:.1e}"
        if words := _broken(limits, value):
            return words
        return (words := _broken(limits, float(np.float32(value)))) and f"{words} in 32 bits"
    return _broken(limits, value)


def _broken(limits: Sequence[Limit], value: Any) -> str | None:
    return next((limit.words for limit in limits if not limit.accepts(value)), None)


def _is_float(value: Any, hint: Any) -> bool:
    """Whether it is a number where floats belong, and whole numbers alone do not."""
    hint, *_ = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    kinds = {kind for part in (get_args(hint) or (hint,)) for kind in (part, *get_args(part))}
    return isinstance(value, Real) and not isinstance(value, bool) and float in kinds


def _plain(value: Any) -> Any:
    if isinstance(value, tuple | list):
        return tuple(_plain(part) for part in value)
    return value.item() if isinstance(value, np.generic) else value


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _is_finite(value: Any) -> bool:
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number that no float reaches
        return False
