"""`train`: one call from a task to a run directory. The command line calls nothing else."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from contextlib import closing, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from csac.checks import check_callable, check_flag, check_path
from csac.processes import end_if_unguarded
from csac.record.manifest import as_kept
from csac.record.run import RunDirectory
from csac.record.statistics import mean_returns
from csac.record.wandb import WandbLog, import_wandb, logs_to_wandb
from csac.tasks.perturbations import by_step, perturbations_of
from csac.tasks.trust import refuse_untrusted
from csac.training.checkpoint import Checkpoints, steps_in
from csac.training.compilation import tidy_programs
from csac.training.footprint import memory_needed
from csac.training.interruptions import (
    Interrupted,
    StoppedAtOnce,
    callers_own,
    caught_signals,
    storage_failures_told,
)
from csac.training.learner import misfit
from csac.training.messages import Settings
from csac.training.plan import Before, Plan, algorithm_of, check_algorithm, make_plan, options_of
from csac.training.provenance import provenance
from csac.training.recorder import Recorder
from csac.training.resume import BEGINNING, Restart, can_go_on, refuse_differences, roll_back
from csac.training.scheduler import run_groups
from csac.types import InputError

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable

    from typing_extensions import Unpack

    from csac.console.progress import Reporter
    from csac.record.manifest import Manifest, State
    from csac.record.scalars import Log
    from csac.tasks.registry import Task
    from csac.training.options import PlanOptions
    from csac.types import Algorithm

    OnEvaluation = Callable[[int, dict[int, float]], Any]
    StopWhen = Callable[[int, dict[int, float]], bool]

_STOPPING = "stopping at the next step where all can be saved; once more to leave at once"


def train(
    algorithm: Algorithm,
    task: Task,
    *,
    directory: str | Path | None = None,
    resume: bool = False,
    start_from: str | Path | None = None,
    tensorboard: bool = True,
    wandb: bool | str = False,
    reporter: Reporter | None = None,
    command: str | None = None,
    on_evaluation: OnEvaluation | None = None,
    stop_when: StopWhen | None = None,
    **options: Unpack[PlanOptions],
) -> RunDirectory:
    """Train independent seeds of an algorithm on a task and return the finished run.

    Args:
        algorithm: a hyperparameter dataclass such as `CSAC()`.
        task: a Gymnasium id, `module:Id`, or a callable that makes an environment.
        directory: the run directory; by default `runs/<task>/<algorithm>/<date-time>`.
        resume: go on with the run in `directory`, where there is one, from its newest checkpoint.
        start_from: `DIRECTORY` or `DIRECTORY@STEP` of a run: begin with a copy of its checkpoint of that step.
        tensorboard: whether to write TensorBoard files.
        wandb: whether to log to Weights & Biases too (the extra `wandb`), or the project to log to: a W&B run for each
            seed, those of a run directory in one group. Training never waits for W&B, nor fails with it.
        reporter: where progress is shown; None is silent, but for a warning about each seed that fails.
        command: the command line, for the manifest.
        on_evaluation: called as `on_evaluation(step, {seed: mean return})` after each evaluation.
        stop_when: called in the same way; training ends early, and counts as finished, once it returns True. With
            `resume` it is asked once more of the last evaluation of a run that had ended early, which ends there again
            unless it has become more demanding.
        **options: `steps`, `seeds`, `first_seed`, `device`, `evaluation_interval`, `evaluation_episodes`,
            `checkpoint_interval` and `keep_checkpoints`, as `csac.training.options.Options` explains them, and

            - `environment_arguments`: keyword arguments for the environment;
            - `perturbations`: changes of the task, in training and evaluations, such as `("friction=1.5@300000",)`: see
              `Perturbation`. What a run begins with (`start_from`) keeps what had happened to it; with None also what
              was still to happen;
            - `evaluation_seed`: what the first evaluation episode is reset with, the next ones with the numbers after
              it: 1,000,000 by default, 2,000,000 are those of `evaluate`, 3,000,000 those of `csac tune`;
            - `events`: names in the `info` of an evaluation episode's last step (booleans or numbers): each becomes a
              column of evaluations.csv, beside those that the task has by itself. None keeps those of the run that
              this one goes on from or begins with;
            - `groups`: processes to split the seeds over: 1, the default, trains in this process, None chooses by the
              cores. With more than one, a script needs the usual `if __name__ == "__main__":` guard;
            - `evaluation_processes`: processes in which each group evaluates while it trains on; 0, the default,
              evaluates in line, None chooses by the cores. The run is the same to the last bit; `on_evaluation` is
              called later. A script needs the guard here too. With `stop_when`, which would come too late, evaluation
              is in line.

    Raises:
        InputError: a mistake in the arguments; nothing has been written then.
        Interrupted: on SIGINT or SIGTERM, after everything was saved, if it saves checkpoints and no process that
            trains was still starting or far behind the others; the message says from where the run can go on.
        StoppedAtOnce: on a second signal; what came after the last checkpoint is lost.
        StorageFailure: the run directory can no longer be written; it is as sound as if the run had been killed.
    """
    end_if_unguarded()
    check_algorithm(algorithm)
    check_flag("resume", resume)
    check_flag("tensorboard", tensorboard)
    if not isinstance(wandb, str) or wandb.lower() in ("", "yes", "no", "true", "false"):
        check_flag("wandb", wandb)
    check_callable("on_evaluation", on_evaluation)
    check_callable("stop_when", stop_when)
    if directory is not None:
        check_path("directory", directory)
    elif resume:
        raise InputError(
            "resume goes on with the run in `directory`: give one (csac.resume(directory) does without task)"
        )
    if reporter is not None and (isinstance(reporter, type) or not callable(getattr(reporter, "note", None))):
        raise InputError(f"reporter is an object such as csac.console.progress.Reporter(), not {reporter!r:.40}")
    if wandb:
        import_wandb()
    watchers = Watchers(reporter, tensorboard, wandb, on_evaluation, stop_when, [])
    before = Before.find(directory, resume, start_from)
    plan, spec = make_plan(algorithm, task, options, before, may_evaluate_beside=stop_when is None)
    notes = [memory_needed(plan, spec, goes_on=before.run is not None), *_warmup_note(plan)]
    manifest = wanted = as_kept(plan.manifest(**provenance(task, command)))
    has_schedule, defaults = algorithm.cadence.has_schedule, _defaults(algorithm)
    if before.existing:
        run = before.existing
        refuse_differences(run, wanted, has_schedule, defaults)
    elif before.source:
        fits = functools.partial(misfit, algorithm, spec, plan.steps)
        before.source.refuse_misfit(wanted, has_schedule, defaults, fits)
        manifest = before.source.begun(wanted, defaults)
        run = before.create(plan, manifest)
    else:
        run = before.create(plan, wanted)
    with storage_failures_told(run, watchers.failures), run.locked():
        if before.existing:
            run.read_again()  # another process may have gone on with it, and ended, before we had the lock
            refuse_differences(run, wanted, has_schedule, defaults)
        if before.source:
            before.copy_source(run, manifest)
            made = before.source.run.manifest
            made = dataclasses.replace(made, inexact_seeds=run.manifest.inexact_seeds)
            return _go_on(run, plan, made, wanted, notes, watchers)
        if before.existing:
            return _go_on(run, plan, run.manifest, wanted, notes, watchers)
        try:
            return _run(run, plan, notes, watchers, BEGINNING)
        except InputError:  # such as a script without a guard: once mended, it begins in the same directory
            if not (run.manifest.steps_done or len(run.evaluations) or steps_in(run.checkpoints)):
                run.discard()
            raise


def resume(
    directory: str | Path,
    *,
    steps: int | None = None,
    evaluation_processes: int | None = 0,
    trust_task: bool = False,
    reporter: Reporter | None = None,
    command: str | None = None,
    on_evaluation: OnEvaluation | None = None,
    stop_when: StopWhen | None = None,
) -> RunDirectory:
    """Go on with a run from its newest checkpoint; everything but a larger number of `steps` comes from its manifest.

    `trust_task` lets the task import its module though nobody has named it here (`csac.tasks.trust`);
    `evaluation_processes`, `reporter` and what follows it are as in `train`.

    Raises:
        InputError: there is no such run, it cannot go on (the message says why), or its task is a Python function:
            call `train` with it and `resume=True` then.
        Interrupted: as `train`.
        StorageFailure: as `train`.
    """
    run = RunDirectory.open(directory)
    task, options = options_of(run)
    refuse_untrusted(task, run.path, trust_task)
    options["evaluation_processes"], options["groups"] = evaluation_processes, None
    if steps is not None:
        options["steps"] = steps
    return train(
        algorithm_of(run.manifest),
        task,
        directory=directory,
        resume=True,
        tensorboard=run.tensorboard.exists(),
        wandb=logs_to_wandb(run) and _has_wandb(reporter),
        reporter=reporter,
        command=command,
        on_evaluation=on_evaluation,
        stop_when=stop_when,
        **options,
    )


def _has_wandb(reporter: Reporter | None) -> bool:
    """Whether W&B is still there for a run that was logged to it; it goes on without as well."""
    try:
        import_wandb()
    except InputError as error:
        if reporter:
            reporter.note(f"note: this run was logged to W&B, and is no more: {error}")
        return False
    return True


class Watchers(NamedTuple):
    """Who is told what happens, beside the run directory."""

    reporter: Reporter | None
    tensorboard: bool
    wandb: bool | str
    on_evaluation: OnEvaluation | None
    stop_when: StopWhen | None
    failures: list[OSError]
    """What the caller's functions raised that is no failure of the run directory."""

    def tell(self, evaluated: list[tuple[int, dict[int, float]]]) -> bool:
        """Call the caller's functions for each new evaluation; return whether the run is to end early."""
        enough = False
        while evaluated:
            step, returns = evaluated.pop(0)
            with callers_own(self.failures):
                if self.on_evaluation:
                    self.on_evaluation(step, returns)
                enough = bool(self.stop_when and self.stop_when(step, returns)) or enough
        return enough

    def had_enough(self, run: RunDirectory) -> bool:
        """Return whether a run that is over had ended early, and `stop_when` still says so of its last evaluation."""
        if self.stop_when is None or run.manifest.state != "finished":
            return False
        try:
            rows = run.evaluations
        except InputError:  # damaged: going on restores it
            return False
        if not len(rows):
            return False
        step = int(rows["step"].max())
        with callers_own(self.failures):
            return bool(self.stop_when(step, mean_returns(rows[rows["step"] == step])))


