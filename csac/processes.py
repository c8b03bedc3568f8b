"""Child processes that die with this one, and the cores and memory that a process may use. Without JAX."""

from __future__ import annotations

import ctypes
import math
import multiprocessing
import os
import signal
import sys
import time
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.util import Finalize
from pathlib import Path
from typing import TYPE_CHECKING, Any

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from multiprocessing.context import SpawnProcess

SECONDS_BETWEEN_CHECKS = 1.0  # of whether a process that does not answer is alive
# How long to wait for the exit code of a process whose pipe has closed.
SECONDS_TO_END = 10.0
# Time for an environment to close itself and the simulator that it started.
SECONDS_TO_CLOSE = 2.0

# Exit code of a child process whose import of the user's script starts training, because that has no main guard.
UNGUARDED = 97

_PR_SET_PDEATHSIG = 1
_SAFE_PATH = "PYTHONSAFEPATH"  # keeps a child from importing files of the working directory

_BLOCKED_SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


def usable_cores() -> list[int]:
    """Return the cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def core_quota() -> int | None:
    """Return the CPU time that this process is allowed, in cores, rounded up; None without a quota.

    A container with a quota still sees every core of its machine.
    """
    quotas = []
    for folder in control_groups():
        with suppress(OSError, ValueError):
            quota, period = (folder / "cpu.max").read_text().split()
            quotas.append(max(1, math.ceil(int(quota) / int(period))))  # "max" raises ValueError
    return min(quotas, default=None)


def cores_to_use() -> int:
    """Return how many cores this process may compute on at a time."""
    return len(usable_cores()[: core_quota()])


def memory_left() -> int | None:
    """Return the bytes left to this process below its container's limit, or None without a limit.

    The cache of files, which can be read again, counts as free.
    """
    left = []
    for folder in control_groups():
        with suppress(OSError, ValueError):
            limit, used = (int((folder / f"memory.{name}").read_text()) for name in ("max", "current"))
            statistics = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            left.append(max(0, limit - used + int(statistics.get("inactive_file", 0))))
    return min(left, default=None)


def control_groups(listed: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> list[Path]:
    """Return the folders of this process's control groups (Linux, version 2), from its own to the outermost."""
    try:
        own = Path(next(line[3:] for line in listed.read_text().splitlines() if line.startswith("0::")))
    except (OSError, StopIteration):
        return []
    return [root / path.relative_to("/") for path in (own, *own.parents) if ".." not in path.parts]


def move_to(cores: Sequence[int]) -> None:
    """Restrict every thread of this process to these cores, where the system supports it."""
    if hasattr(os, "sched_setaffinity"):
        for thread in os.listdir("/proc/self/task"):
            with suppress(ProcessLookupError):  # the thread has ended meanwhile
                os.sched_setaffinity(int(thread), cores)


def die_with_parent() -> None:
    """Ask Linux to kill this process with its parent: it must not write into a run that another process takes over."""
    parent = multiprocessing.parent_process()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if parent and os.getppid() != parent.pid:  # the parent died before the call
            os.kill(os.getpid(), signal.SIGKILL)


def outlive_termination() -> None:
    """Have this worker ignore SIGTERM, since its parent decides when it ends, but not the processes of its task.

    SIGTERM is blocked until now (`worker_settings`). A mask survives an exec and a handler does not: with the mask,
    a task would send its simulator a SIGTERM without effect, and wait for it for ever. What a terminal sends to all its
    processes, a Ctrl-C or a hang-up, stays blocked: simulators live until their seeds are saved.
    """
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    signal.siginterrupt(signal.SIGTERM, False)  # native code may not expect interrupted system calls
    os.register_at_fork(after_in_child=lambda: signal.signal(signal.SIGTERM, before))  # for forks without an exec
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})


