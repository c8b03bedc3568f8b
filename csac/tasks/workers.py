"""Step slow environments in parallel worker processes."""

from __future__ import annotations

import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from csac.processes import SECONDS_BETWEEN_CHECKS, Child, end
from csac.tasks.environment import Environment
from csac.tasks.events import info_name, number
from csac.tasks.failures import EnvironmentFailure
from csac.tasks.preflight import seed_globals
from csac.tasks.registry import Task
from csac.tasks.spaces import ContractParts
from csac.types import Spec

SECONDS_THAT_PAY = 3e-4  # per step; the round trip to a process takes a fifth of that
STEPS_TRIED = 10


class Workers:
    """Worker processes with `counts` of environments each, and a `RemoteEnvironment` for each of these.

    A step returns only those entries of `info` that `events` need, if they are numbers.
    """

    def __init__(
        self,
        task: Task,
        environment_arguments: dict[str, Any] | None,
        counts: list[int],
        seed: int,
        events: Sequence[str] = (),
    ) -> None:
        self._workers: list[Worker] = []
        try:
            for index, count in enumerate(counts):
                self._workers.append(Worker(task, environment_arguments, count, seed + index, events))
            descriptions = [worker.answer() for worker in self._workers]
        except BaseException:
            self.close()
            raise
        self.environments = [
            RemoteEnvironment(worker, i, *description)
            for worker, count, description in zip(self._workers, counts, descriptions, strict=True)
            for i in range(count)
        ]

    def begin(self) -> None:
        """Start the calls that were asked for, in all processes."""
        for worker in self._workers:
            worker.begin()

    def close(self) -> None:
        """Have the processes close their environments and end."""
        for worker in self._workers:
            worker.tell(None)
        end(self._workers)


class RemoteEnvironment:
    """An `Environment` in a worker process, with its methods; `ask` announces a call, which `Workers.begin` starts.

    A worker answers in order: after `ask` on several of its environments, collect their results in the same order
    before calling anything else. If it dies, every call raises EnvironmentFailure.
    """

    def __init__(self, worker: Worker, index: int, spec: Spec, parts: ContractParts, task_name: str) -> None:
        self.spec, self.contract_parts, self.task_name = spec, parts, task_name
        self._worker, self._index, self._is_pending = worker, index, False

    def ask(self, method: str, *arguments: Any) -> None:
        """Announce a call; the next call of the method returns its result."""
        self._worker.calls.append((self._index, method, arguments))
        self._is_pending = True

    def __getattr__(self, method: str) -> Callable[..., Any]:
        """Return a method of the environment, to be run in the worker."""
        return partial(self._answer, method)

    def close(self) -> None:
        """Do nothing: `Workers.close` closes all environments."""

    def _answer(self, method: str, *arguments: Any) -> Any:
        if not self._is_pending:
            self.ask(method, *arguments)
        self._is_pending = False
        return self._worker.answer()


class Worker(Child):
    """The parent's end of a process that steps environments.

    All calls are sent in one message and answered in one: two ends that both send more than a pipe holds never return.
    """

    def __init__(self, *arguments: Any) -> None:
        super().__init__(_serve, *arguments)
        self.calls: list[tuple[int, str, tuple[Any, ...]]] = []
        self._answers: deque[tuple[Any, Exception | None, str]] = deque()

    def begin(self) -> None:
        """Send the calls that were announced."""
        if self.calls:
            self.tell(self.calls)
            self.calls = []

    def answer(self) -> Any:
        """Return the next answer or raise the worker's exception; raise EnvironmentFailure if the process is gone."""
        self.begin()
        try:
            while not self._answers:
                if self.connection.poll(SECONDS_BETWEEN_CHECKS):
                    self._answers.extend(self.connection.recv())
                elif self.process.exitcode is not None:  # a process that its task forked holds the pipe open
                    raise EOFError
        except (EOFError, OSError):
            raise EnvironmentFailure(f"its environments' process: {self.cause_of_death()}") from None
        answer, error, details = self._answers.popleft()
        if error:
            raise error from (RuntimeError(details) if details else None)
        return answer


def _serve(
    connection: Connection,
    task: Task,
    environment_arguments: dict[str, Any] | None,
    count: int,
    seed: int,
    events: Sequence[str],
) -> None:
    """Run the requested calls on environments until the parent sends None or is gone."""
    seed_globals(seed)
    environments: list[Environment] = []
    names = {info_name(event) for event in events}
    with ExitStack() as stack, suppress(EOFError, OSError):

        def make() -> tuple[Any, ...]:
            for _ in range(count):
                environments.append(Environment(task, environment_arguments))
                stack.callback(environments[-1].close)
            return environments[0].spec, environments[0].contract_parts, environments[0].task_name

        connection.send([_outcome(names, make)])
        while calls := connection.recv():
            connection.send([_outcome(names, getattr(environments[i], method), *given) for i, method, given in calls])


def _outcome(names: set[str], function: Any, *arguments: Any) -> tuple[Any, Exception | None, str]:
    """Return (result, exception, traceback of the exception's cause) of a call."""
    try:
        result = function(*arguments)
        if function.__name__ == "step_environment_scale":
            info = {name: number(result[-1].get(name)) for name in names}
            result = (*result[:-1], info)  # the rest of it may hold objects that cannot be pickled
        return result, None, ""
    except Exception as error:
        return None, error, "".join(traceback.format_exception(error)) if error.__cause__ else ""


def choose_processes(task: Task, environment_arguments: dict[str, Any] | None, environments: int, cores: int) -> int:
    """Return how many processes are worthwhile: if a step is slow, one per environment up to `cores`, else 0."""
    processes = min(environments, cores)
    if processes < 2:
        return 0
    with closing(Environment(task, environment_arguments)) as environment, suppress(EnvironmentFailure):
        action, fastest = np.zeros(environment.spec.action_size, np.float32), np.inf
        environment.reset(0)
        for _ in range(STEPS_TRIED):
            began = time.perf_counter()
            _, _, terminated, truncated, _ = environment.step(action)
            fastest = min(fastest, time.perf_counter() - began)
            if terminated or truncated:
                break
        return processes if fastest > SECONDS_THAT_PAY else 0
    return 0  # it fails
