"""`csac tune`: Optuna chooses hyperparameters, csac trains a set of runs with them, and bad trials are pruned.

Any number of processes may share a directory: Optuna's study is a journal in it, and each trial a folder, `trial-<n>`.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import sys
import warnings
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from csac.checks import check_whole
from csac.console.tables import Fitted
from csac.record.config import differences
from csac.record.files import closed_in_children, is_locked, take, writing
from csac.record.rendering import Cell, Row, Table, number
from csac.record.run import RunDirectory
from csac.record.sets import RunSet
from csac.record.statistics import last_evaluations
from csac.studies.arms import plain
from csac.studies.run import try_tasks
from csac.studies.search import Search, sample
from csac.training.config import RUN_OPTIONS
from csac.training.signals import Interrupted, stop_requested, storage_failures
from csac.training.train import train
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import optuna
    from rich.console import Console


STARTUP_TRIALS = 5  # that must be complete before any trial is pruned
SHARE_UNPRUNED = 0.25  # of a trial's steps, from its beginning
SHOWN = 10  # trials in the table at the end


def tune(search: Search, directory: Path, trials: int, command: str | None, console: Console) -> int:
    """Run trials until the directory has `trials` of them, show the best, and return the exit code.

    Raises InputError if Optuna is missing, the task cannot be made, or the directory holds another search, and
    StorageFailure if it can no longer be written.
    """
    check_whole("trials", trials, 1, 100_000)
    directory = directory.absolute()
    try_tasks([search.config])
    with storage_failures(directory):
        study = _open(search, directory)
        with stop_requested(lambda text: console.print(text)) as request:
            while not request.is_set() and (found := _next(study, search, directory, trials)):
                trial, lock = found
                with lock:
                    _run(study, search, trial, _folder(directory, trial), command, console)
        _conclude(study, search, directory, console)
    if request.is_set():
        print(f"csac: stopped; the trial is saved. To go on, type the same line again: {command}", file=sys.stderr)
        return 128 + request.received[0]
    return 0 if _complete(study) else 3


def _open(search: Search, directory: Path) -> optuna.Study:
    """Open Optuna's study, or create it with the search's initial configuration as its first trial."""
    try:
        import optuna
        from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
    except ImportError:
        raise InputError("Optuna is not installed: pip install '.[tune]' in a clone of csac") from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    journal = directory / "journal.log"
    if directory.exists() and not journal.exists() and (directory.is_file() or any(directory.glob("[!.]*"))):
        raise InputError(f"{directory} is not empty and holds no search: choose another --directory")
    with writing(directory):
        directory.mkdir(parents=True, exist_ok=True)
    lock = JournalFileOpenLock(str(journal))
    backend = JournalFileBackend(str(journal), lock)
    lock.acquire()
    os.truncate(journal, journal.read_bytes().rfind(b"\n") + 1)  # a full disk cut the last line off
    lock.release()
    unpruned = max(search.algorithm.cadence.first_update, round(SHARE_UNPRUNED * search.config.steps))
    with _trial_choice_locked(directory):
        study = optuna.create_study(
            storage=optuna.storages.JournalStorage(backend),
            study_name="csac",
            direction="maximize",
            load_if_exists=True,
            pruner=optuna.pruners.MedianPruner(STARTUP_TRIALS, unpruned, n_min_trials=3),
        )
        definition = search.definition()
        if found := differences(study.user_attrs.get("search", definition), definition):
            raise InputError(f"{directory} holds another search: {'; '.join(found)}. Choose another --directory")
        if not study.get_trials(deepcopy=False):
            study.set_user_attr("search", definition)
            initial = {name: getattr(search.algorithm, name) for name in search.space}
            study.enqueue_trial(
                {n: 1 - v if search.space[n][0] == "below 1" else v for n, v in initial.items()}, {"trial": 0}
            )
    return study


def _next(study: optuna.Study, search: Search, directory: Path, trials: int) -> tuple[optuna.Trial, IO[str]] | None:
    """Return the next trial to run and its lock, or None once there are `trials` of them.

    Before that, a trial that is marked as running but whose lock nobody holds goes back to the queue.
    """
    import optuna

    with _trial_choice_locked(directory):
        known = study.get_trials(deepcopy=False)
        for lost in known:
            is_held = "trial" in lost.user_attrs and is_locked(_folder(directory, lost) / ".lock")
            if lost.state.name == "RUNNING" and not is_held:
                _requeue(study, lost)
        known = study.get_trials(deepcopy=False)
        if sum(trial.state.name in ("COMPLETE", "PRUNED", "RUNNING") for trial in known) >= trials:
            return None
        study.sampler = optuna.samplers.TPESampler(seed=len(known))  # reproducible given the earlier trials
        trial = study.ask()
        latest = max((other.user_attrs.get("trial", -1) for other in known), default=-1)
        trial.set_user_attr("trial", trial.user_attrs.get("trial", latest + 1))
        folder = _folder(directory, trial)
        folder.mkdir(exist_ok=True)
        lock = closed_in_children(open(folder / ".lock", "a+"))  # noqa: SIM115  held for as long as the trial runs
        take(lock, folder)
        with warnings.catch_warnings(action="ignore"):  # the first trial may lie outside the space
            values = {name: sample(trial, name, dimension) for name, dimension in search.space.items()}
        trial.set_user_attr("values", values)
        return trial, lock


@contextmanager
def _trial_choice_locked(directory: Path) -> Iterator[None]:
    """Keep other processes from choosing a trial meanwhile; the lock of a dead process is removed after a while."""
    from optuna.storages.journal import JournalFileOpenLock

    mutex = JournalFileOpenLock(str(directory / "next"))
    mutex.acquire()
    try:
        yield
    finally:
        mutex.release()


def _folder(directory: Path, trial: optuna.Trial | optuna.trial.FrozenTrial) -> Path:
    return directory / f"trial-{trial.user_attrs['trial']}"


def _requeue(study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
    """Put the configuration of a stopped trial back into the queue, to continue in its folder."""
    if "trial" in trial.user_attrs:
        params = {**trial.system_attrs.get("fixed_params", {}), **trial.params}
        study.enqueue_trial(params, user_attrs={"trial": trial.user_attrs["trial"]})
    study.tell(trial.number, state=type(trial.state).FAIL)


def _run(
    study: optuna.Study, search: Search, trial: optuna.Trial, folder: Path, command: str | None, console: Console
) -> None:
    """Train a trial from its newest checkpoint, and tell Optuna the result."""
    from optuna.trial import TrialState

    label, values = folder.name, trial.user_attrs["values"]
    console.print(f"{label}: {', '.join(f'{name} {plain(value)}' for name, value in values.items())}")
    reported: set[int] = set()
    is_pruned = False

    def is_enough(step: int, _: Mapping[int, float]) -> bool:
        nonlocal is_pruned
        runs = RunSet.open(folder)
        for known, score in _scores(runs.evaluations, search.seeds, step).items():
            if known not in reported:
                trial.report(score, known)
                reported.add(known)
        is_pruned = is_pruned or (step < search.config.steps and step in reported and trial.should_prune())
        return is_pruned or bool(runs.failures)

    try:
        algorithm = dataclasses.replace(search.algorithm, **values)  # pyright: ignore[reportArgumentType]
    except InputError as error:  # values that do not go together
        study.tell(trial, state=TrialState.PRUNED)
        console.print(f"{label}: {error}", soft_wrap=True)
        return
    if not search.config.checkpoint_interval:  # an interrupted run cannot go on: it is trained anew
        for path in folder.glob("seed-*"):
            if RunDirectory.open(path).manifest.state != "finished":
                shutil.rmtree(path)
    try:
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # failed seeds are reported below
            runs = train(
                algorithm,
                search.config.task,
                seeds=search.seeds,
                first_seed=search.config.seed,
                directory=folder,
                resume=True,
                tensorboard=False,
                progress=False,
                command=command,
                stop_when=is_enough,
                **{name: getattr(search.config, name) for name in RUN_OPTIONS},
            )
    except Interrupted:
        _requeue(study, study.get_trials(deepcopy=False)[trial.number])
        return
    scores = list(last_evaluations(runs.evaluations).values())
    if is_pruned or runs.failures or len(scores) < search.seeds:
        study.tell(trial, state=TrialState.PRUNED)
        reason = "pruned" if is_pruned else "a seed has no evaluation (see its log.txt)"
        console.print(f"{label}: {'; '.join(runs.failures.values()) or reason}", soft_wrap=True)
    else:
        score = float(np.mean(scores))
        study.tell(trial, score)
        console.print(f"{label}: {number(score)}, best {number(study.best_value)}")
    for run in runs.runs:  # the trial is over, and the replay buffer takes most of the space
        shutil.rmtree(run.checkpoints, ignore_errors=True)


def _scores(rows: np.ndarray, seeds: int, until: int) -> dict[int, float]:
    """Return the score at each step up to `until` at which every seed was evaluated."""
    steps = [step for step in np.unique(rows["step"]).tolist() if step <= until]
    steps = [step for step in steps if len(np.unique(rows["seed"][rows["step"] == step])) == seeds]
    return {step: float(np.mean([*last_evaluations(rows[rows["step"] <= step]).values()])) for step in steps}


def _complete(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state.name == "COMPLETE"]


def _conclude(study: optuna.Study, search: Search, directory: Path, console: Console) -> None:
    """Print the best trials and the command that trains the best one, and draw Optuna's pictures."""
    if not (complete := _complete(study)):
        console.print("no trial is complete")
        return
    ranked = sorted(complete, key=lambda trial: trial.value or 0.0, reverse=True)
    rows = []
    for trial in ranked[:SHOWN]:
        score = trial.value or 0.0
        values = (Cell(plain(trial.user_attrs["values"].get(name))) for name in search.space)
        rows.append(Row((Cell(_folder(directory, trial).name), Cell(number(score), score), *values)))
    console.print(Fitted(Table(("trial", "score", *search.space), tuple(rows))))
    counts = [trial.state.name for trial in study.get_trials(deepcopy=False)]
    console.print(f"{len(complete)} trials complete, {counts.count('PRUNED')} pruned or failed")
    _draw(study, directory)
    line = search.command(ranked[0].user_attrs["values"])
    console.print(f"best: {line}", soft_wrap=True)


def _draw(study: optuna.Study, directory: Path) -> None:
    """Save Optuna's pictures: the scores over the trials, and how much each hyperparameter matters."""
    import matplotlib

    matplotlib.use("Agg")
    from optuna.visualization import matplotlib as pictures

    with warnings.catch_warnings(action="ignore"):
        for name, draw in (
            ("history", pictures.plot_optimization_history),
            ("importances", pictures.plot_param_importances),
        ):
            with suppress(ValueError, RuntimeError):  # too few trials, or equal scores
                axes: Any = draw(study)
                axes.figure.savefig(directory / f"{name}.png", bbox_inches="tight", dpi=150)
