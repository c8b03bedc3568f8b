"""Where cells are run: in this process one after another, or in processes beside it that share the cores."""

from __future__ import annotations

import os
import pickle
import signal
from collections import deque
from contextlib import suppress
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, Any, Protocol

from csac.processes import Child, end, usable_cores
from csac.studies.cells import read_history, write_history
from csac.studies.job import Ended, Job, Message, Started, Stopped, execute
from csac.studies.worker import work
from csac.training.signals import signals_noted

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    Tell = Callable[[Message], Any]

SECONDS_BETWEEN_LOOKS = 0.5  # at the signals that came meanwhile


class Engine(Protocol):
    """Runs jobs, in their order as far as it can, and tells what happens.

    Raises Stopped on SIGINT or SIGTERM, after every cell was saved; a second one is taken literally.
    """

    def __call__(self, jobs: Sequence[Job], tell: Tell) -> None:
        """Return once every job has ended."""
        ...


def run_here(jobs: Sequence[Job], tell: Tell) -> None:
    """Run the jobs in this process, one after another, each on all cores."""
    with signals_noted() as received:
        for job in jobs:
            tell(Started(job.cell.key))
            try:
                ended = execute(job, tell)
            except Stopped:
                tell(Ended(job.cell.key, "stopped"))
                raise
            tell(ended)
            if received:  # too late to stop that one
                raise Stopped(received[0])


def run_in_processes(jobs: Sequence[Job], tell: Tell, workers: int | None = None) -> None:
    """Run each job in a process of its own, `workers` at a time, each of them on its own share of the cores.

    By default there is a worker for each core: two learners with a core each do more than one learner on both.
    """
    shares = split_cores(usable_cores(), workers)
    waiting, free, running = deque(jobs), deque(shares), {}
    with signals_noted() as received:
        try:
            while running or (waiting and not received):
                while waiting and free and not received:
                    worker = _Worker(waiting.popleft(), free.popleft())
                    running[worker.child.connection] = worker
                    tell(Started(worker.job.cell.key, _told(worker.cores)))
                if received:
                    for worker in running.values():
                        worker.stop()
                for connection in wait(list(running), SECONDS_BETWEEN_LOOKS):
                    worker = running[connection]
                    message = worker.receive()
                    if isinstance(message, Ended):
                        end([worker.child])
                        del running[connection]
                        free.append(worker.cores)
                    tell(message)
        finally:
            for worker in running.values():
                worker.child.kill()
        if received:
            raise Stopped(received[0])


def split_cores(cores: Sequence[int], workers: int | None) -> list[list[int]]:
    """Return the cores in as many parts as there are workers; more workers than cores take turns on them."""
    if workers is None:
        return [[core] for core in cores]
    if workers >= len(cores):
        return [[cores[index % len(cores)]] for index in range(workers)]
    return [list(cores[index::workers]) for index in range(workers)]


class _Worker:
    """A process with one job."""

    def __init__(self, job: Job, cores: list[int]) -> None:
        self.job, self.cores, self._is_stopping = job, cores, False
        self.child = Child(work, cores, pickle.dumps(job), daemon=False)

    def stop(self) -> None:
        """Ask it to save and end; once."""
        if not self._is_stopping and self.child.process.pid:
            self._is_stopping = True
            with suppress(ProcessLookupError):
                os.kill(self.child.process.pid, signal.SIGTERM)

    def receive(self) -> Message:
        """Return what it sent, or how it died."""
        try:
            return self.child.connection.recv()
        except (EOFError, OSError):
            reason = self.child.cause_of_death()
        if self._is_stopping:
            return Ended(self.job.cell.key, "stopped")
        with suppress(OSError):
            write_history(self.job.path, {**read_history(self.job.path), "failure": reason})
        return Ended(self.job.cell.key, "failed", reason)


def _told(cores: Sequence[int]) -> str:
    return f"core{'s' * (len(cores) > 1)} {', '.join(map(str, cores))}"
