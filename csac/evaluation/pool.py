"""Evaluations that are begun and whose results are asked for later: in this process, or in several, with equal numbers.

The processes run NumPy and the task; JAX is not imported.
"""

from __future__ import annotations

import pickle
from collections import deque
from multiprocessing.connection import wait
from typing import TYPE_CHECKING

from csac.evaluation.episode import EvaluationEpisode, EvaluationFailure
from csac.processes import Child, cores_to_use, end
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from multiprocessing.connection import Connection

    from csac.deploy.policy import Policy
    from csac.evaluation.evaluator import Evaluator

    # A policy, the number of a batch's first episode, whether deterministic, how the task is perturbed.
    Work = tuple[Policy, int, bool, dict[str, float]]
    OnProgress = Callable[[int, int], None]  # episodes done, episodes in all

_BATCHES_THAT_PAY = 2  # for each process: it takes as long to start as a short batch takes
_SECONDS_BETWEEN_STOPS = 1.0

Batch = tuple[int, int]  # which policy, number of the first episode
Result = list[EvaluationEpisode] | EvaluationFailure


class EvaluationStopped(Exception):
    """An evaluation ended early, since `should_stop` said so."""


class Pending:
    """An evaluation of several policies that was begun.

    `workers` have a batch each, in order, and get the next whenever somebody waits here or asks whether it is over.
    What a process that dies leaves undone runs in this process when the results are asked for: everything without
    workers. `notes` are lines on what happened that changes no number.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        policies: Sequence[Policy],
        deterministic: bool,
        on_progress: OnProgress | None,
        workers: Sequence[Child] = (),
    ) -> None:
        self.notes: list[str] = []
        self._evaluator, self._policies, self._deterministic = evaluator, policies, deterministic
        self._perturbed, self._on_progress = dict(evaluator.perturbed), on_progress
        self._answers: dict[Batch, Result] = {}
        self._idle, self._waiting = list(workers), deque(evaluator.batches(len(policies)))
        self._busy: dict[Child, Batch] = {}
        self._hand_out()

    @property
    def is_over(self) -> bool:
        """Whether the results need not be waited for. Does not wait."""
        self._receive(0.0)
        return not self._busy

    def results(self, should_stop: Callable[[], bool] | None = None) -> list[Result]:
        """Return each policy's episodes in order, or its first failure, which does not end the others. Waits.

        Raises EvaluationStopped where `should_stop`, asked every second and before each step here, says so.
        """
        while self._busy:
            if should_stop and should_stop():
                raise EvaluationStopped
            self._receive(_SECONDS_BETWEEN_STOPS if should_stop else None)
        for batch in self._evaluator.batches(len(self._policies)):
            if batch not in self._answers and not self._is_spared(batch):
                self._take(batch, self._evaluator.answer(*self._work(batch), should_stop))
        return [self._result(index) for index in range(len(self._policies))]

    def _receive(self, seconds: float | None) -> None:
        """Take the answers that come within so many seconds, or the next one, and hand out what waits."""
        ready = wait([worker.connection for worker in self._busy], seconds) if self._busy else []
        for worker in [worker for worker in self._busy if worker.connection in ready]:
            batch = self._busy.pop(worker)
            try:
                answer = worker.connection.recv()
            except (EOFError, OSError):
                self.notes.append(f"evaluation: {worker.cause_of_death()}; its episodes are run by this one instead")
                continue
            self._take(batch, answer)
            self._idle.append(worker)
        self._hand_out()

    def _hand_out(self) -> None:
        while self._waiting and self._idle:
            batch = self._waiting.popleft()
            if not self._is_spared(batch):
                worker = self._idle.pop()
                worker.tell(self._work(batch))
                self._busy[worker] = batch

    def _take(self, batch: Batch, answer: Result) -> None:
        self._answers[batch] = answer
        if self._on_progress:
            done = sum(len(given) for given in self._answers.values() if isinstance(given, list))
            self._on_progress(done, len(self._policies) * self._evaluator.episodes)

    def _work(self, batch: Batch) -> Work:
        index, first = batch
        return self._policies[index], first, self._deterministic, self._perturbed

    def _is_spared(self, batch: Batch) -> bool:
        """Whether an earlier batch of the same policy has failed."""
        failed = (other for other, answer in self._answers.items() if isinstance(answer, EvaluationFailure))
        return any(other[0] == batch[0] and other < batch for other in failed)

    def _result(self, index: int) -> Result:
        episodes = []
        for batch in sorted(batch for batch in self._answers if batch[0] == index):
            answer = self._answers[batch]
            if isinstance(answer, EvaluationFailure):
                return answer
            episodes += answer
        return episodes


def choose_processes(evaluator: Evaluator, policies: int) -> int:
    """Return how many processes pay for evaluating so many policies: at most one per core."""
    return max(1, min(cores_to_use(), len(evaluator.batches(policies)) // _BATCHES_THAT_PAY))


class EvaluationPool:
    """Does what `Evaluator` does, batch by batch in processes of their own; the numbers are the same to the last bit.

    A batch is what one evaluator steps at a time, so that nothing depends on which process takes it. The processes
    start at the first evaluation, or at `start`, and wait for the next until `close`. Each works with the evaluator,
    perturbed as it is when an evaluation begins.
    """

    def __init__(self, evaluator: Evaluator, processes: int) -> None:
        if processes < 1:
            raise InputError(f"{processes} processes: use at least one")
        try:
            pickle.dumps(evaluator)
        except Exception as error:
            raise InputError(
                f"the task cannot be sent to another process: make it a module's function ({error})"
            ) from None
        self._evaluator, self._processes = evaluator, processes
        self._workers: list[Child] = []

    def start(self) -> None:
        """Start every process that is not there, so that an evaluation need not wait for it."""
        self._start(self._processes)

    def begin(
        self, policies: Sequence[Policy], deterministic: bool = True, on_progress: OnProgress | None = None
    ) -> Pending:
        """Begin to evaluate policies and return. The evaluation before must be over; after a stop, close the pool."""
        self._start(min(self._processes, len(self._evaluator.batches(len(policies)))))
        return Pending(self._evaluator, policies, deterministic, on_progress, self._workers)

    def close(self) -> None:
        """End the processes, which close their environments; another evaluation starts new ones.

        One that is in the middle of a long batch is killed: nobody waits for its episodes.
        """
        workers, self._workers = self._workers, []
        for worker in workers:
            if worker.process.is_alive():
                worker.tell(None)  # where a task has forked, its child holds this end of the pipe open
        end(workers)

    def _start(self, processes: int) -> None:
        for worker in [worker for worker in self._workers if not worker.process.is_alive()]:
            worker.kill()
            self._workers.remove(worker)
        while len(self._workers) < processes:
            self._evaluator.close()  # no process is sent open environments
            self._workers.append(Child(_work, self._evaluator))


def _work(connection: Connection, evaluator: Evaluator) -> None:
    """Run the batches that are asked for, until there are no more or the parent is gone."""
    try:
        while work := connection.recv():
            connection.send(evaluator.answer(*work))
    except (EOFError, OSError):
        return
    finally:
        evaluator.close()
