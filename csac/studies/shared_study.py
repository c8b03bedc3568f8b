"""One Optuna study in a directory that any number of processes share: what it asks, its trials, and who runs which."""

from __future__ import annotations

import dataclasses
import json
import math
import warnings
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from csac.record.config import differences
from csac.record.run import is_locked, is_run, kept_from_children
from csac.record.tables import drop_torn_line
from csac.tasks.seeds import TUNING_EVALUATION_SEED
from csac.training.options import Options
from csac.types import InputError

try:
    import fcntl
except ImportError:  # Windows: there are no locks, and so no two processes
    fcntl = None

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import optuna

    from csac.studies.search_space import Dimension
    from csac.types import Algorithm

JOURNAL = "journal.log"
NAME = "csac"  # of the one study in a journal
POINTS = 3  # evaluations at the end of a run that it is judged by
OBJECTIVE = f"the mean over the seeds of each seed's mean return in its last {POINTS} evaluations"
STARTUP_TRIALS = 5  # that are never pruned, and that must be complete before any is
FEWEST_TO_COMPARE = 3  # complete trials that have reached a step, for another to be pruned there
SHARE_UNPRUNED = 0.25  # of a trial's steps, at its beginning

State = Literal["complete", "pruned", "failed", "running", "waiting"]


@dataclass(frozen=True, kw_only=True)
class Question(Options):
    """What is tuned, and how a trial is judged: what all processes that share a study agree on."""

    task: str
    algorithm: Algorithm
    """Where the search begins; what is not searched stays so."""
    space: Mapping[str, Dimension]
    environment_arguments: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, dimension in self.space.items():
            for value in dimension.ends:
                self.algorithm_with({name: value})
        if self.steps <= (warmup := self.algorithm.cadence.warmup_steps):
            raise InputError(
                f"nothing would be learnt: all {self.steps:,} steps of a trial are warm-up "
                f"(warmup_steps={warmup:,}); give more --steps or fewer --warmup-steps"
            )

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """Every hyperparameter as the search begins."""
        return dataclasses.asdict(self.algorithm)  # pyright: ignore[reportArgumentType]

    def algorithm_with(self, values: Mapping[str, Any]) -> Algorithm:
        """Return what a trial trains. Raises InputError for values that do not go with what is given."""
        changed: Any = dataclasses.replace(self.algorithm, **values)  # pyright: ignore[reportArgumentType]
        return changed

    def told(self) -> dict[str, Any]:
        """Return the question as JSON has it."""
        return json.loads(
            json.dumps(
                {
                    "task": self.task,
                    "environment_arguments": self.environment_arguments,
                    "algorithm": self.algorithm.name,
                    "hyperparameters": {
                        name: f"searched: {self.space[name]}" if name in self.space else value
                        for name, value in self.hyperparameters.items()
                    },
                    "objective": OBJECTIVE,
                    "steps": self.steps,
                    "seeds": self.labels,
                    "evaluation_interval": self.evaluation_interval,
                    "evaluation_episodes": self.evaluation_episodes,
                    "evaluation_seed": TUNING_EVALUATION_SEED,
                }
            )
        )


class Attempt(NamedTuple):
    """A trial that this process runs, for as long as it holds the lock."""

    trial: optuna.Trial
    label: int
    values: dict[str, Any]
    """Of what is searched."""
    path: Path
    """Its run directory."""
    lock: IO[str]


class Result(NamedTuple):
    """What has become of a trial."""

    label: int
    state: State
    objective: float
    """NaN before its first evaluation; where it was pruned or is on its way, as far as it got."""
    step: int
    """Of its last evaluation."""
    values: dict[str, Any]
    """Of what is searched."""
    returns: dict[int, float]
    """Each seed's part of the objective."""
    reason: str = ""
    """Why it failed."""


