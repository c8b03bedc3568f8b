"""Route training events, in the process that called `train`, to the progress reporter, the callbacks and the curve."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

from csac.checks import check_flag
from csac.tasks.failures import one_line
from csac.tasks.perturbations import by_step, perturbations_of
from csac.training.callbacks import Answer

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from csac.record.run import RunDirectory
    from csac.record.sets import RunSet
    from csac.training.callbacks import Callbacks, Event


class Watcher:
    """Receives progress, results and notes while a program trains. All go to `send`, which does nothing here."""

    def send(self, name: str, *arguments: Any) -> None:
        """Forward a call of the method of this name."""

    def wait_for_turn(self, step: int) -> None:
        """Wait until this program, which has made `step` steps, may continue."""

    def progress(self, steps: Mapping[int, int]) -> None:
        """Receive how many steps each seed has made."""
        self.send("progress", dict(steps))

    def evaluated(self, step: int, returns: Mapping[int, float]) -> None:
        """Receive the mean return of each seed's evaluation."""
        self.send("evaluated", step, dict(returns))

    def call(self, event: Event) -> Answer:
        """Pass an event to the callbacks, and return their answer."""
        return Answer()

    def failed(self, seed: int, step: int, reason: str) -> None:
        """Receive the failure of a seed and its reason."""
        self.send("failed", seed, step, reason)

    def note(self, text: str) -> None:
        """Receive a line for the user."""
        self.send("note", text)

    def note_of(self, run: RunDirectory, text: str) -> None:
        """Write a line into a run's log, and receive it."""
        run.log(text)
        self.note(text)


class Watch(Watcher):
    """Passes events to the callbacks, and to a reporter on the terminal if `progress` is true. Raises InputError."""

    def __init__(self, progress: bool, callbacks: Callbacks) -> None:
        check_flag("progress", progress)
        self.callbacks, self.reporter = callbacks, None
        if progress:
            from csac.console.progress import Reporter

            self.reporter = Reporter()

    def send(self, name: str, *arguments: Any) -> None:
        """Call the method of the reporter, if there is one."""
        if self.reporter:
            getattr(self.reporter, name)(*arguments)

    def call(self, event: Event) -> Answer:
        """Pass an event to the callbacks; note which of them ends the runs."""
        answer = self.callbacks.call(event)
        if answer.stopped_by:
            seeds = ", ".join(str(moment.seed) for moment in event.moments)
            self.note(f"seed {seeds}: stopped early at step {event.moments[0].step:,} ({answer.stopped_by})")
        return answer

    def failed(self, seed: int, step: int, reason: str) -> None:
        """Report that a seed failed; without a reporter, warn."""
        super().failed(seed, step, reason)
        if not self.reporter:
            with warnings.catch_warnings():
                warnings.simplefilter("always", RuntimeWarning)  # as an error it would end the other seeds too
                warnings.warn(f"seed {seed} failed at step {step}: {reason}", RuntimeWarning, stacklevel=2)

    def is_over(self, run: RunDirectory) -> bool:
        """Return whether a run needs no more training: all its steps are made, or a callback would still end it."""
        is_complete = run.manifest.steps_done >= run.config.steps
        if run.config.evaluation_interval and not len(run.evaluations):  # they were lost: a checkpoint has them
            return False
        return run.manifest.state == "finished" and (is_complete or self.callbacks.would_stop_again(run))


def draw_curve(runs: RunSet, note: Callable[[str], None]) -> None:
    """Plot the evaluations of a set into its `curve.png`; if that fails, only note it."""
    rows = runs.sound_evaluations if len(runs.sound_evaluations) else runs.evaluations
    if not len(rows):
        return
    from csac.record.plots import learning_curve  # matplotlib is slow to import

    changes = by_step(perturbations_of(runs.config.perturbations))
    marks = [(step, text) for step, text in changes if step <= rows["step"].max()]
    try:
        learning_curve([(runs.config.title, rows)], runs.curve, title=runs.config.task, marks=marks)
    except Exception as error:
        note(f"note: the curve could not be drawn ({one_line(error)})")
