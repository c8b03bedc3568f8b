"""Train the runs of a study on a Ray cluster: one task per run, retried from its checkpoint if a node is lost."""

from __future__ import annotations

import logging
import os
import socket
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from csac.record.files import is_locked
from csac.record.run import LOCK, StorageFailure
from csac.training.signals import stop_requested
from csac.training.supervisor import record_failure
from csac.training.watch import Watcher
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from csac.training.program import Program

RETRIES = 5  # of a run whose node or process was lost
SECONDS_FOR_LOCK = 300.0  # a node that vanished keeps its locks until the file server's lease ends, a minute or two
SECONDS_BETWEEN_LOOKS = 0.5
SECONDS_TO_ANSWER = 10.0


@dataclass(frozen=True)
class Cluster:
    """A Ray cluster, and what each run requests. The runs' folder must have the same path on every node."""

    address: str | None = None
    """HOST:PORT, `auto`, or None to start a cluster on this machine."""
    cores: int = 1
    gpus: float = 0.0
    memory: float = 0.0
    """GiB that each run requests; 0 requests none in particular."""

    def run(
        self, programs: Sequence[Program], watcher_of: Callable[[Program], Watcher], should_stop: Callable[[], bool]
    ) -> None:
        """Run each program as a task. A task whose node is lost continues on another, from the newest checkpoint.

        Raises InputError if Ray is not installed, there is no cluster, or a run cannot start, and StorageFailure if a
        run directory can no longer be written.
        """
        ray = self._connect()
        try:
            from ray.util.queue import Queue
            from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

            here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
            messages = Queue(actor_options={"num_cpus": 0, "scheduling_strategy": here})
            task = ray.remote(
                num_cpus=self.cores,
                num_gpus=self.gpus or None,
                memory=int(self.memory * 2**30) or None,
                max_retries=RETRIES,
                max_calls=1,  # XLA counts its cores only once per process
            )(_train)
            running = {task.remote(program, index, messages): program for index, program in enumerate(programs)}
            errors: list[Exception] = []
            is_stopping = False
            while running:
                if (should_stop() or errors) and not is_stopping:
                    is_stopping = True
                    for reference in running:
                        ray.cancel(reference)  # sends SIGINT to the task, which saves the run
                over, _ = ray.wait(list(running), num_returns=1, timeout=SECONDS_BETWEEN_LOOKS)
                for index, name, arguments in messages.get_nowait_batch(messages.size()):
                    getattr(watcher_of(programs[index]), name)(*arguments)
                for reference in over:
                    program = running.pop(reference)
                    try:
                        ray.get(reference)
                    except ray.exceptions.RayError as error:
                        cause = getattr(error, "cause", None)
                        if isinstance(cause, InputError | StorageFailure):  # it ends the whole study
                            errors.append(cause)
                        elif not is_stopping:
                            record_failure(program, watcher_of(program), error)
            if errors:
                raise errors[0]
        finally:
            ray.shutdown()

    def _connect(self) -> Any:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        try:
            import ray
        except ImportError:
            raise InputError("Ray is not installed: pip install '.[cluster]' in a clone of csac") from None
        host, _, port = (self.address or "").rpartition(":")
        if host and port.isdigit():  # Ray itself would retry for minutes
            try:
                socket.create_connection((host, int(port)), SECONDS_TO_ANSWER).close()
            except OSError as error:
                raise InputError(f"no Ray cluster can be reached at {self.address}: {error}") from None
        options: dict[str, Any] = {"address": self.address} if self.address else {"include_dashboard": False}
        try:
            ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise InputError(f"no Ray cluster can be reached at {self.address}: {error!s:.200}") from None
        return ray


def _train(program: Program, index: int, messages: Any) -> None:
    """Train a program on a node."""
    import ray

    watcher = _QueueWatcher(index, messages)
    from csac.training.devices import begin_with  # imports JAX
    from csac.training.running import train_program

    begin_with(program.threads)
    for path in program.directories:  # the lock of a lost node becomes free; another process may keep it
        lock, end = path / LOCK, time.monotonic() + SECONDS_FOR_LOCK
        while lock.exists() and is_locked(lock) and time.monotonic() < end:
            time.sleep(1.0)
    try:
        with stop_requested() as request:
            train_program(program, watcher, request.is_set)
    except (InputError, StorageFailure):
        raise
    except Exception as error:
        record_failure(program, watcher, error)
    finally:
        ray.wait(watcher.sent, num_returns=len(watcher.sent))


class _QueueWatcher(Watcher):
    """Send the events of a run to the driver."""

    def __init__(self, index: int, messages: Any) -> None:
        self.index, self.messages, self.sent = index, messages, list[Any]()

    def send(self, name: str, *arguments: Any) -> None:
        # Do not wait until it is received: Ray would lend the core of a waiting task to another run.
        self.sent = [*self.sent[-100:], self.messages.actor.put.remote((self.index, name, arguments))]
