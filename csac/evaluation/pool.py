"""Asynchronous evaluations, in this process or in worker processes, with bit-identical results.

The workers run NumPy and the task; they do not import JAX.
"""

from __future__ import annotations

from collections import deque
from multiprocessing.connection import wait
from typing import TYPE_CHECKING

from csac.checks import check_whole
from csac.evaluation.episode import EvaluationEpisode, EvaluationFailure, NotMade
from csac.processes import SECONDS_BETWEEN_CHECKS, Child, cores_to_use, end

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from multiprocessing.connection import Connection

    from csac.deploy.policy import Policy
    from csac.evaluation.evaluator import Evaluator

    # Policy, number of the batch's first episode, whether deterministic, perturbations by kind.
    Request = tuple[Policy, int, bool, dict[str, float]]
    OnProgress = Callable[[int, int], None]  # episodes done, episodes in total

_BATCHES_PER_PROCESS = 2  # at least: starting a process takes as long as a short batch

Batch = tuple[int, int]  # policy index, number of the first episode
Result = list[EvaluationEpisode] | EvaluationFailure


class EvaluationStopped(Exception):
    """An evaluation ended early because `should_stop` returned True."""


class Pending:
    """An evaluation of several policies in progress.

    Each of the `workers` has one batch at a time; finished ones get the next batch during `is_over` and `results`.
    Without workers, or for a batch whose worker died or cannot make the task, `results` runs the batches in this
    process. `notes` are lines about events that do not change the results.
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
        self._idle, self._queue = list(workers), deque(evaluator.batches(len(policies)))
        self._busy: dict[Child, Batch] = {}
        self._hand_out()

    @property
    def is_over(self) -> bool:
        """Whether no worker is busy any more. Does not wait."""
        self._receive(0.0)
        return not self._busy

    def results(self, should_stop: Callable[[], bool] | None = None) -> list[Result]:
        """Wait, and return each policy's episodes in order, or its first failure, which does not affect the others.

        Raise EvaluationStopped if `should_stop`, called every second and before each step here, returns True.
        """
        while self._busy:
            if should_stop and should_stop():
                raise EvaluationStopped
            self._receive(SECONDS_BETWEEN_CHECKS)
        for batch in self._evaluator.batches(len(self._policies)):
            if batch not in self._answers and not self._is_skipped(batch):
                self._store(batch, self._evaluator.try_batch(*self._request(batch), should_stop))
        return [self._result(index) for index in range(len(self._policies))]

    def _receive(self, seconds: float) -> None:
        """Wait for answers, at most so many `seconds`, and hand out waiting batches."""
        ready = wait([worker.connection for worker in self._busy], seconds) if self._busy else []
        for worker in [one for one in self._busy if one.connection in ready or one.process.exitcode is not None]:
            batch = self._busy.pop(worker)
            try:
                if not worker.connection.poll():  # it is dead, and a process that its task forked holds the pipe open
                    raise EOFError
                answer = worker.connection.recv()
            except (EOFError, OSError):
                self.notes.append(f"evaluation: {worker.cause_of_death()}; its episodes are run by this one instead")
                continue
            self._idle.append(worker)
            if isinstance(answer, NotMade):
                self.notes.append(
                    f"evaluation: its process cannot make the task; its episodes are run by this one ({answer})"
                )
            else:
                self._store(batch, answer)
        self._hand_out()

    def _hand_out(self) -> None:
        while self._queue and self._idle:
            batch = self._queue.popleft()
            if not self._is_skipped(batch):
                worker = self._idle.pop()
                worker.tell(self._request(batch))
                self._busy[worker] = batch

    def _store(self, batch: Batch, answer: Result) -> None:
        self._answers[batch] = answer
        if self._on_progress:
            done = sum(len(result) for result in self._answers.values() if isinstance(result, list))
            self._on_progress(done, len(self._policies) * self._evaluator.episodes)

    def _request(self, batch: Batch) -> Request:
        index, first = batch
        return self._policies[index], first, self._deterministic, self._perturbed

    def _is_skipped(self, batch: Batch) -> bool:
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
    """Return how many processes are worthwhile for evaluating this many policies: at most one per core."""
    return max(1, min(cores_to_use(), len(evaluator.batches(policies)) // _BATCHES_PER_PROCESS))


class EvaluationPool:
    """Evaluates like `Evaluator`, but in worker processes; the results are the same to the last bit.

    The unit of work is one batch of the evaluator, so that results do not depend on which worker runs it. The workers
    start at the first evaluation, or at `start`, and live until `close`. Each has a copy of the evaluator, which takes
    the perturbations that hold when an evaluation begins.
    """

    def __init__(self, evaluator: Evaluator, processes: int) -> None:
        check_whole("processes", processes, 1, 1_000)
        self._evaluator, self._processes = evaluator, processes
        self._workers: list[Child] = []

    def begin(
        self, policies: Sequence[Policy], deterministic: bool = True, on_progress: OnProgress | None = None
    ) -> Pending:
        """Start an evaluation and return at once. The previous one must be over; after a stop, close the pool first."""
        self.start(len(self._evaluator.batches(len(policies))))
        return Pending(self._evaluator, policies, deterministic, on_progress, self._workers)

    def close(self) -> None:
        """End the processes, which close their environments; the next evaluation starts new ones.

        A process that is busy with a long batch is killed.
        """
        workers, self._workers = self._workers, []
        for worker in workers:
            worker.tell(None)  # closing the pipe is not enough if a child forked by a task holds it open
        end(workers)

    def start(self, processes: int) -> None:
        """Start processes until there are so many, or as many as the pool has, so that an evaluation need not wait."""
        for worker in [worker for worker in self._workers if not worker.process.is_alive()]:
            worker.kill()
            self._workers.remove(worker)
        while len(self._workers) < min(self._processes, processes):
            self._evaluator.close()  # workers get the evaluator without open environments
            self._workers.append(Child(_serve, self._evaluator))


def _serve(connection: Connection, evaluator: Evaluator) -> None:
    """Run the requested batches until the parent sends None or is gone."""
    try:
        while request := connection.recv():
            connection.send(evaluator.try_batch(*request))
    except (EOFError, OSError):
        return
    finally:
        evaluator.close()
