"""Processes beside this one: what they inherit, that they die with it, and how it is told that one has died. No JAX."""

from __future__ import annotations

import ctypes
import math
import multiprocessing
import os
import signal
import sys
import threading
import time
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.util import Finalize
from pathlib import Path
from typing import TYPE_CHECKING, Any

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from multiprocessing.context import SpawnProcess

# A process whose pipe is closed is about to end: its exit code says why.
SECONDS_TO_END = 10.0
# What an environment has to close itself, and with it the simulator that it started.
SECONDS_TO_CLOSE = 2.0

# How a process ends that was to train, and whose import of the user's script trains already.
UNGUARDED = 97

_PR_SET_PDEATHSIG = 1
_SAFE_PATH = "PYTHONSAFEPATH"  # else Python would search the working directory first in a child, whatever lies there

# Of those that the system has: Windows has no hang-up.
_HELD_BACK = {getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)}


def usable_cores() -> list[int]:
    """Return the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def core_quota(folders: Iterable[Path] | None = None) -> int | None:
    """Return for how many processors this process has time, whatever it may run on; None where nothing bounds that.

    That is the quota of a container, of whose machine every processor is seen. `folders` are its control groups.
    """
    quotas = []
    for folder in control_groups() if folders is None else folders:
        with suppress(OSError, ValueError):
            quota, period = (folder / "cpu.max").read_text().split()
            quotas.append(max(1, math.ceil(int(quota) / int(period))))  # "max" is no number
    return min(quotas, default=None)


def cores_to_use() -> int:
    """Return how many cores this process may compute on at a time."""
    return len(usable_cores()[: core_quota()])


def memory_left(folders: Iterable[Path] | None = None) -> int | None:
    """Return the bytes that a container leaves to this process, or None where nothing bounds them.

    What was only read from files, and can be read again, counts as free. `folders` are as in `core_quota`.
    """
    left = []
    for folder in control_groups() if folders is None else folders:
        with suppress(OSError, ValueError):
            limit, used = (int((folder / f"memory.{name}").read_text()) for name in ("max", "current"))
            statistics = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            left.append(max(0, limit - used + int(statistics.get("inactive_file", 0))))
    return min(left, default=None)


def control_groups(listed: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> list[Path]:
    """Return the folders of this process's control groups (Linux, version 2), from its own to the outermost."""
    try:
        own = next(line[3:] for line in listed.read_text().splitlines() if line.startswith("0::"))
    except (OSError, StopIteration):
        return []
    return [root / path.relative_to("/") for path in (Path(own), *Path(own).parents) if ".." not in path.parts]


def move_to(cores: Sequence[int]) -> None:
    """Let every thread of this process run on these processors alone, where the system knows of such a thing."""
    if hasattr(os, "sched_setaffinity"):
        for thread in os.listdir("/proc/self/task"):
            with suppress(ProcessLookupError):  # it has ended meanwhile
                os.sched_setaffinity(int(thread), cores)


def die_with_parent() -> None:
    """Ask Linux to kill this process with its parent, so that nobody writes into a run that another has taken over."""
    parent = multiprocessing.parent_process()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if parent and os.getppid() != parent.pid:  # it died before it was asked
            os.kill(os.getpid(), signal.SIGKILL)


def outlive_termination() -> None:
    """Have this worker go on after a SIGTERM, as its parent decides when it ends, but not what its task starts.

    It is blocked until then (`worker_surroundings`). A mask survives an exec and a handler does not: with the mask,
    a task would end its simulator by a `terminate` that does nothing, and wait for it for ever. What a terminal sends
    to all that it has started, a Ctrl-C or a hang-up, stays blocked: simulators live until their seeds are saved.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows: nothing was blocked
        return
    before = signal.signal(signal.SIGTERM, _pass_over)
    signal.siginterrupt(signal.SIGTERM, False)  # native code need not expect that its system calls are broken off
    os.register_at_fork(  # where no exec follows
        before=_hold_back, after_in_parent=_let_through, after_in_child=lambda: _take_back(before)
    )
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})


def _pass_over(*_: Any) -> None:
    """Handle a signal by doing nothing."""


def _take_back(handler: Any) -> None:
    """Handle a SIGTERM as before `outlive_termination`, unless the task handles it by now."""
    if signal.getsignal(signal.SIGTERM) is _pass_over:
        signal.signal(signal.SIGTERM, handler)
    _let_through()


_forking = threading.local()


def _hold_back() -> None:
    """Have a SIGTERM wait that a child is sent at once, while its handler is still its parent's."""
    _forking.mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})


def _let_through() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, _forking.mask)


def script() -> Path | None:
    """Return the file of the user's script, or None in a notebook, at a prompt or in what standard input gave."""
    file = getattr(sys.modules["__main__"], "__file__", None)  # "<stdin>" there
    return Path(file) if file and Path(file).is_file() else None


