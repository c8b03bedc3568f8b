"""Environments in processes of their own: what a seed's slow environments compute, they compute side by side."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from csac.processes import Child, end
from csac.tasks.environment import Environment
from csac.tasks.events import info_name, numbers_in
from csac.tasks.failures import EnvironmentFailure
from csac.tasks.preflight import seed_globals
from csac.tasks.registry import Task
from csac.tasks.spaces import ContractParts
from csac.types import Spec

SECONDS_THAT_PAY = 3e-4  # of a step: asking a process for it takes a fifth of that
STEPS_TRIED = 10


class Workers:
    """Processes with so many environments each, and an `Environment` here for each of those.

    Of a step's `info` only the numbers that `events` are of come back.
    """

    def __init__(
        self,
        task: Task,
        environment_arguments: dict[str, Any] | None,
        numbers: list[int],
        seed: int,
        events: Sequence[str] = (),
    ) -> None:
        self._workers: list[Worker] = []
        try:
            for index, number in enumerate(numbers):
                work = _serve, task, environment_arguments, number, seed + index, events
                self._workers.append(Worker(*work))
            facts = [worker.answer() for worker in self._workers]
        except BaseException:
            self.close()
            raise
        self.environments = [
            RemoteEnvironment(worker, i, *of_worker)
            for worker, number, of_worker in zip(self._workers, numbers, facts, strict=True)
            for i in range(number)
        ]

    def close(self) -> None:
        """Have the processes close their environments and end."""
        for worker in self._workers:
            with suppress(OSError):
                worker.tell(None)
        end(self._workers)


class RemoteEnvironment:
    """An `Environment` in another process, with its methods; what is asked ahead is computed meanwhile.

    A worker answers in order: of the environments that it has, what is asked ahead of all is answered before more is
    asked. Its death is an EnvironmentFailure of each.
    """

    def __init__(self, worker: Worker, number: int, spec: Spec, parts: ContractParts, task_name: str) -> None:
        self.spec, self.contract_parts, self.task_name = spec, parts, task_name
        self._worker, self._number, self._is_asked = worker, number, False

    def ask(self, method: str, *arguments: Any) -> None:
        """Begin to compute what the next call of this method returns."""
        with suppress(OSError):  # of a dead process; it is seen when it does not answer
            self._worker.tell((self._number, method, arguments))
        self._is_asked = True

    def __getattr__(self, method: str) -> Callable[..., Any]:
        """Return a method of the environment, which is called in its process."""
        return partial(self._answer, method)

    def close(self) -> None:
        """Do nothing: `Workers.close` closes all."""

    def _answer(self, method: str, *arguments: Any) -> Any:
        if not self._is_asked:
            self.ask(method, *arguments)
        self._is_asked = False
        return self._worker.answer()


class Worker(Child):
    """The parent's end of a process that steps environments."""

    def answer(self) -> Any:
        """Return the next answer, or raise what was raised there; EnvironmentFailure where the process is gone."""
        try:
            answer, error, details = self.connection.recv()
        except (EOFError, OSError):
            raise EnvironmentFailure(f"its environments' process: {self.cause_of_death()}") from None
        if error:
            raise error from (RuntimeError(details) if details else None)
        return answer


def _serve(
    connection: Connection,
    task: Task,
    environment_arguments: dict[str, Any] | None,
    number: int,
    seed: int,
    events: Sequence[str],
) -> None:
    """Do what environments are asked, until there is no more or the parent is gone."""
    seed_globals(seed)
    environments: list[Environment] = []
    names = {info_name(event) for event in events}
    with ExitStack() as stack, suppress(EOFError, OSError):

        def make() -> tuple[Any, ...]:
            for _ in range(number):
                environments.append(Environment(task, environment_arguments))
                stack.callback(environments[-1].close)
            return environments[0].spec, environments[0].contract_parts, environments[0].task_name

        connection.send(_outcome(names, make))
        while asked := connection.recv():
            place, method, arguments = asked
            connection.send(_outcome(names, getattr(environments[place], method), *arguments))


def _outcome(names: set[str], function: Any, *arguments: Any) -> tuple[Any, Exception | None, str]:
    """Return what a call returns, or raises, with the traceback of its cause."""
    try:
        result = function(*arguments)
        if function.__name__ == "step_environment_scale":
            told = {name: result[-1][name] for name in names & result[-1].keys()}
            result = (*result[:-1], numbers_in(told))  # its info may hold what cannot be sent
        return result, None, ""
    except Exception as error:
        return None, error, "".join(traceback.format_exception(error)) if error.__cause__ else ""


def choose_processes(task: Task, environment_arguments: dict[str, Any] | None, environments: int, cores: int) -> int:
    """Return how many processes pay for so many environments: one for each core where a step takes long, else none."""
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
