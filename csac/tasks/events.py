"""Extract the events that a user requested by name from an episode's `info` dicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


class EpisodeEvents:
    """The events of one episode: numbers in the last step's `info`, or over all steps as `NAME:sum` or `NAME:mean`.

    `sums` are those of an episode in progress, for resuming it.
    """

    def __init__(self, names: Sequence[str], sums: Mapping[str, float] | None = None) -> None:
        self._names = names
        self._summed = [name for name in names if name.endswith((":sum", ":mean"))]
        self.sums: dict[str, float] = dict(sums or {})

    def add(self, info: Mapping[str, Any]) -> None:
        """Add the `info` of a step to the sums."""
        for name in self._summed:
            value = number(info.get(name.rpartition(":")[0]))
            if value is not None:
                self.sums[name] = self.sums.get(name, 0.0) + float(value)

    def of(self, info: Mapping[str, Any], length: int) -> dict[str, bool | float | None]:
        """Return the events by name after `length` steps, the last of which returned `info`; None for missing ones."""
        events: dict[str, bool | float | None] = {name: number(info.get(name)) for name in self._names}
        for name in self._summed:
            if name in self.sums:
                events[name] = self.sums[name] / (length if name.endswith(":mean") else 1)
        return events


def info_name(event: str) -> str:
    """Return the key in `info` of an event: its name without `:sum` or `:mean`."""
    return event.rpartition(":")[0] if event.endswith((":sum", ":mean")) else event


def number(value: Any) -> bool | float | None:
    """Return a boolean or a finite number from `info` as a Python scalar, and None for anything else."""
    array = numbers(value)
    return None if array is None or array.size != 1 else array.item()


def numbers(value: Any) -> np.ndarray | None:
    """Return booleans or finite numbers as an array, and None for anything else."""
    try:
        array = np.asarray(value)
    except Exception:  # `info` may hold anything
        return None
    is_number = array.size > 0 and array.dtype.kind in "buif" and np.isfinite(array).all()
    return array if is_number else None
