"""What ends a run from outside: signals, and a disk that takes no more."""

from __future__ import annotations

import errno
import os
import signal
import socket
import threading
from contextlib import contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING, Any

from csac.record.run import RunDirectory, StorageFailure

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator

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
    errno.ESTALE,
    errno.ETIMEDOUT,
    errno.ENOTDIR,
    errno.ENOTCONN,
    errno.ENODEV,
    errno.ENXIO,
    errno.EHOSTDOWN,
)


class Interrupted(Exception):
    """Training was stopped by a signal.

    `is_saved` says whether there is a checkpoint to go on from, `steps_lost` how many of the last steps lie beyond it,
    `begins_anew` whether, where there is none, the run begins anew when it is resumed.
    """

    def __init__(
        self,
        run: RunDirectory,
        signal_number: int,
        is_saved: bool,
        steps_lost: int = 0,
        begins_anew: bool = False,
    ) -> None:
        where = f"saved in {run.path}" if is_saved else f"{run.path} has its results and no checkpoint to go on from"
        if is_saved and steps_lost:
            where = f"{run.path} is saved but for its last {steps_lost:,} steps"
        if begins_anew:
            where = f"{run.path} has no checkpoint yet and will begin anew"
        super().__init__(f"stopped by {signal.Signals(signal_number).name}; {where}")
        self.run, self.signal_number, self.can_go_on = run, signal_number, is_saved or begins_anew


class StoppedAtOnce(KeyboardInterrupt):
    """A second signal came while a run was being saved: what it did after its last checkpoint is lost.

    `can_go_on` says whether `resume` takes it up; its arguments are those of the KeyboardInterrupt.
    """

    def __init__(self, run: RunDirectory, can_go_on: bool, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.run, self.can_go_on = run, can_go_on


@contextmanager
def leaving_at_once() -> Iterator[None]:
    """Let SIGINT and SIGTERM end this process at once, with their exit code and a line, while nothing is to be saved.

    An exception in their place does not always arrive: imports and finalisers swallow some. SIGHUP is ignored from the
    beginning, as `caught_signals` does, which takes over while something is learnt.
    """

    def leave(number: int, _: Any) -> None:
        with suppress(OSError):
            os.write(
                2, f"csac: stopped by {signal.Signals(number).name} outside of training; nothing is lost\n".encode()
            )
        os._exit(128 + number)

    with _handled(leave):
        yield


class _Received(list[int]):
    """The signals so far, and the handler that adds to them: the second one raises KeyboardInterrupt(its number)."""

    def __call__(self, number: int, _: Any) -> None:
        if self:
            raise KeyboardInterrupt(number)
        self.append(number)


@contextmanager
def signals_noted() -> Iterator[list[int]]:
    """Yield a list that SIGINT and SIGTERM are added to; the second of them raises KeyboardInterrupt.

    SIGHUP is ignored: a study outlives its terminal. Runs that are trained within share the list: one that completes
    in spite of a signal leaves it here, and one that begins after it stops at once.
    """
    received = _Received()
    with _handled(received):
        yield received


@contextmanager
def caught_signals(tell: Callable[[], None] | None = None) -> Iterator[tuple[threading.Event, list[int]]]:
    """Yield (a request to stop, the signals behind it). A second SIGINT or SIGTERM is taken literally.

    It is a KeyboardInterrupt with the signal's number. SIGHUP is ignored: a run outlives its terminal. `tell` is
    called, in a thread, as soon as the first signal arrives.
    """
    outer = signal.getsignal(signal.SIGINT)
    stop, received = threading.Event(), outer if isinstance(outer, _Received) else _Received()

    def note(number: int, frame: Any) -> None:
        received(number, frame)
        stop.set()

    with _handled(note), _told_at_once(tell) if tell else nullcontext():
        if received:
            stop.set()
        yield stop, received


@contextmanager
def _handled(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Give SIGINT and SIGTERM to a handler, and SIGHUP to nobody; outside of the main thread, nothing changes."""
    if not _is_main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    if hasattr(signal, "SIGHUP"):
        before[signal.SIGHUP] = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def _told_at_once(tell: Callable[[], None]) -> Iterator[None]:
    """Call `tell` when SIGINT or SIGTERM arrives, also while the main thread compiles and runs no handler."""
    if not _is_main_thread():
        yield
        return
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    before = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)

    def wait() -> None:
        while number := ours.recv(1):
            if number[0] in (signal.SIGINT, signal.SIGTERM):
                tell()
                return

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        theirs.close()
        thread.join()
        ours.close()


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


@contextmanager
def callers_own(failures: list[OSError]) -> Iterator[None]:
    """Note an error that a function of the caller's raises: it says nothing of the run, and is theirs to see."""
    try:
        yield
    except OSError as error:
        failures.append(error)
        raise


@contextmanager
def storage_failures_told(run: RunDirectory, others: Collection[OSError] = ()) -> Iterator[None]:
    """Raise StorageFailure where the run can no longer be written; `others` are errors that come from elsewhere."""
    try:
        yield
    except OSError as error:
        if error.errno in _CANNOT_WRITE and not any(error is other for other in others):
            raise StorageFailure(f"{run.path} cannot be written: {error.strerror}") from error
        raise
