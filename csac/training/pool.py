"""Evaluation in several processes, with the numbers of one. The workers run NumPy and the task; JAX is not imported."""

from __future__ import annotations

import multiprocessing
import pickle
import traceback
from collections import deque
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING

from csac.training.evaluation import EvaluationEpisode, EvaluationFailure, Evaluator
from csac.training.processes import cause_of_death, die_with_parent, usable_cores, worker_surroundings
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.deploy.policy import Policy
    from csac.training.evaluation import OnProgress

Answer = tuple[list[EvaluationEpisode], set[str]] | Exception  # a batch's episodes and what `info` held, or a failure

_BATCHES_THAT_PAY = 2  # for each process: it takes as long to start as a short batch takes


def choose_processes(evaluator: Evaluator, policies: int) -> int:
    """Return how many processes pay for evaluating so many policies: at most one per core."""
    return max(1, min(len(usable_cores()), len(evaluator.batches(policies)) // _BATCHES_THAT_PAY))


class EvaluationPool:
    """Does what `Evaluator` does, batch by batch in processes of their own; the numbers are the same to the last bit.

    A batch is what one evaluator steps at a time, so that nothing depends on which process takes it. The processes
    start at the first run and wait for the next until `close`.

    Args:
        evaluator: what each process works with; itself, it is not run.
        processes: how many, at least one.

    Raises:
        InputError: fewer than one process, or a task that cannot be sent to another process.
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
        self._workers: list[_Worker] = []
        self.info_names: set[str] = set()

    def run(self, policy: Policy, deterministic: bool = True) -> list[EvaluationEpisode]:
        """Return the episodes in order; as `Evaluator.run`."""
        return self.run_all([policy], deterministic)[0]

    def run_all(
        self, policies: Sequence[Policy], deterministic: bool = True, on_progress: OnProgress | None = None
    ) -> list[list[EvaluationEpisode]]:
        """Return the episodes of each policy, as `Evaluator.run_all`.

        Raises:
            InputError: as `Evaluator.run`.
            EvaluationFailure: as `Evaluator.run`, of the first batch that failed; or a process died.
        """
        batches = self._evaluator.batches(len(policies))
        try:
            answers = self._answers(policies, batches, deterministic, on_progress)
        except BaseException:
            self.close()
            raise
        finished: list[list[EvaluationEpisode]] = [[] for _ in policies]
        for index, first in batches:
            answer = answers[index, first]
            if isinstance(answer, Exception):
                self.close()
                raise answer
            finished[index] += answer[0]
            self.info_names |= answer[1]
        return finished

    def close(self) -> None:
        """End the processes; another run starts new ones."""
        for worker in self._workers:
            worker.kill()
        self._workers = []

    def _answers(
        self,
        policies: Sequence[Policy],
        batches: Sequence[tuple[int, int]],
        deterministic: bool,
        on_progress: OnProgress | None,
    ) -> dict[tuple[int, int], Answer]:
        """Return what came of each batch, up to the first that failed. Batches are handed out in order."""
        while len(self._workers) < min(self._processes, len(batches)):
            self._workers.append(_Worker(self._evaluator))
        waiting, idle = deque(batches), list(self._workers)
        busy: dict[_Worker, tuple[int, int]] = {}
        answers: dict[tuple[int, int], Answer] = {}
        total, done = len(policies) * self._evaluator.episodes, 0
        while waiting or busy:
            while waiting and idle:
                worker, batch = idle.pop(), waiting.popleft()
                worker.ask((policies[batch[0]], batch[1], deterministic))
                busy[worker] = batch
            ready = wait([worker.connection for worker in busy])
            for worker in [worker for worker in busy if worker.connection in ready]:
                answer = answers[busy.pop(worker)] = worker.answer()
                if isinstance(answer, Exception):
                    waiting.clear()
                    continue
                idle.append(worker)
                done += len(answer[0])
                if on_progress:
                    on_progress(done, total)
        return answers


class _Worker:
    """The parent's end of one process."""

    def __init__(self, evaluator: Evaluator) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, evaluator), daemon=True)
        try:
            with worker_surroundings():
                self.process.start()
        except BaseException:  # a Ctrl-C that waited until the worker was there
            if self.process.pid:
                self.kill()
            raise
        theirs.close()

    def ask(self, batch: tuple[Policy, int, bool]) -> None:
        try:
            self.connection.send(batch)
        except (BrokenPipeError, ConnectionResetError):
            return  # its death is seen when we receive

    def answer(self) -> Answer:
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            self.kill()
            return EvaluationFailure(f"the evaluation was broken off: {cause_of_death(self.process.exitcode)}")

    def kill(self) -> None:
        if self.process.is_alive():
            self.process.kill()
        self.process.join()
        self.connection.close()


def _work(connection: Connection, evaluator: Evaluator) -> None:
    """Run the batches that are asked for, until the parent is gone."""
    die_with_parent()
    try:
        while True:
            connection.send(_answer(evaluator, *connection.recv()))
    except (EOFError, OSError):
        return


def _answer(evaluator: Evaluator, policy: Policy, first: int, deterministic: bool) -> Answer:
    try:
        return evaluator.run_batch(policy, first, deterministic), evaluator.info_names
    except (EvaluationFailure, InputError) as error:
        return type(error)(str(error))
    except Exception:
        return RuntimeError(traceback.format_exc())