def _go_on(
    run: RunDirectory, plan: Plan, before: Manifest, wanted: Manifest, notes: list[str], watchers: Watchers
) -> RunDirectory:
    """Go on with a run from its newest sound checkpoint, which was made as `before` says."""
    if run.manifest.state in ("finished", "failed") and run.manifest.steps_done >= plan.steps:
        if watchers.reporter:
            watchers.reporter.note(f"{run.path} has made its {plan.steps:,} steps already; more: --steps")
        return run
    if watchers.had_enough(run):
        if watchers.reporter:
            watchers.reporter.note(f"{run.path} had enough after {run.manifest.steps_done:,} steps")
        return run
    restart = roll_back(run)
    current = ("machine", "versions", "commit", "groups", "steps", "process", "device", "checkpoints")
    run.update_manifest(
        **{name: getattr(wanted, name) for name in current},
        state="running",
        history=(*run.manifest.history, restart.continuation(before, wanted)),
        failures=restart.failures,
        steps_done=restart.step,
    )
    return _run(run, plan, [*notes, *restart.notes(before, wanted)], watchers, restart)


def _run(run: RunDirectory, plan: Plan, notes: list[str], watchers: Watchers, restart: Restart) -> RunDirectory:
    """Train until the last step or a signal, from the first preparation to the last picture."""
    reporter = watchers.reporter
    told = functools.partial(reporter.note, _STOPPING) if reporter else None
    try:
        with caught_signals(told) as (stop, received), closing(reporter) if reporter else nullcontext():
            recorder = _follow(run, plan, notes, watchers, restart, stop, received)
    except KeyboardInterrupt as second:
        if run.manifest.state in ("finished", "failed"):  # it had ended, and only its picture is missing
            return run
        raise StoppedAtOnce(run, can_go_on(run), *second.args) from second
    if run.manifest.state == "interrupted":
        newest = recorder.checkpoints.newest if recorder.checkpoints else None
        lost = run.manifest.steps_done - (newest or 0)
        raise Interrupted(run, received[0], newest is not None, lost, begins_anew=newest is None and can_go_on(run))
    return run


