"""What a hyperparameter is called here that an algorithm does not have by that name."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, TypeVar

from csac.checks import did_you_mean
from csac.synonyms import called_in_python
from csac.types import InputError

Algorithm = TypeVar("Algorithm")


def names_checked(algorithm: type[Algorithm]) -> type[Algorithm]:
    """Return the algorithm, which from now on refuses a hyperparameter that it does not have with InputError.

    What a dataclass raises by itself, a TypeError, does not say what the hyperparameter is called here.
    """
    kind: Any = algorithm
    known, init = [field.name for field in dataclasses.fields(kind)], kind.__init__

    @functools.wraps(init)
    def checked_init(self: Any, *values: Any, **named: Any) -> None:
        for name in named:
            if name not in known:
                hint = called_in_python(name, known) or did_you_mean(name, known)
                raise InputError(f"{kind.__name__} has no hyperparameter {name!r}{hint and f': {hint}'}")
        init(self, *values, **named)

    kind.__init__ = checked_init
    return algorithm
