"""Supervise training processes: start them, pass on their messages and signals, restart those that die."""

from __future__ import annotations

import queue
import threading
import traceback
from collections import deque
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any

from csac.processes import Child, end
from csac.record.run import RunDirectory, StorageFailure
from csac.seeds import name_seeds
from csac.tasks.failures import one_line
from csac.training.callbacks import STOPPED
from csac.training.resume import can_resume
from csac.training.watch import Watcher
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from csac.training.callbacks import Answer, Event
    from csac.training.program import Program

SECONDS_TO_CLOSE = 5.0  # for a process to close its environments


def supervise(
    programs: Iterable[Program],
    watcher_of: Callable[[Program], Watcher],
    should_stop: Callable[[], bool],
    workers: int,
    turns: int | None = None,
) -> None:
    """Run each program in its own process, `workers` at a time, until all have ended or been stopped.

    `watcher_of` returns the watcher of a program. A process that dies is replaced once: its runs resume from their
    newest checkpoint. If it dies again, or they cannot resume, they fail. With `turns`, only this many processes train
    at a time, a few hundred steps each, and the one furthest behind is next: five that share two cores freely make four
    fifths of the steps. Raises InputError if a program's arguments are wrong, such as a checkpoint that does not fit,
    and StorageFailure if a run directory can no longer be written; the other programs are stopped and saved.
    """
    waiting, running, over = deque(programs), {}, []
    restarted: set[Path] = set()
    errors: list[Exception] = []
    try:
        while running or (waiting and not errors and not should_stop()):
            while waiting and len(running) < workers and not errors and not should_stop():
                worker = _Worker(waiting.popleft())
                running[worker.connection] = worker
            if errors or should_stop():
                for worker in running.values():
                    worker.stop()
            _give_turns(running.values(), turns)
            ready = set(wait(list(running), timeout=0.1))
            for worker in list(running.values()):
                is_dead = worker.process.exitcode is not None  # a subprocess of its task may keep the pipe open
                if worker.connection not in ready and not is_dead:
                    continue
                message = worker.receive()
                if message is None:
                    del running[worker.connection]
                    waiting.extend(_replace(worker, watcher_of(worker.program), restarted, errors))
                elif message[0] == "over":
                    over.append(running.pop(worker.connection))
                elif message[0] == "error":
                    errors.append(message[1])
                elif message[0] == "turn":
                    worker.step, worker.has_turn = message[1], False
                else:
                    answer = getattr(watcher_of(worker.program), message[0])(*message[1:])
                    if message[0] == "call":
                        worker.tell(("answer", answer))
    finally:
        for worker in running.values():
            worker.kill()
        end(over, SECONDS_TO_CLOSE)
    if errors:
        raise errors[0]


def _give_turns(workers: Iterable[_Worker], turns: int | None) -> None:
    """Give free turns to those of the waiting workers that are furthest behind."""
    workers = list(workers)
    waiting = sorted((worker for worker in workers if worker.has_turn is False), key=lambda worker: worker.step)
    free = len(workers) if turns is None else turns - sum(worker.has_turn is True for worker in workers)
    for worker in waiting[: max(free, 0)]:
        worker.has_turn = True
        worker.tell(("turn", None))


def _replace(worker: _Worker, watcher: Watcher, restarted: set[Path], errors: list[Exception]) -> list[Program]:
    """Return the program if it is to restart, or record how its runs failed."""
    try:
        reason = worker.cause_of_death()
    except InputError as error:
        errors.append(error)
        return []
    if worker.is_stopping:  # `resume` continues its runs from their newest checkpoint
        return []
    runs = [RunDirectory.open(path) for path in worker.program.directories]
    # Before its first turn a worker may have died with the states that its runs had when they were resumed.
    over = ("failed",) if worker.has_turn is None else ("failed", "finished")
    sound = [run for run in runs if run.manifest.state not in over]
    is_first = restarted.isdisjoint(worker.program.directories)
    if sound and is_first and all(map(can_resume, sound)):
        restarted.update(worker.program.directories)
        for run in sound:
            run.log(f"{reason}; its process is restarted")
        watcher.note(f"{name_seeds([run.seed for run in sound])}: {reason}; restarting from the newest checkpoint")
        return [worker.program._replace(directories=tuple(run.path for run in sound))]
    for run in sound:
        step = run.manifest.steps_done
        run.log(f"stopped at step {step}: {reason}")
        run.update_manifest(state="failed", failure=f"step {step}: {reason}")
        watcher.failed(run.seed, step, reason if is_first else f"{reason}, for the second time")
    return []


class _Worker(Child):
    """The parent's end of one program's process."""

    def __init__(self, program: Program) -> None:
        super().__init__(_work, program)
        self.program, self.is_stopping = program, False
        self.has_turn: bool | None = None  # False while it waits for one, None before it first asks
        self.step = 0

    def receive(self) -> tuple[Any, ...] | None:
        """Return the next message, or None if the process is gone."""
        with suppress(EOFError, OSError):
            if self.connection.poll(0.0) or self.process.exitcode is None:
                return self.connection.recv()
        return None

    def stop(self) -> None:
        """Ask the process to save and end."""
        if not self.is_stopping:
            self.is_stopping = True
            self.tell(("stop", None))


def _work(connection: Connection, program: Program) -> None:
    """Train a program; runs in the child process."""
    from csac.training.devices import begin_with  # JAX
    from csac.training.running import train_program

    begin_with(program.threads)

    watcher = _RemoteWatcher(connection)
    try:
        train_program(program, watcher, watcher.stopped.is_set)
        connection.send(("over",))
    except (BrokenPipeError, EOFError, ConnectionResetError):
        return  # the parent is gone
    except (InputError, StorageFailure) as error:
        if isinstance(error, InputError):
            seeds = [RunDirectory.open(path).seed for path in program.directories]
            error = InputError(f"{name_seeds(seeds)}: {error}")
        connection.send(("error", error))
        connection.send(("over",))
    except Exception as error:
        record_failure(program, watcher, error)
        connection.send(("over",))


def record_failure(program: Program, watcher: Watcher, error: Exception) -> None:
    """Record and report that the runs of a program failed with an unexpected error."""
    reason = one_line(error)
    for path in program.directories:
        run = RunDirectory.open(path)
        run.log(f"{reason}\n{''.join(traceback.format_exception(error))}")
        run.update_manifest(state="failed", failure=f"step {run.manifest.steps_done}: {reason}")
        watcher.failed(run.seed, run.manifest.steps_done, reason)


class _RemoteWatcher(Watcher):
    """Sends events to the parent process, and receives its messages in a separate thread."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self.stopped = threading.Event()
        self._answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._turns: queue.SimpleQueue[None] = queue.SimpleQueue()
        threading.Thread(target=self._listen, daemon=True).start()

    def send(self, name: str, *arguments: Any) -> None:
        self._connection.send((name, *arguments))

    def wait_for_turn(self, step: int) -> None:
        if not self.stopped.is_set():
            self.send("turn", step)
            self._turns.get()

    def call(self, event: Event) -> Answer:
        expects_answer = not self.stopped.is_set()
        self.send("call", event)
        answer = self._answers.get() if expects_answer else STOPPED
        if answer.failed:
            self.stopped.set()
        return answer

    def _listen(self) -> None:
        while not self.stopped.is_set():
            try:
                message = self._connection.recv()
            except (EOFError, OSError):
                message = ("stop", None)
            if message[0] == "answer":
                self._answers.put(message[1])
                continue
            if message[0] == "stop":
                self.stopped.set()
                self._answers.put(STOPPED)
            self._turns.put(None)
