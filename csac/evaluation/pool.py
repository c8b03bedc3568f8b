"""Evaluation in several processes, with the numbers of one. The workers run NumPy and the task; JAX is not imported."""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING

from csac.evaluation.pending import Pending
from csac.processes import Child, cores_to_use, end
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from multiprocessing.connection import Connection

    from csac.deploy.policy import Policy
    from csac.evaluation.evaluator import Evaluator
    from csac.evaluation.pending import OnProgress

_BATCHES_THAT_PAY = 2  # for each process: it takes as long to start as a short batch takes


def choose_processes(evaluator: Evaluator, policies: int) -> int:
    """Return how many processes pay for evaluating so many policies: at most one per core."""
    return max(1, min(cores_to_use(), len(evaluator.batches(policies)) // _BATCHES_THAT_PAY))


class EvaluationPool:
    """Does what `Evaluator` does, batch by batch in processes of their own; the numbers are the same to the last bit.

    A batch is what one evaluator steps at a time, so that nothing depends on which process takes it. The processes
    start at the first evaluation, or at `start`, and wait for the next until `close`.

    Args:
        evaluator: what each process works with, perturbed as it is when an evaluation begins.
        processes: how many, at least one.
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
