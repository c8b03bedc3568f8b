"""Evaluation in several processes, with the numbers of one. The workers run NumPy and the task; JAX is not imported."""

from __future__ import annotations

import pickle
import traceback
from collections import deque
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING

from csac.evaluation.evaluator import EvaluationEpisode, EvaluationFailure, Evaluator
from csac.processes import Child, core_quota, die_with_parent, end, move_to, outlive_termination, usable_cores
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.deploy.policy import Policy
    from csac.evaluation.evaluator import OnProgress

Batch = tuple[int, int]  # which policy, number of the first episode
Work = tuple["Policy", int, bool, dict[str, float]]  # policy, first episode, whether deterministic, how it is perturbed
Answer = tuple[list[EvaluationEpisode], set[str]] | Exception  # a batch's episodes and what `info` held, or a failure

_BATCHES_THAT_PAY = 2  # for each process: it takes as long to start as a short batch takes


def choose_processes(evaluator: Evaluator, policies: int) -> int:
    """Return how many processes pay for evaluating so many policies: at most one per core."""
    return max(1, min(len(usable_cores()[: core_quota()]), len(evaluator.batches(policies)) // _BATCHES_THAT_PAY))


class ProcessDied(EvaluationFailure):
    """A process died in the middle of a batch: this says nothing of the policy."""


class EvaluationPool:
    """Does what `Evaluator` does, batch by batch in processes of their own; the numbers are the same to the last bit.

    A batch is what one evaluator steps at a time, so that nothing depends on which process takes it. The processes
    start at the first run, or at `start`, and wait for the next until `close`.

    Args:
        evaluator: what each process works with, perturbed as it is when a run begins; itself, it is not run.
        processes: how many, at least one.
        cores: the processors that they may use; None for those that this process may use when it starts them.

    Raises:
        InputError: fewer than one process, or a task that cannot be sent to another process.
    """

    def __init__(self, evaluator: Evaluator, processes: int, cores: Sequence[int] | None = None) -> None:
        if processes < 1:
            raise InputError(f"{processes} processes: use at least one")
        try:
            pickle.dumps(evaluator)
        except Exception as error:
            raise InputError(
                f"the task cannot be sent to another process: make it a module's function ({error})"
            ) from None
        self._evaluator, self._processes, self._cores = evaluator, processes, cores
        self._workers: list[_Worker] = []
        self.info_names: set[str] = set()

    def start(self) -> None:
        """Start every process that is not there, so that a run need not wait for it."""
        self._start(self._processes)

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
        try:
            running = self.begin(policies, deterministic, stop_at_failure=True)
            running.on_progress = on_progress
            while not running.is_over:
                running.wait()
            episodes = [running.episodes(index) for index in range(len(policies))]
        except BaseException:
            self.close()
            raise
        self.info_names |= running.info_names
        return episodes

    def begin(
        self, policies: Sequence[Policy], deterministic: bool = True, stop_at_failure: bool = False
    ) -> PendingEvaluation:
        """Begin to evaluate policies and return. The run before must be over.

        With `stop_at_failure` a failing batch leaves out all that no process has begun, else those of its own policy.
        """
        batches = self._evaluator.batches(len(policies))
        self._start(min(self._processes, len(batches)))
        tasks = {
            (index, first): (policies[index], first, deterministic, self._evaluator.perturbed)
            for index, first in batches
        }
        return PendingEvaluation(list(self._workers), tasks, len(policies) * self._evaluator.episodes, stop_at_failure)

    def close(self) -> None:
        """End the processes, which close their environments; another run starts new ones.

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
            self._workers.append(_Worker(self._evaluator, self._cores))


class PendingEvaluation:
    """A run of an `EvaluationPool` that is on its way.

    The processes have a batch each, in order, and are given the next whenever somebody waits here or asks whether it is
    over. `info_names` are those of the batches that are done.
    """

    def __init__(self, workers: list[_Worker], tasks: dict[Batch, Work], total: int, stop_at_failure: bool) -> None:
        self._idle, self._tasks, self._total, self._stop_at_failure = workers, tasks, total, stop_at_failure
        self.on_progress: OnProgress | None = None
        self.info_names: set[str] = set()
        self._waiting, self._done = deque(tasks), 0
        self._busy: dict[_Worker, Batch] = {}
        self._answers: dict[Batch, Answer] = {}
        self._death: ProcessDied | None = None
        self._hand_out()

    @property
    def is_over(self) -> bool:
        """Whether everything has been answered that will be. Does not wait."""
        self._receive(0.0)
        return not self._busy

    def wait(self) -> None:
        """Wait for the next answer."""
        self._receive(None)

    def episodes(self, index: int) -> list[EvaluationEpisode]:
        """Wait for the episodes of one of the policies and return them in order.

        Raises:
            InputError: as `Evaluator.run`.
            EvaluationFailure: as `Evaluator.run`, of its first batch that failed.
            ProcessDied: what there is of it, because a process died.
        """
        batches = [batch for batch in self._tasks if batch[0] == index]
        while self._busy and not self._answers.keys() >= set(batches):
            self.wait()
        episodes = []
        for batch in batches:
            answer = self._answers.get(batch, self._death)
            if isinstance(answer, Exception):
                raise answer
            assert answer
            episodes += answer[0]
        return episodes

    def _receive(self, timeout: float | None) -> None:
        """Take the answers that come within so many seconds, or the next one, and hand out what waits."""
        ready = wait([worker.connection for worker in self._busy], timeout) if self._busy else []
        for worker in [worker for worker in self._busy if worker.connection in ready]:
            batch = self._busy.pop(worker)
            answer = self._answers[batch] = worker.answer()
            if isinstance(answer, Exception):
                self._leave_out(batch, answer)
            else:
                self._done += len(answer[0])
                self.info_names |= answer[1]
                if self.on_progress:
                    self.on_progress(self._done, self._total)
            if not isinstance(answer, ProcessDied):
                self._idle.append(worker)
        self._hand_out()

    def _leave_out(self, failed: Batch, reason: Exception) -> None:
        """Do not begin what nobody needs after a failure, nor anything once a process has died: so might the next."""
        if isinstance(reason, ProcessDied):
            self._death = reason
        if self._death or self._stop_at_failure:
            self._waiting.clear()
        self._waiting = deque(batch for batch in self._waiting if batch[0] != failed[0])

    def _hand_out(self) -> None:
        while self._waiting and self._idle:
            worker, batch = self._idle.pop(), self._waiting.popleft()
            worker.tell(self._tasks[batch])
            self._busy[worker] = batch


class _Worker(Child):
    """The parent's end of one process, which is told the `Work` to do, or None to end."""

    def __init__(self, evaluator: Evaluator, cores: Sequence[int] | None) -> None:
        super().__init__(_work, evaluator, cores, daemon=False)

    def answer(self) -> Answer:
        with suppress(EOFError, OSError):
            return self.connection.recv()
        return ProcessDied(f"the evaluation was broken off: {self.cause_of_death()}")


def _work(connection: Connection, evaluator: Evaluator, cores: Sequence[int] | None) -> None:
    """Run the batches that are asked for, until there are no more or the parent is gone."""
    die_with_parent()
    outlive_termination()
    if cores:
        move_to(cores)
    try:
        while work := connection.recv():
            connection.send(_answer(evaluator, *work))
    except (EOFError, OSError):
        return
    finally:
        evaluator.close()


def _answer(
    evaluator: Evaluator, policy: Policy, first: int, deterministic: bool, perturbed: dict[str, float]
) -> Answer:
    try:
        if perturbed != evaluator.perturbed:
            evaluator.perturb(perturbed)
        return evaluator.run_batch(policy, first, deterministic), evaluator.info_names
    except (EvaluationFailure, InputError) as error:
        return type(error)(str(error))
    except Exception:
        return RuntimeError(traceback.format_exc())
