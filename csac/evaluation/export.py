"""Export a run's policy: write an artefact, verify it against the policy, then move it into place."""

from __future__ import annotations

import os
import tempfile
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

import numpy as np

from csac.deploy.artefact import FILES, Artefact, Format, open_artefact, write_artefact
from csac.deploy.card import CARD, CURVE, model_card
from csac.deploy.choosing import choose_run, load_run
from csac.deploy.contract import CONTRACT, read_json, write_json
from csac.deploy.guards import make_guards
from csac.deploy.policy import POLICY
from csac.deploy.verify import compare_actions
from csac.evaluation.evaluator import check_contract, evaluate
from csac.record.files import write_atomically, writing
from csac.record.run import RunDirectory, Which
from csac.record.sets import RunSet
from csac.record.statistics import FEWEST_FOR_INTERVAL, last_evaluations, mean_and_interval
from csac.tasks.environment import Environment
from csac.tasks.perturbations import unlike_training
from csac.tasks.trust import named_task
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from csac.deploy.policy import Policy
    from csac.tasks.registry import Task

IMPLAUSIBLE = 1e-4  # a p-value below this rejects the artefact
# Files that an artefact folder may hold, with what Python leaves after importing the loader, and macOS's Finder.
_ARTEFACT_FILES = {CONTRACT, POLICY, CARD, CURVE, "__pycache__", ".DS_Store", *FILES.values()}


class Exported(NamedTuple):
    """The exported artefact's folder, the fields of its contract, and notes for the user, one line each."""

    place: Path
    fields: dict[str, Any]
    notes: list[str]


def export_run(
    directory: str | Path,
    format: Format = "numpy",
    seed: int | None = None,
    which: Which = "last",
    place: str | Path | None = None,
    fallback: str | None = None,
    rate_limit: float | None = None,
    episodes: int = 10,
    card: bool = False,
    task: Task | None = None,
    trust_task: bool = False,
) -> Exported:
    """Export a run's policy into a folder and verify it.

    `seed` and `which` choose the policy as in `csac.load`, `fallback` and `rate_limit` are guards as in `make_guards`,
    and `format` is numpy, onnx or c. The folder is `place`, by default `export/<format>` in the run; `card` adds a
    model card. The artefact is verified in closed loop on the first `episodes` of `csac evaluate`; 0 skips this and
    does not create the task. `task` creates the environment of a run whose task was a Python function; `trust_task`
    allows importing the task's module even if the user has never named it on this machine.

    Raises:
        InputError: invalid arguments, a missing run, seed or task, or an artefact that does not act like the policy
            (then it is removed).
        EvaluationFailure: an environment raised or returned a non-finite value.
    """
    if format not in get_args(Format):
        raise InputError(f"format {format!r}: choose {', '.join(get_args(Format))}")
    if episodes < 0:
        raise InputError(f"--episodes {episodes}: give 0 or more")
    runs = RunSet.open(directory)
    run = choose_run(runs, seed, which)
    policy = load_run(run, which)
    guards = make_guards(policy.contract, fallback, rate_limit)
    facts: dict[str, Any] = {"provenance": provenance(runs, run, policy, which)}
    arguments = run.config.environment_arguments
    if episodes:
        instead = "export it with --episodes 0, or in Python with csac.evaluation.export.export_run and task="
        task = task or named_task(run.config, run.path, trust_task, instead)
        with closing(Environment(task, arguments)) as environment:
            check_contract(policy, environment)
            facts["control_rate_hz"] = control_rate(environment.raw)
    place = Path(runs.path / "export" / format if place is None else place)
    with placed(place) as folder:
        if not card and (place / CARD).exists():
            raise InputError(f"{place / CARD} would be lost: --card writes it anew; or choose another folder")
        write_artefact(folder, policy, format, guards, facts)
        verification = _verify(open_artefact(folder), policy, task if episodes else None, arguments, episodes)
        fields = {**read_json(folder / CONTRACT), "verification": verification}
        write_json(folder / CONTRACT, fields)
        if card:
            if runs.curve.exists():
                write_atomically(folder / CURVE, runs.curve.read_bytes())
            write_atomically(folder / CARD, model_card(fields, runs.curve.exists()).encode())
    notes, manifest = [], run.manifest
    if manifest.state == "failed":
        notes.append(f"seed {run.seed} failed at {manifest.failure}; this is the policy that it has left")
    if episodes:
        notes += [f"{line}: csac evaluate --perturb tests it so" for line in unlike_training(run.config.perturbations)]
    return Exported(place, fields, notes)


@contextmanager
def placed(place: Path) -> Iterator[Path]:
    """Yield a new folder that replaces `place` on exit, or is removed on an exception."""
    with writing(place):
        _check_place(place)
        place = Path(os.path.realpath(place))  # replace the target of a symbolic link, not the link
        place.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{place.name}.", dir=place.parent) as temporary:
            new = Path(temporary, "new")
            new.mkdir()
            yield new
            if place.exists():
                os.rename(place, Path(temporary, "old"))
            os.rename(new, place)


def _check_place(place: Path) -> None:
    names = {entry.name for entry in place.iterdir()} if place.exists() else set()
    fields = read_json(place / CONTRACT) if CONTRACT in names else {}
    if names and (names - _ARTEFACT_FILES or not isinstance(fields, dict) or "format" not in fields):
        raise InputError(f"{place} holds something else than an artefact: choose a new or an empty folder")


