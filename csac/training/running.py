"""Train the runs of one program in this process: lock them, roll them back, and run the training loop."""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from csac.record.run import RunDirectory
from csac.seeds import name_seeds
from csac.tasks.preflight import globals_seeded
from csac.training.devices import choose_device, threads_in_use
from csac.training.loop import Loop
from csac.training.provenance import provenance
from csac.training.resume import continuation, roll_back
from csac.training.signals import storage_failures
from csac.training.stalls import stalls_noted
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from csac.training.program import Program
    from csac.training.resume import ResumePoint
    from csac.training.watch import Watcher


def train_program(program: Program, watcher: Watcher, should_stop: Callable[[], bool]) -> None:
    """Train the runs of a program in this process, from their newest checkpoint or their beginning.

    Raises InputError if a run is in use or cannot resume, and StorageFailure as `train`.
    """
    runs = [RunDirectory.open(path) for path in program.directories]
    with ExitStack() as stack, storage_failures(runs[0].path.parent):
        for run in runs:
            stack.enter_context(run.locked())
            run.manifest = RunDirectory.open(run.path).manifest  # may have changed before we got the lock
        choose_device(runs[0].config.device)
        stack.enter_context(globals_seeded(runs[0].seed))  # the caller's generators are as before afterwards
        points = roll_back(runs)
        current = provenance(program.task, program.command, threads_in_use())
        current["program"] = tuple(run.seed for run in runs)
        for run, point in zip(runs, points, strict=True):
            _note_begin(run, point, current, watcher)
        try:
            loop = Loop(program, runs, points, watcher)
        except InputError as error:
            for run in (run for run in runs if run.manifest.state == "running"):
                run.log(str(error))
                run.update_manifest(state="interrupted")
            raise
        stack.callback(loop.close)
        stack.enter_context(stalls_noted(lambda: loop.step, watcher.note, name_seeds([run.seed for run in runs])))
        try:
            loop.run(should_stop)
        finally:
            is_incomplete = loop.step < loop.steps or bool(loop.evaluations.broken_off)
            stopped = not loop.has_returned or (is_incomplete and should_stop())
            for run in runs:
                if run.manifest.state == "running":
                    run.update_manifest(state="interrupted" if stopped else "finished")


def _note_begin(run: RunDirectory, point: ResumePoint, current: dict[str, Any], watcher: Watcher) -> None:
    """Record in a run's manifest where and how it begins or resumes."""
    before, history = run.manifest, run.manifest.history
    after = dataclasses.replace(before, **current)
    if before.process is not None:
        entry, lines = continuation(before, after, point)
        history, current = (*history, entry), {**current, "command": before.command}
        for line in lines:
            run.log(line)
            watcher.note(f"seed {run.seed}: {line}")
    run.update_manifest(
        **current, state="running", failure="", history=history, steps_done=point.step, last_checkpoint=point.step
    )