def may_be_imported() -> bool:
    """Return whether processes may import the user's script: it has a guard, or there is none, as in a notebook."""
    file = script()
    with suppress(OSError, ValueError):
        return file is None or "__main__" in file.read_text(encoding="utf-8")
    return True


def end_if_unguarded() -> None:
    """End this process at once, and silently, if it is importing the script of its parent: that one says why."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        os._exit(UNGUARDED)


class Child:
    """A process that runs `work(connection, *arguments)`, and this end of the pipe to it.

    It dies with this process, and outlives a SIGTERM.
    """

    _at_exit: Finalize | None = None

    def __init__(self, work: Callable[..., None], *arguments: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        before = os.environ.get(_SAFE_PATH)
        self.process = context.Process(target=_work, args=(before, work, theirs, *arguments))
        try:
            with safe_path(), worker_surroundings(), _without_a_script_that_is_none():
                self.process.start()
        except BaseException:  # a Ctrl-C that waited until the process was there
            if self.process.pid:
                self.kill()
            raise
        theirs.close()
        # An interpreter that ends waits for its processes, and those wait for it where somebody forgot to close them.
        self._at_exit = Finalize(None, _kill, (self.process,), exitpriority=0)

    def tell(self, message: Any) -> None:
        """Send a message; that the process is dead is seen when one is received."""
        with suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send(message)

    def cause_of_death(self) -> str:
        """Wait until a process that speaks no more is gone; return how it ended, as the end of a sentence.

        Raises InputError if it imported the user's script, which has no guard.
        """
        self.process.join(SECONDS_TO_END)
        code = self.process.exitcode
        self.kill()
        if code == UNGUARDED:
            raise InputError(
                "this script starts processes that import it, and would run anew in each of them: put what it runs "
                'under `if __name__ == "__main__":`, or use seeds_per_process=seeds and evaluation_processes=0'
            )
        return "its process spoke no more and was killed" if code is None else cause_of_death(code)

    def kill(self) -> None:
        """End the process at once, and wait until it is gone."""
        _kill(self.process)
        self.connection.close()
        if self._at_exit:
            self._at_exit.cancel()


def _work(safe_path: str | None, work: Callable[..., None], *arguments: Any) -> None:
    """Do the work of a child, whose own children search for modules as ever."""
    os.environ.pop(_SAFE_PATH, None)
    if safe_path is not None:
        os.environ[_SAFE_PATH] = safe_path
    die_with_parent()
    outlive_termination()
    work(*arguments)


def _kill(process: SpawnProcess) -> None:
    if process.is_alive():
        process.kill()
    process.join()


def end(children: Sequence[Child], seconds: float = SECONDS_TO_CLOSE) -> None:
    """End processes that have nothing more to say; those that have not ended in so many seconds are killed.

    A simulator outlives the process that started it: it is the environments' to end, which takes them a moment.
    """
    deadline = time.monotonic() + seconds
    try:
        for child in children:
            child.connection.close()
        for child in children:
            child.process.join(max(0.0, deadline - time.monotonic()))
    finally:
        for child in children:
            child.kill()


@contextmanager
def worker_surroundings() -> Iterator[None]:
    """What a worker inherits: products on one thread, since NumPy there only evaluates, and no signals.

    A Ctrl-C reaches every process of the terminal; the parent alone decides what it means.
    """
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    resource_tracker.ensure_running()  # starts at the first spawn otherwise, and would let the signals through again
    has_masks = hasattr(signal, "pthread_sigmask")  # not on Windows, where a Ctrl-C reaches the workers too
    with _environment(dict.fromkeys(names, "1")):
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, _HELD_BACK) if has_masks else set()
        try:
            yield
        finally:
            if has_masks:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


@contextmanager
def _without_a_script_that_is_none() -> Iterator[None]:
    """Have the Pythons that are started in this block not look for a file that standard input is called by."""
    main = vars(sys.modules["__main__"])
    hidden = {"__file__": main.pop("__file__")} if "__file__" in main and script() is None else {}
    try:
        yield
    finally:
        main.update(hidden)


@contextmanager
def safe_path() -> Iterator[None]:
    """Have the Pythons that are started in this block not search the working directory for modules."""
    with _environment({_SAFE_PATH: "1"}):
        yield


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Set environment variables in this block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def cause_of_death(exit_code: int) -> str:
    """Return how a process ended that nobody asked to end, as the end of a sentence."""
    if exit_code >= 0:
        return f"its process ended by itself with exit code {exit_code} (does the task call os._exit?)"
    names = {one.value: one.name for one in signal.Signals}
    name = names.get(-exit_code, f"signal {-exit_code}")  # a real-time signal has no name
    hints = {"SIGKILL": " (out of memory?)", "SIGSEGV": " (a fault in native code, such as the task's simulator)"}
    return f"its process was killed by {name}{hints.get(name, '')}"
