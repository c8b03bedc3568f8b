"""Detect that training hangs inside an environment, and report where."""

from __future__ import annotations

import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from csac.tasks.failures import place_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType

SECONDS = 180.0  # without a step, in a call of an environment, before a note
_ENVIRONMENTS = {
    str(Path(__file__).parents[1] / name) for name in ("tasks/environment.py", "tasks/workers.py", "evaluation/pool.py")
}


@contextmanager
def stalls_noted(progress: Callable[[], int], note: Callable[[str], None], who: str) -> Iterator[None]:
    """Call `note` once each time this thread hangs in an environment: `progress`, its step, is the same for minutes.

    `who` names the seed. Nothing is stopped: a real robot may be waiting for somebody.
    """
    is_over, thread = threading.Event(), threading.get_ident()

    def watch() -> None:
        last_step, is_noted = progress(), False
        while not is_over.wait(SECONDS):
            step = progress()
            is_noted = is_noted and step == last_step
            place = _place_in_environment(sys._current_frames().get(thread)) if step == last_step else None
            if place is not None and not is_noted:  # of an environment in another process it is ""
                note(f"{who}: at step {step:,} for {SECONDS / 60:.0f} minutes, inside the environment{place}")
                is_noted = True
            last_step = step

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        is_over.set()
        watcher.join()


def _place_in_environment(frame: FrameType | None) -> str | None:
    """Return the line of user code that runs, as " (file.py:12)", or None outside of an environment."""
    places = []
    while frame:
        places.append((frame.f_code.co_filename, frame.f_lineno))
        frame = frame.f_back
    calls = [index for index, (path, _) in enumerate(places) if path in _ENVIRONMENTS]
    return place_of(places[calls[0] :: -1]) if calls else None
