"""Cells on many machines, through Ray: one task for each, tried again from its checkpoint where a node is lost."""

from __future__ import annotations

import fcntl
import logging
import os
import platform
import socket
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from csac.processes import move_to, usable_cores
from csac.studies.cells import is_in_use, read_history, write_history
from csac.studies.engines import SECONDS_BETWEEN_LOOKS
from csac.studies.job import Ended, Job, Message, Started, Stopped, execute
from csac.training.signals import signals_noted
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.studies.engines import Tell

SECONDS_TO_ANSWER = 10.0
RETRIES = 5  # of a cell whose node or process was lost
SECONDS_FOR_LOCK = 300.0  # a node that vanished keeps its locks until the file server's lease ends, a minute or two
SECONDS_BETWEEN_TRIES = 5.0


@dataclass(frozen=True)
class Request:
    """What a cell asks of a node."""

    cores: int = 1
    gpus: float = 0.0
    memory: float = 0.0
    """GiB that a node must have to spare; 0 asks for none in particular."""


def run_on_ray(jobs: Sequence[Job], tell: Tell, address: str | None, request: Request) -> None:
    """Run each job as a task of the Ray cluster at `address`; None is one on this machine, made for the purpose.

    The folder of the runs must be at the same path on every node. A task whose node is lost is given to another, which
    goes on from the newest checkpoint.

    Raises:
        InputError: Ray is not installed, or there is no cluster at the address.
    """
    ray = _connected(address)
    try:
        _run(ray, [replace(job, path=job.path.absolute()) for job in jobs], tell, request)
    finally:
        ray.shutdown()


def _connected(address: str | None) -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
    except ImportError:
        raise InputError("Ray is not installed: pip install '.[cluster]' in a clone of csac") from None
    _require_listener(address)
    try:
        options: dict[str, Any] = {"address": address} if address else {"include_dashboard": False}
        ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError) as error:
        text = " ".join(str(error).split())
        raise InputError(f"no Ray cluster can be reached at {address}: {text:.200}") from None
    return ray


def _require_listener(address: str | None) -> None:
    """Raise InputError where nobody listens: Ray itself would try for minutes."""
    host, _, port = (address or "").rpartition(":")
    if host and port.isdigit() and "/" not in host:
        try:
            socket.create_connection((host, int(port)), SECONDS_TO_ANSWER).close()
        except OSError as error:
            raise InputError(f"no Ray cluster can be reached at {address}: {error.strerror or error}") from None


def _run(ray: Any, jobs: Sequence[Job], tell: Tell, request: Request) -> None:
    from ray.util.queue import Queue
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    messages = Queue(actor_options={"num_cpus": 0, "scheduling_strategy": here})
    task = ray.remote(
        num_cpus=request.cores,
        num_gpus=request.gpus or None,
        memory=int(request.memory * 2**30) or None,
        max_retries=RETRIES,
        max_calls=1,  # XLA counts its cores once in a process
    )(_work)
    with signals_noted() as received:
        running = {task.remote(job, request.cores, messages): job for job in jobs}
        is_stopping = False
        while running:
            if received and not is_stopping:
                is_stopping = True
                for reference in running:
                    ray.cancel(reference)  # raises SIGINT there, on which what was learnt is saved
            over, _ = ray.wait(list(running), num_returns=1, timeout=SECONDS_BETWEEN_LOOKS)
            for message in messages.get_nowait_batch(messages.size()):
                tell(message)
            for reference in over:
                tell(_ended(ray, reference, running.pop(reference), is_stopping))
        if received:
            raise Stopped(received[0])


def _ended(ray: Any, reference: Any, job: Job, is_stopping: bool) -> Ended:
    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        if is_stopping:
            return Ended(job.cell.key, "stopped")
        reason = " ".join(str(error).split())[:300]
    with suppress(OSError):
        write_history(job.path, {**read_history(job.path), "failure": reason})
    return Ended(job.cell.key, "failed", reason)


def _work(job: Job, cores: int, messages: Any) -> Ended:
    """Run a job on a node."""
    import ray

    with _Cores(cores):
        context, sent = ray.get_runtime_context(), []

        def tell(message: Message) -> None:
            # Nobody waits until it was heard: Ray would lend the core of who waits to another cell.
            sent.append(messages.actor.put.remote(message))

        tell(Started(job.cell.key, f"{platform.node()} {context.get_node_id()[:6]}"))
        try:
            if _is_retry(context):
                _wait_until_free(job.path)
            return execute(job, tell)
        except Stopped:
            return Ended(job.cell.key, "stopped")
        finally:
            ray.wait(sent, num_returns=len(sent))


def _is_retry(context: Any) -> bool:
    """Whether Ray runs this task again, which no documented function of its tells; where none does, it is not."""
    with suppress(AttributeError):
        return context.worker.core_worker.get_current_task_attempt_number() > 0
    return False


def _wait_until_free(path: Path) -> None:
    """Wait for the lock of a run that was lost with its node; but not for ever, as another process may have it."""
    end = time.monotonic() + SECONDS_FOR_LOCK
    while is_in_use(path) and time.monotonic() < end:
        time.sleep(SECONDS_BETWEEN_TRIES)


class _Cores:
    """So many cores of a node that no other cell has, where there are any: Ray counts cores, but hands out none."""

    def __init__(self, count: int) -> None:
        self.count, self.files = count, list[IO[str]]()

    def __enter__(self) -> None:
        folder = Path(tempfile.gettempdir(), f"csac-cores-{os.getuid()}")
        folder.mkdir(exist_ok=True)
        free = [core for core in usable_cores() if len(self.files) < self.count and self._claim(folder / str(core))]
        if len(free) == self.count:
            move_to(free)

    def __exit__(self, *_: object) -> None:
        for file in self.files:
            file.close()

    def _claim(self, path: Path) -> bool:
        file = open(path, "w")  # noqa: SIM115  held as long as the cell runs
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            return False
        self.files.append(file)
        return True
