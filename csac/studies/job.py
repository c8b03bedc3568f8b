"""One cell as a piece of work: what every engine does with it, wherever it runs."""

from __future__ import annotations

import shutil
import time
import traceback
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from csac.record.run import RunDirectory, is_run
from csac.record.tables import COLUMNS, read_rows, write_rows
from csac.studies.cells import LOST_EPISODE, Cell, is_final, is_in_use, read_history, restarting_seeds, write_history
from csac.studies.collected import ROLLOUTS
from csac.tasks.perturbations import Perturbation, perturbations_of, values_at
from csac.training.signals import signals_noted
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True)
class Job:
    """A cell, the directory of its run, and how it is run. Nothing here changes what the cell computes but `device`."""

    cell: Cell
    path: Path
    device: Literal["cpu", "gpu"] = "cpu"
    checkpoint_interval: int = 50_000
    keep_checkpoints: bool = False
    tensorboard: bool = True
    wandb: bool = False
    rollouts: int = 0
    """Fresh episodes that the finished policy is tested on, on the task as it was last: `rollouts.csv` in its run."""
    command: str | None = None


@dataclass(frozen=True)
class Started:
    """A cell is being run."""

    key: str
    where: str = ""


@dataclass(frozen=True)
class Advanced:
    """A cell was evaluated at a step."""

    key: str
    step: int
    mean_return: float


@dataclass(frozen=True)
class Ended:
    """A cell is no longer being run. `elsewhere`: another process has it."""

    key: str
    outcome: Literal["complete", "failed", "stopped", "elsewhere"]
    reason: str = ""


@dataclass(frozen=True)
class Noted:
    """What the user should know of a cell that is being run: what it does."""

    key: str
    text: str


Message = Started | Advanced | Noted | Ended


class Stopped(Exception):
    """A study was stopped by a signal; every cell is saved, and the next run goes on with it."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(signal_number)
        self.signal_number = signal_number


def is_over(job: Job) -> bool:
    """Whether there is nothing left to do: the run is final and, where it did not fail, so are its rollouts.

    A failure beside a finished run, such as that of a process that died as it drew the curve, is still to be cleared.
    """
    if not is_final(job.path):
        return False
    failed = RunDirectory.open(job.path).manifest.state == "failed"
    return failed or (is_tested(job) and "failure" not in read_history(job.path))


def execute(job: Job, tell: Callable[[Message], Any]) -> Ended:
    """Train a cell from where it is to its end, and say how it went; only a signal is raised.

    What goes wrong with one cell is written beside it and returned, so that the others go on.

    Raises:
        Stopped: SIGINT or SIGTERM, after what was learnt was saved. A test that it breaks off is made again.
    """
    key = job.cell.key
    if is_in_use(job.path):
        return Ended(key, "elsewhere")
    if is_over(job):  # another process has been here since the jobs were chosen
        return _ended(key, RunDirectory.open(job.path))
    before = read_history(job.path)
    seconds = float(before.get("seconds", 0.0)) if is_run(job.path) else 0.0  # else of a run that was removed
    began = time.monotonic()

    def spent() -> dict[str, float]:
        return {"seconds": round(seconds + time.monotonic() - began, 1)}

    from csac.training.signals import Interrupted  # JAX, which a worker imports once it has its cores

    try:
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # a seed that failed is told of below
            run = _trained(job, tell)
        write_history(job.path, spent())  # now: the process may end while the policy is tested
        if run.manifest.state == "finished" and not is_tested(job):
            _roll_out(job, run)
            write_history(job.path, spent())
    except InputError as error:
        taken = is_in_use(job.path)
        return Ended(key, "elsewhere") if taken else _failed(job, spent(), str(error))
    except (Interrupted, Stopped) as stop:
        write_history(job.path, spent())
        raise Stopped(stop.signal_number) from None
    except Exception as error:
        reason = ": ".join(filter(None, (type(error).__name__, str(error))))
        return _failed(job, spent(), reason, traceback.format_exc())
    return _ended(key, run)


def _trained(job: Job, tell: Callable[[Message], Any]) -> RunDirectory:
    """Return the run of a cell, trained to its end. What is final needs no task, which this machine may not have."""
    run = RunDirectory.open(job.path) if is_final(job.path) else _train(job, tell)
    if run.manifest.state == "finished" and not job.keep_checkpoints:
        # A finished cell needs them no more, and they take most of its room: the replay is in them.
        shutil.rmtree(run.checkpoints, ignore_errors=True)
    return run


def _train(job: Job, tell: Callable[[Message], Any]) -> RunDirectory:
    from csac.training.train import train

    cell = job.cell
    if restarting_seeds(job.path):
        tell(Noted(cell.key, f"restarts {LOST_EPISODE}"))
    train(
        cell.make_algorithm(),
        cell.task,
        steps=cell.steps,
        seeds=1,
        first_seed=cell.seed,
        directory=job.path.parent,
        evaluation_interval=cell.evaluation_interval,
        evaluation_episodes=cell.evaluation_episodes,
        evaluation_processes=0,
        environment_arguments=cell.environment_arguments,
        perturbations=cell.perturbations,
        events=cell.events,
        device=job.device,
        checkpoint_interval=job.checkpoint_interval,
        resume=True,
        tensorboard=job.tensorboard,
        wandb=job.wandb,
        command=job.command,
        on_evaluation=lambda step, returns: tell(Advanced(cell.key, step, returns.get(cell.seed, float("nan")))),
    )
    return RunDirectory.open(job.path)


def _roll_out(job: Job, run: RunDirectory) -> None:
    """Test the last policy on episodes that neither training nor its evaluations have seen, and keep a row of each.

    The task is perturbed as it was at the end of training.

    Raises:
        InputError: another process has the run.
        Stopped: a signal came before the last batch of episodes; those of the others are not kept.
    """
    from csac.evaluation.play import evaluate_run

    last = values_at(perturbations_of(job.cell.perturbations), job.cell.steps)
    perturbed = [Perturbation(kind, value) for kind, value in last.items()]
    with run.locked(), signals_noted() as received:

        def stop_if_asked(done: int, wanted: int) -> None:
            if received and done < wanted:
                raise Stopped(received[0])

        if is_tested(job):  # by the process that had the lock before
            return
        stop_if_asked(0, job.rollouts)
        ((seed, episodes),) = evaluate_run(
            job.path,
            episodes=job.rollouts,
            perturbations=perturbed,
            processes=1,
            trust_task=run.config.task == job.cell.task,  # which the study names, on whatever machine it was trained
            on_progress=stop_if_asked,
        )
        rows = [episode.row(seed, job.cell.steps) for episode in episodes]
        write_rows(job.path / ROLLOUTS, COLUMNS["evaluations"], rows)


def is_tested(job: Job) -> bool:
    """Whether the last policy was tested on as many episodes as are wanted. What cannot be read is made again."""
    with suppress(InputError):
        return not job.rollouts or len(read_rows(job.path / ROLLOUTS)) >= job.rollouts
    return False


def _ended(key: str, run: RunDirectory) -> Ended:
    """Say how a cell ended whose run is final."""
    if run.manifest.state != "finished":
        return Ended(key, "failed", run.manifest.failure)
    return Ended(key, "complete")


def _failed(job: Job, history: dict[str, Any], reason: str, trace: str = "") -> Ended:
    """Write beside the cell why it failed."""
    line = " ".join(reason.split())
    with suppress(OSError):
        write_history(job.path, {**history, "failure": line, **({"traceback": trace} if trace else {})})
    return Ended(job.cell.key, "failed", line)
