"""What ends a run from outside: signals, and a disk that takes no more."""

from __future__ import annotations

import errno
import signal
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from csac.record.run import RunDirectory, StorageFailure

if TYPE_CHECKING:
    from collections.abc import Iterator

_CANNOT_WRITE = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.ENOENT,
    errno.EIO,
    errno.EFBIG,
    errno.EMFILE,
    errno.ENFILE,
)


class Interrupted(Exception):
    """Training was stopped by a signal. `is_saved` says whether what was learnt can be gone on with."""

    def __init__(self, run: RunDirectory, signal_number: int, is_saved: bool) -> None:
        where = f"saved in {run.path}" if is_saved else f"{run.path} has its results and no checkpoint to go on from"
        super().__init__(f"stopped by {signal.Signals(signal_number).name}; {where}")
        self.run, self.signal_number, self.is_saved = run, signal_number, is_saved


@contextmanager
def caught_signals() -> Iterator[tuple[threading.Event, list[int]]]:
    """Yield (a request to stop, the signals behind it). A second SIGINT or SIGTERM is taken literally.

    SIGHUP is ignored: a run outlives its terminal.
    """
    stop, received = threading.Event(), []
    if threading.current_thread() is not threading.main_thread():
        yield stop, received
        return

    def note(number: int, _: Any) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)
        stop.set()

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    if hasattr(signal, "SIGHUP"):
        before[signal.SIGHUP] = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        yield stop, received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def storage_failures_told(run: RunDirectory) -> Iterator[None]:
    """Raise StorageFailure where the run can no longer be written."""
    try:
        yield
    except OSError as error:
        if error.errno in _CANNOT_WRITE:
            raise StorageFailure(f"{run.path} cannot be written: {error.strerror}") from error
        raise
