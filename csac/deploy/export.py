"""Where an artefact goes, and where its policy comes from."""

from __future__ import annotations

import os
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.deploy.artefact import FILES
from csac.deploy.card import CARD, CURVE
from csac.deploy.contract import CONTRACT, read_json
from csac.deploy.policy import POLICY
from csac.record.statistics import FEWEST_FOR_INTERVAL, last_evaluations, mean_and_interval
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from csac.deploy.policy import Policy
    from csac.record.run import RunDirectory, Which
    from csac.record.sets import RunSet

# What an artefact's folder holds, with what Python leaves where the loader was imported.
_KNOWN = {CONTRACT, POLICY, CARD, CURVE, "__pycache__", *FILES.values()}


@contextmanager
def placed(place: Path) -> Iterator[Path]:
    """Yield a new folder that replaces `place` at the end, or is removed if something is raised."""
    try:
        _check_place(place)
        place = Path(os.path.realpath(place))  # a link stays one
        place.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{place.name}.", dir=place.parent) as aside:
            new = Path(aside, "new")
            new.mkdir()
            yield new
            if place.exists():
                os.rename(place, Path(aside, "old"))
            os.rename(new, place)
    except OSError as error:
        raise InputError(f"cannot write to {place}: {error.strerror or error}; choose another place") from error


def _check_place(place: Path) -> None:
    names = {entry.name for entry in place.iterdir()} if place.exists() else set()
    fields = read_json(place / CONTRACT) if CONTRACT in names else {}
    if names and (names - _KNOWN or "format" not in fields):
        raise InputError(f"{place} holds something else than an artefact: choose a new or an empty folder")


def provenance(runs: RunSet, run: RunDirectory, policy: Policy, which: Which) -> dict[str, Any]:
    """Return where a policy comes from and how good it was in training, for its artefact's contract.

    `evaluation` is the run's newest evaluation up to the policy, which is `steps` old, and its interval is over
    episodes. `all_seeds` is over the last evaluations of the seeds that did not fail. `learnt_weights` are the last
    ones in metrics.csv of the weights that the hyperparameters leave to be learnt.
    """
    manifest, config = run.manifest, run.config
    steps = manifest.steps_done if policy.step is None else policy.step
    own = run.evaluations
    own = own[own["step"] <= steps]
    own = own[own["step"] == own["step"].max(initial=0)]
    sound = list(last_evaluations(runs.sound_evaluations, points=1).values())
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
        "evaluation": {"step": int(own["step"][0]), **summary(own["return"])} if len(own) else None,
        "all_seeds": summary(np.array(sound)) if sound else None,
    }


def _learnt_weights(run: RunDirectory, steps: int) -> dict[str, float]:
    rows = run.rows("metrics")
    rows = rows[rows["step"] <= steps]
    learnt = [name for name, value in run.config.hyperparameters.items() if value == "auto"]
    return {name: float(rows[name][-1]) for name in learnt if len(rows) and name in (rows.dtype.names or ())}


def summary(returns: np.ndarray) -> dict[str, Any]:
    """Return the count of returns, their mean, standard deviation and 95 % t-interval; None if there are too few."""
    over, count = mean_and_interval(returns), len(returns)
    return {
        "count": count,
        "mean_return": float(over.mean),
        "standard_deviation": float(returns.std(ddof=1)) if count > 1 else None,
        "interval_95": [float(over.low), float(over.high)] if count >= FEWEST_FOR_INTERVAL else None,
    }
