"""Check the values and names of hyperparameters; a field declares its range as `Annotated[float, RATE]`."""

from __future__ import annotations

import dataclasses
import functools
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from csac.checks import did_you_mean
from csac.synonyms import argument_hint
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

Algorithm = TypeVar("Algorithm")


class Limit(NamedTuple):
    """A condition on a value, and its wording after "must be" in an error message."""

    accepts: Callable[[Any], bool]
    words: str


POSITIVE = Limit(lambda value: value > 0, "more than 0")
NOT_NEGATIVE = Limit(lambda value: value >= 0, "0 or more")
COUNT = Limit(lambda value: value >= 1, "at least 1")
RATE = Limit(lambda value: 0 < value <= 1, "more than 0 and at most 1")
SHARE = Limit(lambda value: 0 <= value <= 1, "from 0 to 1")
DISCOUNT = Limit(lambda value: 0 <= value < 1, "at least 0 and less than 1")
WIDTHS = Limit(lambda widths: all(width >= 1 for width in widths), "whole numbers of at least 1")

# A hyperparameter that does nothing unless another one has this value.
NEEDS = {
    "reference_period": ("reference_policy", "periodic"),
    "reference_rate": ("reference_policy", "average"),
    "initial_entropy_weight": ("entropy_weight", "auto"),
    "target_entropy": ("entropy_weight", "auto"),
    "target_entropy_per_dimension": ("entropy_weight", "auto"),
    "weight_learning_rate": ("entropy_weight", "auto"),
}

# Compiled programs count and compute in 32 bits.
LARGEST_INTEGER, LARGEST_FLOAT = 2**31 - 1, float(np.finfo(np.float32).max)


def check_hyperparameters(algorithm: Any) -> None:
    """Convert an algorithm's fields to plain Python values: NumPy scalars, lists, and whole numbers in float fields.

    Raises InputError for the first field outside its range or choices, with its value and what is allowed.
    """
    hints = get_type_hints(type(algorithm), include_extras=True)
    for field in dataclasses.fields(algorithm):
        value = getattr(algorithm, field.name)
        value = value.item() if isinstance(value, np.generic) else value
        try:
            object.__setattr__(algorithm, field.name, _convert(value, hints[field.name]))
        except ValueError as error:
            raise InputError(f"{field.name} must be {error}, not {value!r}") from None


def without_effect(algorithm: Any) -> dict[str, str]:
    """Return the hyperparameters that do nothing, with the setting that makes it so, such as "entropy_weight 0.2"."""
    return {
        name: f"{other} {getattr(algorithm, other)}"
        for name, (other, value) in NEEDS.items()
        if hasattr(algorithm, name) and getattr(algorithm, other, value) != value
    }


def reject_unknown_names(algorithm: type[Algorithm]) -> type[Algorithm]:
    """Make an algorithm class raise InputError for an unknown hyperparameter, and return it."""
    kind: Any = algorithm
    known, init = [field.name for field in dataclasses.fields(kind)], kind.__init__

    @functools.wraps(init)
    def checked_init(self: Any, *values: Any, **named: Any) -> None:
        for name in named:
            if name not in known:
                hint = argument_hint(name, known) or did_you_mean(name, known)
                raise InputError(f"{kind.__name__} has no hyperparameter {name!r}{hint and f': {hint}'}")
        init(self, *values, **named)

    kind.__init__ = checked_init
    return algorithm


def _convert(value: Any, hint: Any) -> Any:
    """Return a value as a plain Python value of the hinted type. Raises ValueError with what it must be."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return None if value is None and NoneType in arguments else _convert_union(value, arguments)
    if origin is Annotated:
        kind, *limits = arguments
        value = _convert(value, kind)
        # Limits apply to the value in 32 bits, where 1 - 1e-9 is 1.
        rounded = float(np.float32(value)) if kind is float else value
        for limit in limits:
            if not limit.accepts(rounded):
                raise ValueError(limit.words)
        return value
    if origin is tuple:
        if not isinstance(value, tuple | list):
            raise ValueError("a tuple of whole numbers" if arguments[0] is int else "a tuple")
        return tuple(_convert(one, arguments[0]) for one in value)
    if origin is Literal and (not isinstance(value, str) or value not in arguments):
        raise ValueError(f"{'one of ' * (len(arguments) > 1)}{', '.join(arguments)}")
    if hint is bool and not isinstance(value, bool):
        raise ValueError("true or false")
    if hint is float:
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        if not (is_number and -LARGEST_FLOAT <= value <= LARGEST_FLOAT):  # pyright: ignore[reportOperatorIssue]
            raise ValueError("a finite number")
        return float(value)
    if hint is int:
        if isinstance(value, bool) or not isinstance(value, Integral):
            raise ValueError("a whole number")
        if (number := int(value)) > LARGEST_INTEGER:
            raise ValueError(f"at most {LARGEST_INTEGER:,}")
        return number
    return value


def _convert_union(value: Any, kinds: tuple[Any, ...]) -> Any:
    problems = []
    for kind in kinds:
        if kind is not NoneType:
            try:
                return _convert(value, kind)
            except ValueError as error:
                problems.append(str(error))
    raise ValueError(", or ".join(problems))
