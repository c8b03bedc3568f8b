"""Which of a run's policies to load: one seed's, or that of the seed with the best last evaluations."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.record.run import RunDirectory, is_run
from csac.record.tables import read_rows
from csac.types import InputError

EVALUATION_POINTS = 3

Which = Literal["last", "best"]


def load(directory: str | Path, seed: int | None = None, which: Which = "last") -> Policy:
    """Return a policy of a run.

    Args:
        directory: the run directory.
        seed: the seed's label; by default the seed with the best mean return over its last three evaluation points,
            among those that did not fail. That choice favours a lucky seed: report the policy on fresh evaluation
            seeds.
        which: the seed's `last` policy, or the one of its `best` evaluation. The best is a maximum over all evaluation
            points, each a mean over a few fixed starts (ten by default), so that its own number is too high, and more
            so the noisier they are: evaluate it on fresh seeds before you say how good it is.

    Raises:
        InputError: no run there, no such seed (the message names those there), a damaged file, or every seed failed and
            none was asked for.
    """
    directory = Path(directory)
    if which not in get_args(Which):
        raise InputError(f"which={which!r}: choose 'last' or 'best'")
    if not directory.is_dir():
        raise InputError(f"{directory} is not a directory: give the directory of a run")
    folder = directory / "policy"
    seeds = _seeds(folder)
    if not seeds:
        raise InputError(f"{directory} holds no policies: give the directory of a run that has been evaluated once")
    if seed is None:
        seed = _best_seed(directory / "evaluations.csv", _without_failed(directory, seeds))
    elif seed not in seeds:
        raise InputError(f"{directory} has no policy of seed {seed}; it has those of {_listed(seeds)}")
    name = f"seed_{seed}.safetensors" if which == "last" else f"seed_{seed}.best.safetensors"
    return Policy.load(folder / name, Contract.load(folder / "contract.json"))


def _seeds(folder: Path) -> list[int]:
    names = (re.fullmatch(r"seed_([0-9]{1,18})\.safetensors", path.name) for path in folder.glob("seed_*.safetensors"))
    return sorted(int(match[1]) for match in names if match)


def _without_failed(directory: Path, seeds: list[int]) -> list[int]:
    """Return the seeds that did not fail. What a failed one has left may never have learnt anything."""
    failures = RunDirectory.open(directory).manifest["failures"] if is_run(directory) else {}
    sound = [seed for seed in seeds if str(seed) not in failures]
    if not sound:
        reason = failures[str(seeds[0])]
        raise InputError(
            f"every seed of {directory} failed (seed {seeds[0]} at {reason}): train again, "
            f"or ask for what one has left by its seed, one of {_listed(seeds)}"
        )
    return sound


def _best_seed(path: Path, seeds: list[int]) -> int:
    if len(seeds) == 1:
        return seeds[0]
    scores = _last_evaluations(path) if path.exists() else {}
    ranked = [(scores[seed], -seed) for seed in seeds if seed in scores]
    if not ranked:
        raise InputError(f"{path} has no evaluations to choose by: give a seed, one of {_listed(seeds)}")
    return -max(ranked)[1]


def _last_evaluations(path: Path) -> dict[int, float]:
    """Return each seed's mean return over its last evaluation points; a line still being written does not count."""
    rows = read_rows(path)
    if len(rows) and "return" not in (rows.dtype.names or ()):
        raise InputError(f"{path} has no column of returns: give a seed, or restore it from a copy")
    scores = {}
    for seed in np.unique(rows["seed"]):
        of_seed = rows[rows["seed"] == seed]
        points = np.unique(of_seed["step"])[-EVALUATION_POINTS:]
        score = float(np.mean([of_seed["return"][of_seed["step"] == step].mean() for step in points]))
        if not math.isnan(score):
            scores[int(seed)] = score
    return scores


def _listed(seeds: list[int]) -> str:
    return ", ".join(str(seed) for seed in seeds)