def script() -> Path | None:
    """Return the file of the user's script, or None in a notebook, at a prompt or for a script from standard input."""
    file = getattr(sys.modules["__main__"], "__file__", None)  # "<stdin>" for standard input
    return Path(file) if file and Path(file).is_file() else None


def may_be_imported() -> bool:
    """Return whether child processes may import the user's script: it has a main guard, or there is no script."""
    file = script()
    with suppress(OSError, ValueError):
        return file is None or "__main__" in file.read_text(encoding="utf-8")
    return True


def end_if_unguarded() -> None:
    """Exit at once, and silently, if this process is importing its parent's script; the parent reports why."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        os._exit(UNGUARDED)


class Child:
    """A child process that runs `work(connection, *arguments)`, and this end of the pipe to it.

    It dies with this process, and ignores SIGTERM.
    """

    def __init__(self, work: Callable[..., None], *arguments: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, child_connection = context.Pipe()
        self.process = context.Process(target=_run_child, args=(work, child_connection, *arguments))
        with safe_path(), worker_settings(), _hide_missing_script():
            self.process.start()
            # At exit, Python joins its child processes; one that nobody has closed would wait for messages for ever.
            self._at_exit = Finalize(None, _kill, (self.process,), exitpriority=0)
        child_connection.close()

    def tell(self, message: Any) -> None:
        """Send a message; if the process is dead, the next receive shows it."""
        with suppress(OSError):
            self.connection.send(message)

    def cause_of_death(self) -> str:
        """Wait for a process whose pipe has closed to end; return how it ended, as the end of a sentence.

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
        return "its process stopped responding and was killed" if code is None else cause_of_death(code)

    def kill(self) -> None:
        """End the process at once, and wait until it is gone."""
        _kill(self.process)
        self.connection.close()
        self._at_exit.cancel()


def _run_child(work: Callable[..., None], *arguments: Any) -> None:
    """Run a child's work."""
    os.environ.pop(_SAFE_PATH)  # the child's own children need not have it
    die_with_parent()
    outlive_termination()
    work(*arguments)


def _kill(process: SpawnProcess) -> None:
    if process.is_alive():
        process.kill()
    process.join()


def end(children: Sequence[Child], seconds: float = SECONDS_TO_CLOSE) -> None:
    """Close the pipes of processes so that they end; kill those that have not ended after `seconds`.

    A simulator outlives the process that started it: the environments have to end it, which takes a moment.
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
def worker_settings() -> Iterator[None]:
    """Start workers in this block with one BLAS thread, since NumPy only evaluates there, and with signals blocked.

    A Ctrl-C reaches every process of the terminal; the parent alone decides what it means.
    """
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    resource_tracker.ensure_running()  # would otherwise start at the first spawn and unblock the signals
    with _environment(dict.fromkeys(names, "1")):
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED_SIGNALS)
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


@contextmanager
def _hide_missing_script() -> Iterator[None]:
    """Hide a `__file__` that is no file ("<stdin>"), which Pythons started in this block would try to run."""
    main = vars(sys.modules["__main__"])
    hidden = {"__file__": main.pop("__file__")} if "__file__" in main and script() is None else {}
    try:
        yield
    finally:
        main.update(hidden)


@contextmanager
def safe_path() -> Iterator[None]:
    """Keep Pythons started in this block from searching the working directory for modules."""
    with _environment({_SAFE_PATH: "1"}):
        yield


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Set environment variables within this block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def cause_of_death(exit_code: int) -> str:
    """Return how a process ended unexpectedly, as the end of a sentence."""
    if exit_code >= 0:
        return f"its process ended by itself with exit code {exit_code} (does the task call os._exit?)"
    names = {one.value: one.name for one in signal.Signals}
    name = names.get(-exit_code, f"signal {-exit_code}")  # a real-time signal has no name
    hints = {"SIGKILL": " (out of memory?)", "SIGSEGV": " (a fault in native code, such as the task's simulator)"}
    return f"its process was killed by {name}{hints.get(name, '')}"