def _follow(
    run: RunDirectory,
    plan: Plan,
    notes: list[str],
    watchers: Watchers,
    restart: Restart,
    stop: threading.Event,
    received: list[int],
) -> Recorder:
    """Train until the last step, a request to stop or a failure, and write down what happens."""
    reporter, begin, failures = watchers.reporter, restart.step, restart.failures
    groups = restart.parts(plan.groups)
    notes = [*notes, *filter(None, [tidy_programs()])]
    if reporter:
        reporter.start(plan.task_name, plan.algorithm.name, plan.labels, plan.steps, run.path, notes)
        reporter.go_on(begin, run.evaluations, failures)
    logs = _logs(run, plan.labels, begin, watchers)
    folder = run.checkpoints.absolute() if begin or plan.checkpoint_interval else None
    settings = Settings(plan, folder, begin, _begins_on_another_task(run, begin))
    checkpoints = Checkpoints(folder, plan.keep_checkpoints, restart.pinned) if folder else None
    recorder = Recorder(run, groups, reporter, logs, checkpoints, begin, failures, by_step(plan.perturbations))
    for log in logs:
        recorder.tell(log.write({}))
    try:
        with closing(run_groups(settings, groups, stop.is_set, checkpoints, lambda: bool(received))) as told:
            for group, message in told:
                recorder.handle(group, message)
                if watchers.tell(recorder.evaluated):
                    stop.set()
        recorder.close()
        stopped = bool(received) and not recorder.is_complete(plan.steps)  # a signal may come too late
        _finish(run, recorder, "interrupted" if stopped else "failed" if recorder.failures else "finished", reporter)
    except BaseException:
        _leave(run, recorder)
        raise
    finally:
        for log in logs:
            lines = log.close()
            with suppress(OSError):
                recorder.tell(lines)
    return recorder


