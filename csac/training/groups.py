"""A run as seed groups: each group is trained by one process, here or beside us, and cores are handed out in turns."""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, NamedTuple

from csac.training.loop import Ended, Progress, Settings, train_group
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Sequence

    from csac.training.loop import Event

# More processes than this for each core only cost memory: the seeds of a larger run share processes.
GROUPS_PER_CORE = 4


class GroupCrashed(NamedTuple):
    """A group's process ended without a word, or with an error of ours."""

    reason: str
    details: str


def usable_cores() -> list[int]:
    """Return the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def split_seeds(seeds: Sequence[int], groups: int) -> list[list[int]]:
    """Return the seeds in `groups` consecutive parts whose sizes differ by one at most."""
    if not 1 <= groups <= len(seeds):
        raise InputError(f"groups must lie between 1 and the number of seeds ({len(seeds)}), not {groups}")
    size, larger = divmod(len(seeds), groups)
    ends = [size * (i + 1) + min(i + 1, larger) for i in range(groups)]
    return [list(seeds[begin:end]) for begin, end in zip([0, *ends], ends)]  # noqa: B905


def choose_groups(seeds: int, device: str) -> int:
    """Return one group for a GPU; on a CPU one group per seed, as long as their processes are not too many.

    Two learners on a core each do about a fifth more than one learner of two seeds on both.
    """
    return 1 if device == "gpu" else min(seeds, GROUPS_PER_CORE * len(usable_cores()))


def run_groups(
    settings: Settings, groups: Sequence[Sequence[int]], should_stop: Callable[[], bool]
) -> Generator[tuple[int, Event | GroupCrashed], None, None]:
    """Train every group and yield (group, event) as they come. A single group is trained in this process."""
    if len(groups) == 1:
        for event in train_group(settings, groups[0], should_stop):
            yield 0, event
        return
    workers = [_Worker(settings, seeds) for seeds in groups]
    try:
        yield from _Scheduler(workers, should_stop).run()
    finally:
        for worker in workers:
            worker.kill()


class _Worker:
    """The parent's end of one group's process."""

    def __init__(self, settings: Settings, seeds: Sequence[int]) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, settings, list(seeds)), daemon=True)
        self.step, self.over = 0, False
        self.cores: list[int] | None = None
        with _worker_surroundings():
            self.process.start()
        theirs.close()

    def kill(self) -> None:
        if self.process.is_alive():
            self.process.kill()
        self.process.join()
        self.connection.close()


class _Scheduler:
    """Hands sets of cores to the group that is furthest behind, a few hundred steps at a time.

    So five seeds on two cores all advance together and both cores are busy to the end, while nothing that a seed
    computes depends on when its turn comes.
    """

    def __init__(self, workers: list[_Worker], should_stop: Callable[[], bool]) -> None:
        self.workers, self.should_stop = workers, should_stop
        cores = usable_cores()
        sets = min(len(workers), len(cores))
        self.free = [cores[i::sets] for i in range(sets)]
        self.waiting = list(workers)
        self.stopping = False

    def run(self) -> Generator[tuple[int, Event | GroupCrashed], None, None]:
        self._hand_out()
        while running := [worker for worker in self.workers if not worker.over]:
            if not self.stopping and self.should_stop():
                self._stop(running)
            ready = wait([worker.connection for worker in running], timeout=0.1)
            for index, worker in enumerate(self.workers):
                if worker.connection in ready:
                    yield index, self._receive(worker)
            self._hand_out()

    def _receive(self, worker: _Worker) -> Event | GroupCrashed:
        try:
            event = worker.connection.recv()
        except (EOFError, ConnectionResetError):
            worker.process.join()
            event = GroupCrashed(_cause_of_death(worker.process.exitcode), "")
        worker.over = isinstance(event, Ended | GroupCrashed)
        if worker.over or isinstance(event, Progress):
            if worker.cores is not None:
                self.free.append(worker.cores)
                worker.cores = None
            if isinstance(event, Progress):
                worker.step = event.step
                if not self.stopping:
                    self.waiting.append(worker)
        return event

    def _hand_out(self) -> None:
        self.waiting.sort(key=lambda worker: worker.step, reverse=True)
        while self.free and self.waiting:
            worker = self.waiting.pop()
            worker.cores = self.free.pop(0)
            _tell(worker, worker.cores)

    def _stop(self, running: list[_Worker]) -> None:
        """Ask every group to end; those that wait for cores finish on any."""
        self.stopping, self.waiting = True, []
        for worker in running:
            _tell(worker, None)


def _tell(worker: _Worker, cores: list[int] | None) -> None:
    try:
        worker.connection.send(cores)
    except (BrokenPipeError, ConnectionResetError):
        return  # its death is seen when we receive


def _work(connection: Connection, settings: Settings, seeds: list[int]) -> None:
    """Train one group in a process of its own, one turn at a time."""
    turns = _Turns(connection)
    try:
        turns.take()
        for event in train_group(settings, seeds, turns.should_stop):
            connection.send(event)
            if isinstance(event, Progress) and not turns.stopped:
                turns.take()
    except (BrokenPipeError, EOFError, ConnectionResetError):
        return  # the parent is gone, and with it whoever would write this down
    except Exception as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        connection.send(GroupCrashed(reason, traceback.format_exc()))


class _Turns:
    """A worker's view of the scheduler: the cores it may use now, and whether to stop."""

    def __init__(self, connection: Connection) -> None:
        self.connection, self.stopped = connection, False

    def take(self) -> None:
        """Wait for a set of cores and move every thread of this process there."""
        cores: list[int] | None = self.connection.recv()
        if cores is None:
            self.stopped = True
        elif hasattr(os, "sched_setaffinity"):
            for thread in os.listdir("/proc/self/task"):
                os.sched_setaffinity(int(thread), cores)

    def should_stop(self) -> bool:
        """Return whether the parent has asked to stop; no other message comes during a turn."""
        if not self.stopped and self.connection.poll():
            self.stopped = self.connection.recv() is None
        return self.stopped


@contextmanager
def _worker_surroundings() -> Iterator[None]:
    """What a worker inherits: products on one thread, since NumPy there only evaluates, and no signals.

    A Ctrl-C reaches every process of the terminal; the parent alone decides what it means.
    """
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    resource_tracker.ensure_running()  # starts at the first spawn otherwise, and would let the signals through again
    os.environ.update(dict.fromkeys(names, "1"))
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _cause_of_death(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        name = signal.Signals(-exit_code).name
        hint = " (out of memory?)" if name == "SIGKILL" else ""
        return f"its process was killed by {name}{hint}"
    return f"its process ended with exit code {exit_code}"