def provenance(runs: RunSet, run: RunDirectory, policy: Policy, which: Which) -> dict[str, Any]:
    """Return the origin of a policy and its performance in training, for the artefact's contract.

    `steps` is the policy's training step. `evaluation` summarises the episodes of the run's latest evaluation up to
    it, `all_seeds` the last evaluations of all seeds that did not fail. `learnt_weights` are the latest values in
    metrics.csv of the weights whose hyperparameter is "auto".
    """
    manifest, config = run.manifest, run.config
    steps = manifest.steps_done if policy.step is None else policy.step
    evaluations = run.evaluations
    evaluations = evaluations[evaluations["step"] <= steps]
    latest = evaluations[evaluations["step"] == evaluations["step"].max(initial=0)]
    last_returns = list(last_evaluations(runs.sound_evaluations, points=1).values())
    return {
        "task": config.task,
        "environment_arguments": config.environment_arguments,
        "perturbations": list(config.perturbations),
        "algorithm": config.algorithm,
        "hyperparameters": config.hyperparameters,
        "seed": run.seed,
        "checkpoint": which,
        "steps": steps,
        "failure": manifest.failure or None,
        "learnt_weights": _learnt_weights(run, steps),
        "commit": manifest.commit,
        "versions": manifest.versions,
        "command": manifest.command,
        "created": manifest.created,
        "evaluation": {"step": int(latest["step"][0]), **summary(latest["return"])} if len(latest) else None,
        "all_seeds": summary(np.array(last_returns)) if last_returns else None,
    }


def _learnt_weights(run: RunDirectory, steps: int) -> dict[str, float]:
    rows = run.rows("metrics")
    rows = rows[rows["step"] <= steps]
    learnt = [name for name, value in run.config.hyperparameters.items() if value == "auto"]
    columns = {name: name if name in (rows.dtype.names or ()) else "temperature" for name in learnt}  # SAC's
    values = {name: rows[column] for name, column in columns.items() if column in (rows.dtype.names or ())}
    known = {name: of[~np.isnan(of)] for name, of in values.items()}  # a callback's rows have no such value
    return {name: float(of[-1]) for name, of in known.items() if len(of)}


def summary(returns: np.ndarray) -> dict[str, Any]:
    """Return count, mean, standard deviation and 95 % t-interval of returns; None where there are too few."""
    statistics, count = mean_and_interval(returns), len(returns)
    return {
        "count": count,
        "mean_return": float(statistics.mean),
        "standard_deviation": float(returns.std(ddof=1)) if count > 1 else None,
        "interval_95": [float(statistics.low), float(statistics.high)] if count >= FEWEST_FOR_INTERVAL else None,
    }


def _verify(
    artefact: Artefact, policy: Policy, task: Task | None, arguments: dict[str, Any], episodes: int
) -> dict[str, Any]:
    """Return how the artefact compares with the policy: in actions and, given a task, in closed loop."""
    found, recorded = {}, None
    if task:
        recording = _RecordingPolicy(policy)
        policy_returns = evaluate(recording, task, episodes, environment_arguments=arguments)
        artefact_returns = evaluate(artefact, task, episodes, environment_arguments=arguments)
        if artefact.guards.fallback is None:
            check_returns(policy_returns, artefact_returns)
        found = {"returns": summary(artefact_returns), "returns_of_the_run": summary(policy_returns)}
        recorded = np.array(recording.observations)
    compared = compare_actions(artefact, policy, recorded)
    return {**found, "observations": compared.observations, "largest_difference": compared.largest}


class _RecordingPolicy:
    """A policy that records its flattened observations."""

    def __init__(self, policy: Policy) -> None:
        self.policy, self.observations = policy, []

    def predict(self, observation: Any, **options: Any) -> tuple[np.ndarray, Any]:
        self.observations.append(self.policy.contract.flatten(observation))
        return self.policy.predict(observation, **options)


def check_returns(policy_returns: np.ndarray, artefact_returns: np.ndarray) -> None:
    """Raise InputError if Welch's t-test finds the mean returns too far apart for the same policy.

    Tasks are chaotic: a difference in the last bit makes episodes diverge, so that only their statistics can agree.
    Returns that are all the same are not tested: they may come from one repeated episode.
    """
    from scipy import stats  # slow to import

    if len(policy_returns) < 2 or not (policy_returns.std() > 0 or artefact_returns.std() > 0):
        return
    welch: Any = stats.ttest_ind(policy_returns, artefact_returns, equal_var=False)
    if welch.pvalue < IMPLAUSIBLE:
        raise InputError(
            f"in closed loop the artefact is not the policy of the run: its mean return is "
            f"{artefact_returns.mean():.6g}, the policy's {policy_returns.mean():.6g}; nothing was written"
        )


def control_rate(raw: Any) -> float | None:
    """Return the actions per second of a Gymnasium environment, or None if it does not define them.

    They follow from PyFlyt's number of physics steps per environment step (at 120 Hz), else from `dt`, the time step
    of MuJoCo and classic control tasks, else from the render frames per second. The outermost wrapper that has a `dt`
    counts: one that repeats actions can tell how long its step takes.
    """
    if isinstance(ratio := getattr(raw.unwrapped, "env_step_ratio", None), int):
        return 120.0 / ratio
    step = raw.get_wrapper_attr("dt") if raw.has_wrapper_attr("dt") else None
    if isinstance(step, int | float | np.floating) and step > 0:
        return round(1.0 / float(step), 6)
    frames = raw.metadata.get("render_fps")
    return float(frames) if isinstance(frames, int | float) and frames > 0 else None
