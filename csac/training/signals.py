"""Signals during training: the first SIGINT or SIGTERM requests a stop, the second interrupts at once."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from csac.record.run import StorageFailure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from csac.record.sets import RunSet


class Interrupted(KeyboardInterrupt):
    """Training was stopped by a signal, SIGINT or SIGTERM, after saving everything that can be saved.

    `can_resume` says whether `resume` can continue it.
    """

    def __init__(self, runs: RunSet, signal_number: int) -> None:
        saved = [run.manifest.last_checkpoint for run in runs.runs if run.manifest.state == "interrupted"]
        can_resume = bool(runs.config.checkpoint_interval)
        where = f"saved in {runs.path}" if all(saved) else f"{runs.path} has no checkpoint of every seed yet"
        super().__init__(f"stopped by {signal.Signals(signal_number).name}; {where}")
        self.runs, self.signal_number, self.can_resume = runs, signal_number, can_resume


class StopRequest:
    """A handler of SIGINT and SIGTERM that records the first; the second raises KeyboardInterrupt(its number)."""

    def __init__(self, tell: Callable[[str], None] | None = None) -> None:
        self.received: list[int] = []
        self._tell, self._process = tell, os.getpid()

    def __call__(self, number: int, _: Any = None) -> None:
        """Handle a signal."""
        if os.getpid() != self._process:
            _end_helper(number)
            return
        if self.received:
            raise KeyboardInterrupt(number)
        self.received.append(number)
        if self._tell:
            self._tell("stopping at the next step where all can be saved; signal again to leave at once")

    def is_set(self) -> bool:
        """Return whether a signal has come."""
        return bool(self.received)


@contextmanager
def stop_requested(tell: Callable[[str], None] | None = None) -> Iterator[StopRequest]:
    """Yield the stop request that SIGINT and SIGTERM set; SIGHUP is ignored, as a run outlives its terminal.

    A nested call yields the outer request: a signal to a study stops every run in it. `tell` is called with a line for
    the user. Outside of the main thread no signal is handled.
    """
    outer = signal.getsignal(signal.SIGINT)
    request = outer if isinstance(outer, StopRequest) else StopRequest(tell)
    with _handled(request):
        yield request


@contextmanager
def leaving_at_once() -> Iterator[None]:
    """Let SIGINT and SIGTERM end this process at once, with their exit code and a message, while nothing needs saving.

    An exception would not always arrive: imports and finalisers swallow some.
    """
    process = os.getpid()

    def leave(number: int, _: Any) -> None:
        if os.getpid() != process:
            _end_helper(number)
        with suppress(OSError):
            os.write(2, f"csac: stopped by {signal.Signals(number).name} before training\n".encode())
        os._exit(128 + number)

    with _handled(leave):
        yield


def _end_helper(number: int) -> None:
    """End a helper process of the task, which inherited this handler, as the signal does by default."""
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


@contextmanager
def _handled(handler: Callable[[int, Any], None]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    before[signal.SIGHUP] = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def storage_failures(path: Path) -> Iterator[None]:
    """Raise StorageFailure if a file below this folder can no longer be written."""
    try:
        yield
    except OSError as error:
        # A ConnectionError means that the parent is gone; an error without strerror is a library's, such as a task's.
        is_other = isinstance(error, ConnectionError) or not error.strerror
        if is_other or not str(error.filename or path).startswith(str(path)):
            raise
        advice = "once that is mended, it can be resumed"
        raise StorageFailure(f"{path} cannot be written: {error.strerror}; {advice}") from error