def _begins_on_another_task(run: RunDirectory, begin: int) -> bool:
    """Whether the checkpoint at this step came from a run of another task."""
    origin = run.manifest.forked_from
    return origin is not None and origin.step == begin and origin.has_other_task


def _logs(run: RunDirectory, labels: list[int], begin: int, watchers: Watchers) -> list[Log]:
    """Return where the curves go beside the tables. Both are slow to import, and some runs do without."""
    logs: list[Log] = []
    before = _before(run, labels) if watchers.tensorboard or watchers.wandb else {}
    if watchers.tensorboard:
        from csac.record.tensorboard import TensorBoardLog

        logs.append(TensorBoardLog(run.tensorboard, labels, begin, before))
    if watchers.wandb:
        project = watchers.wandb if isinstance(watchers.wandb, str) else None
        logs.append(WandbLog(run, labels, begin, project, before))
    return logs


def _before(run: RunDirectory, labels: list[int]) -> dict[str, list[dict[str, Any]]]:
    """Return the rows that a run that goes on has already, of the tables that what comes next is averaged with."""
    tables = {"episodes": run.rows("episodes"), "evaluations": run.evaluations}
    return {name: _as_dicts(rows[np.isin(rows["seed"], labels)]) for name, rows in tables.items()}


def _as_dicts(rows: np.ndarray) -> list[dict[str, Any]]:
    return [dict(zip(rows.dtype.names or (), row, strict=True)) for row in rows.tolist()]


def _leave(run: RunDirectory, recorder: Recorder) -> None:
    """Write what can still be written of a run that an error ends; it can go on from its last checkpoint."""
    if run.manifest.state != "running":
        return  # it had ended before
    with suppress(OSError):
        recorder.close()
        run.update_manifest(state="interrupted")


def _finish(run: RunDirectory, recorder: Recorder, state: State, reporter: Reporter | None) -> None:
    """Draw the curve and say how the run ended. It has ended so whether or not there is a picture of it."""
    run.update_manifest(state=state, failures=recorder.failures)
    try:
        _draw(run)
    except Exception as error:
        text = f"note: the curve could not be drawn ({type(error).__name__}: {' '.join(str(error).split())})"
        run.log(text)
        if reporter:
            reporter.note(text)
    if reporter:
        reporter.finish(run)
        return
    for seed, reason in run.manifest.failures.items():
        warnings.warn(f"seed {seed} of {run.path} failed at {reason}", RuntimeWarning, stacklevel=4)


def _draw(run: RunDirectory) -> None:
    rows = run.sound_evaluations
    if not len(rows):
        rows = run.evaluations  # of a run of which every seed has failed there is a picture too
    if len(rows):
        perturbed = by_step(perturbations_of(run.manifest.perturbations))
        marks = [(step, text) for step, text in perturbed if step <= rows["step"].max()]
        from csac.record.plots import learning_curve  # matplotlib is slow to import

        learning_curve([(run.manifest.algorithm.upper(), rows)], run.curve, title=run.manifest.task, marks=marks)


def _defaults(algorithm: Algorithm) -> dict[str, Any]:
    """Return the default of every hyperparameter that has one."""
    fields = dataclasses.fields(algorithm)  # pyright: ignore[reportArgumentType]
    return {item.name: item.default for item in fields if item.default is not dataclasses.MISSING}


def _warmup_note(plan: Plan) -> list[str]:
    steps, warmup, first = plan.steps, plan.algorithm.cadence.warmup_steps, plan.algorithm.cadence.first_update
    if steps >= first:
        return []
    is_warmup = f"all {steps:,} steps are warm-up (warmup_steps={warmup:,})"
    why = is_warmup if steps < warmup else f"the first update comes after step {first:,}"
    return [f"note: nothing will be learnt, since {why}"]
