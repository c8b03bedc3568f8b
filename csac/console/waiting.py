"""Measure the speed of a long operation and show its progress."""

from __future__ import annotations

import time
from collections import deque
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING

from csac.console.tables import duration

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.console import Console

SECONDS_OF_SILENCE = 30.0  # between two lines without a terminal
SPEED_WINDOW = 20.0  # seconds over which the shown speed is averaged


class Speed:
    """Steps per second over the last `SPEED_WINDOW` seconds, or since the previous sample if that is older."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._samples: deque[tuple[float, int]] = deque()

    def add(self, total: int) -> None:
        """Record the total number of steps so far."""
        now = self._clock()
        self._samples.append((now, total))
        while len(self._samples) > 2 and now - self._samples[1][0] > SPEED_WINDOW:
            self._samples.popleft()

    def per_second(self) -> float | None:
        """Return the speed, or None while there are too few samples."""
        if len(self._samples) < 2:
            return None
        (begin, first), (end, last) = self._samples[0], self._samples[-1]
        return (last - first) / (end - begin) if end > begin and last > first else None


@contextmanager
def progress_shown(
    console: Console, doing: str, unit: str, clock: Callable[[], float] = time.monotonic
) -> Iterator[Callable[[int, int], None]]:
    """Show the progress of an operation; yield a function to call with the amount done and the total.

    On a terminal this is one updating line with the time left; elsewhere a line every `SECONDS_OF_SILENCE`.
    """
    speed, last_output = Speed(clock), clock()
    speed.add(0)
    status = console.status(doing) if console.is_interactive else None

    def show(done: int, total: int) -> None:
        nonlocal last_output
        speed.add(done)
        pace = speed.per_second()
        left = f", {duration((total - done) / pace)} left" if pace and done < total else ""
        text = f"{doing}: {done:,} of {total:,} {unit}{left}"
        if status:
            status.update(text)
        elif clock() - last_output >= SECONDS_OF_SILENCE:
            console.print(text, soft_wrap=True)
            last_output = clock()

    with status or nullcontext():
        yield show