class SharedStudy:
    """The Optuna study in a directory. Several processes may have it open, on machines that share the folder.

    A trial is a run directory below `trials/`, and a process holds its lock while it trains it. A trial that is being
    run by nobody was left by a process that died or was stopped: it is told to Optuna as failed, and its configuration
    goes back to the queue, to go on from its checkpoint. Whoever asks for a trial first looks for such ones.

    Raises:
        InputError: Optuna is not installed; the directory holds the study of another question, or something else.
    """

    def __init__(self, directory: str | Path, question: Question) -> None:
        self._optuna = import_optuna()
        self.directory, self.question = Path(directory), question
        _refuse_occupied(self.directory)
        try:
            (self.directory / "trials").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot write to {directory}: {error.strerror}; choose another directory") from None
        with self._alone():
            self.study = self._open()

    def next(self, trials: int) -> Attempt | None:
        """Return the next trial to run, or None once the study has so many: complete, pruned, failed or running."""
        with self._alone():
            self._take_back_lost()
            known = self._all()
            if sum(_counts(trial) for trial in known) >= trials:
                return None
            label = 1 + max((_label(trial) for trial in known), default=-1)
            self.study.sampler = self._sampler(label)
            trial = self.study.ask()
            label = trial.user_attrs.get("trial", label)
            trial.set_user_attr("trial", label)
            # Held for as long as the trial runs, by this process alone.
            lock = kept_from_children(open(self._lock(label), "a"))  # noqa: SIM115
            _lock(lock)
            values = {name: dimension.draw(trial, name) for name, dimension in self.question.space.items()}
            trial.set_user_attr("values", values)
        return Attempt(trial, label, values, self.directory / "trials" / f"{label:04d}", lock)

    def complete(self, attempt: Attempt, returns: Mapping[int, float]) -> None:
        """Tell the study what a trial has reached."""
        with self._ending(attempt):
            attempt.trial.set_user_attr("returns", {str(seed): value for seed, value in returns.items()})
            self.study.tell(attempt.trial, float(np.mean(list(returns.values()))))

    def prune(self, attempt: Attempt, failure: str = "") -> None:
        """Tell the study that a trial was not worth its end; where a seed of it failed, how."""
        with self._ending(attempt):
            if failure:
                attempt.trial.set_user_attr("failure", failure)
            self.study.tell(attempt.trial, state=self._optuna.trial.TrialState.PRUNED)

    def give_back(self, attempt: Attempt) -> None:
        """Put a trial that was stopped back into the queue."""
        with self._ending(attempt):
            self._requeue(self._all()[attempt.trial.number])

    def drop(self, attempt: Attempt) -> None:
        """Leave a trial out that could not begin; one whose configuration came from the queue goes back there."""
        with self._ending(attempt):
            trial = self._all()[attempt.trial.number]
            if "fixed_params" in trial.system_attrs:
                self._requeue(trial)
            else:
                self._fail(trial)

    def results(self) -> list[Result]:
        """Return every trial, in order; one that was taken up again stands there once."""
        found, before = {}, {}
        for trial in self._all():
            if "trial" not in trial.user_attrs:
                continue
            if trial.state.name != "FAIL":
                found[_label(trial)] = _result(trial, before.get(_label(trial), {}))
            elif trial.intermediate_values:  # whose configuration is queued again
                before[_label(trial)] = trial.intermediate_values
        return [found[label] for label in sorted(found)]

    def best(self) -> Result | None:
        """Return the complete trial with the highest objective."""
        complete = [result for result in self.results() if result.state == "complete"]
        return max(complete, key=lambda result: result.objective, default=None)

    def importances(self) -> dict[str, float]:
        """Return the share of each searched hyperparameter in what makes a trial good (PED-ANOVA), by its name.

        There is none where no trial is better than the others.
        """
        evaluator = self._optuna.importance.PedAnovaImportanceEvaluator()
        with warnings.catch_warnings(action="error", category=UserWarning):
            try:
                shares = self._optuna.importance.get_param_importances(self.study, evaluator=evaluator)
            except UserWarning:  # they would all be equal
                return {}
        return {
            name: float(shares.get(dimension.drawn_as(name), 0.0)) for name, dimension in self.question.space.items()
        }

    def _open(self) -> optuna.Study:
        """Open the study, or begin it. Its first trial is the configuration that the search begins with."""
        optuna, path = self._optuna, self.directory / JOURNAL
        try:
            # Its other lock, a symbolic link, would be waited for for ever where a process died that held it.
            lock = _JournalLock(path, optuna.storages.journal.JournalFileOpenLock(str(path)))
            backend = optuna.storages.journal.JournalFileBackend(str(path), lock)
            lock.acquire()  # so that what is read has no half line
            lock.release()
            options = {
                "storage": optuna.storages.JournalStorage(backend),
                "study_name": NAME,
                "pruner": self._pruner(),
            }
            is_new = NAME not in optuna.get_all_study_names(options["storage"])
            study = optuna.create_study(direction="maximize", **options) if is_new else optuna.load_study(**options)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path} is damaged: {' '.join(str(error).split()):.100}; restore it, or remove it"
            ) from None
        told = self.question.told()
        found = differences(study.user_attrs.get("question", told), told)
        if found and self._has_begun(study):
            raise InputError(f"{self.directory} tunes another question: {'; '.join(found)}. Choose another --directory")
        if found:
            optuna.delete_study(study_name=NAME, storage=options["storage"])
            study = optuna.create_study(direction="maximize", **options)
        if "question" not in study.user_attrs:
            study.set_user_attr("question", told)
        if not study.get_trials(deepcopy=False):
            start = self.question.hyperparameters
            fitting = {
                dimension.drawn_as(name): dimension.as_drawn(start[name])
                for name, dimension in self.question.space.items()
                if dimension.holds(start[name])
            }
            study.enqueue_trial(fitting)
        return study

    def _has_begun(self, study: optuna.Study) -> bool:
        """Whether a trial was ever run, or is: one that could not begin leaves no run."""
        return any(map(is_run, (self.directory / "trials").iterdir())) or any(
            trial.state.name in ("COMPLETE", "PRUNED") or (trial.state.name == "RUNNING" and self._is_run(trial))
            for trial in study.get_trials(deepcopy=False)
        )

    def _pruner(self) -> Any:
        """Return the median rule: stop what was never as good as half of the complete trials were at the same step."""
        unpruned = max(self.question.algorithm.cadence.warmup_steps, round(SHARE_UNPRUNED * self.question.steps))
        return self._optuna.pruners.MedianPruner(STARTUP_TRIALS, unpruned, n_min_trials=FEWEST_TO_COMPARE)

    def _sampler(self, label: int) -> Any:
        """Return what chooses the values of a trial: the same for the same trials before it, whichever process asks."""
        return self._optuna.samplers.TPESampler(seed=label)

    def _take_back_lost(self) -> None:
        """Put trials that say that they are being run, and are not, back into the queue."""
        for trial in self._all():
            if trial.state.name == "RUNNING" and not self._is_run(trial):
                self._requeue(trial)

    def _requeue(self, trial: optuna.trial.FrozenTrial) -> None:
        """Queue a trial's configuration again, if it has one by now, and end the trial.

        In this order nothing is lost where the process dies between the two: whoever takes the trial back then sees
        that another stands for it already.
        """
        facts = {name: trial.user_attrs[name] for name in ("trial", "values") if name in trial.user_attrs}
        is_queued = any(other.user_attrs.get("instead_of") == trial.number for other in self._all())
        if ("values" in facts or "fixed_params" in trial.system_attrs) and not is_queued:
            # A process that died at once had drawn nothing, or not all, of what the queue had given it.
            params = {**trial.system_attrs.get("fixed_params", {}), **trial.params}
            self.study.enqueue_trial(params, user_attrs={**facts, "instead_of": trial.number})
        self._fail(trial)

    def _fail(self, trial: optuna.trial.FrozenTrial) -> None:
        """Tell a trial as failed, since Optuna knows no other way to end one."""
        self.study.tell(trial.number, state=self._optuna.trial.TrialState.FAIL)

    def _is_run(self, trial: optuna.trial.FrozenTrial) -> bool:
        return "trial" in trial.user_attrs and is_locked(self._lock(trial.user_attrs["trial"]))

    def _all(self) -> list[optuna.trial.FrozenTrial]:
        return self.study.get_trials(deepcopy=False)

    def _lock(self, label: int) -> Path:
        return self.directory / "trials" / f"{label:04d}.lock"

    @contextmanager
    def _ending(self, attempt: Attempt) -> Iterator[None]:
        """End a trial and let go of it at one stroke: a process between the two would take it for a lost one."""
        with self._alone():
            yield
            attempt.lock.close()

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Wait until no other process is between looking at the study and changing it."""
        with open(self.directory / ".lock", "a") as file:
            _lock(file)
            yield


class _JournalLock:
    """Optuna's lock of the journal, with which it appends. Whoever gets it cuts off a half-written line first.

    A process leaves one that dies or whose disk is full, and the next line would be glued to it, whoever writes that:
    from then on nobody could read the journal. Optuna takes every object with these two methods for a lock.
    """

    def __init__(self, journal: Path, lock: Any) -> None:
        self._journal, self._lock = journal, lock

    def acquire(self) -> bool:
        self._lock.acquire()
        try:
            with open(self._journal, "ab+") as file:
                drop_torn_line(file)
        except BaseException:
            self._lock.release()
            raise
        return True

    def release(self) -> None:
        self._lock.release()


def import_optuna() -> Any:
    """Return the module, silent. Raises InputError where it is not installed."""
    try:
        import optuna
    except ImportError:
        raise InputError("Optuna is not installed: pip install '.[tune]' in a clone of csac") from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna


def _refuse_occupied(directory: Path) -> None:
    if directory.exists() and not directory.is_dir():
        raise InputError(f"{directory} is a file; choose another directory")
    found = {path.name for path in directory.iterdir()} if directory.exists() else set()
    # What a process leaves that dies at once, or has only just begun; Optuna locks its journal by a file beside it.
    if JOURNAL not in found and found - {".lock", "trials", f"{JOURNAL}.lock"}:
        raise InputError(f"{directory} is not empty and holds no study; choose a new or an empty directory")


def _counts(trial: optuna.trial.FrozenTrial) -> bool:
    """Whether a trial is part of the budget: what failed for Optuna was put back."""
    return trial.state.name in ("COMPLETE", "PRUNED", "RUNNING")


def _label(trial: optuna.trial.FrozenTrial) -> int:
    return trial.user_attrs.get("trial", -1)


def _result(trial: optuna.trial.FrozenTrial, before: Mapping[int, float]) -> Result:
    """Return what has become of a trial; one that waits to go on is as far as it was `before`, by its evaluations."""
    facts, values = trial.user_attrs, trial.intermediate_values or before
    state: Any = "failed" if "failure" in facts else trial.state.name.lower()
    last = max(values, default=None)
    value = trial.value if trial.value is not None else None if last is None else values[last]
    returns = {int(seed): value for seed, value in facts.get("returns", {}).items()}
    objective = math.nan if value is None else float(value)
    return Result(
        _label(trial), state, objective, last or 0, facts.get("values", {}), returns, facts.get("failure", "")
    )


def _lock(file: IO[str]) -> None:
    if fcntl:
        fcntl.flock(file, fcntl.LOCK_EX)
