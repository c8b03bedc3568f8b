"""What `csac tune` does: the search, what it shows meanwhile, and what it leaves."""

from __future__ import annotations

import shlex
import signal
import sys
from contextlib import closing
from typing import TYPE_CHECKING

from rich.text import Text

from csac.checks import check_whole
from csac.console.tables import Fitted, make_console, program
from csac.studies.job import Stopped
from csac.studies.shared_study import Question, SharedStudy, import_optuna
from csac.studies.tune import MOST_TRIALS, tune
from csac.studies.tune_progress import TuneProgress
from csac.tasks.environment import Environment
from csac.tasks.preflight import try_task
from csac.training.options import check_groups

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rich.console import Console


def run_tune(question: Question, directory: Path, trials: int, groups: int | None, arguments: Sequence[str]) -> int:
    """Search, and return the exit code; `arguments` are what was typed after `csac tune`.

    Raises:
        InputError: fewer than one trial, no such task, groups that the seeds do not fill, a device that there is not,
            Optuna is missing, or a directory of something else.
        StorageFailure: the directory can no longer be written.
    """
    from csac.training.devices import choose_device  # JAX

    check_whole("trials", trials, 1, MOST_TRIALS)
    if groups is not None:
        check_groups(groups, question.seeds)
    import_optuna()
    choose_device(question.device)
    with closing(Environment(question.task, question.environment_arguments)) as environment:  # says what is to be said
        try_task(environment, question.environment_arguments)
    study, line = SharedStudy(directory, question), shlex.join(["csac", "tune", *arguments])
    console = make_console()
    stopped = None
    with closing(TuneProgress(trials, question.steps, console)) as progress:
        progress.start(study)
        try:
            tune(study, trials, progress, groups=groups, command=line)
        except Stopped as stop:
            stopped = stop
    _conclude(study, line, console)
    if stopped:
        name, again = signal.Signals(stopped.signal_number).name, shlex.join([program(), "tune", *arguments])
        print(
            f"csac: stopped by {name}; the trial is saved. To go on, type the same line again: {again}", file=sys.stderr
        )
        return 128 + stopped.signal_number
    return 0 if study.best() else 3


def _conclude(study: SharedStudy, line: str, console: Console) -> None:
    """Write the report, show the best trials, and say what to type next."""
    from csac.studies.tune_report import SHOWN, best_command, trials_table, write_report  # matplotlib is slow to import

    results, best = study.results(), study.best()
    paths = write_report(study, line)
    if results:
        console.print(Fitted(trials_table(study.question, results, SHOWN)))
    others = sum(result.state == "running" for result in results)
    if others:
        console.print(f"{others} more are being run by other processes", soft_wrap=True)
    if best is None:
        console.print(Text("no trial is complete", "red"))
    else:
        command = best_command(study.question, best.values)
        console.print(Text.assemble(("best     ", "dim"), command), soft_wrap=True)
    report = next(path for path in paths if path.name == "report.md")
    console.print(Text.assemble(("report   ", "dim"), str(report)), soft_wrap=True)
