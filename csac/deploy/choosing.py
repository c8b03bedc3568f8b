"""Which policy to load: of a run one seed's, or that of the seed with the best last evaluations; or a saved one."""

from __future__ import annotations

import math
import os
from numbers import Integral
from pathlib import Path
from typing import get_args

import numpy as np

from csac.checks import check_path
from csac.deploy.artefact_contract import ArtefactContract, artefacts_below, is_artefact
from csac.deploy.contract import Contract, read_json
from csac.deploy.policy import CONTRACT, SAVED, Policy
from csac.record.run import RunDirectory, Which, is_run
from csac.record.statistics import evaluation_matrix, last_evaluations
from csac.types import InputError

_OPENED = "open it with csac.deploy.artefact.open_artefact, or load its run"


def load(directory: str | Path, seed: int | None = None, which: Which = "last") -> Policy:
    """Return a policy of a run, or one that was saved by itself (`Policy.save`).

    Args:
        directory: the run directory, or the folder of the saved policy, which has neither seeds nor a choice of them.
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
    if which not in get_args(Which):
        raise InputError(f"which={which!r}: choose 'last' or 'best'")
    check_path("a run directory", directory)
    folder = Path(directory)
    if not is_run(folder) and os.path.exists(folder / SAVED):
        return _saved(folder, seed, which)
    if not is_run(folder) and os.path.isdir(folder):
        _refuse_artefacts(folder)
    run = RunDirectory.open(directory)
    label = choose_seed(run, seed)
    if not has_policy(run, label, which):
        raise InputError(f"{run.path} has no best policy of seed {label}, which was never evaluated: load its last")
    return Policy.load(run.policy(label, which), Contract.load(run.contract))


def _saved(folder: Path, seed: int | None, which: Which) -> Policy:
    """Return the policy that was saved by itself, or has left as an artefact without guards or noise."""
    if seed is not None or which != "last":
        raise InputError(f"{folder} holds one policy and no run: leave out seed and which")
    fields = read_json(folder / CONTRACT)
    if not isinstance(fields, dict) or "artefact_version" not in fields:
        return Policy.load(folder / SAVED, Contract.of_fields(fields, folder / CONTRACT))
    artefact = ArtefactContract.load(folder)
    if artefact.guards.is_any:
        raise InputError(f"{folder} is an artefact with guards: csac.deploy.artefact.open_artefact keeps them")
    if artefact.noise_seed is not None:
        raise InputError(f"{folder} is an artefact that samples: csac.deploy.artefact.open_artefact keeps its noise")
    if artefact.file != SAVED:
        raise InputError(f"{folder} is an artefact of the format {artefact.format}: {_OPENED}")
    return Policy.load(folder / SAVED, artefact.policy)


def _refuse_artefacts(folder: Path) -> None:
    """Raise InputError where a folder holds what `csac export` has written, in a format that is no `Policy`."""
    if is_artefact(folder):
        kind = ArtefactContract.load(folder).format
        raise InputError(f"{folder} is an exported artefact of the format {kind}: {_OPENED}")
    if below := artefacts_below(folder):
        raise InputError(f"{folder} holds no run, and exported artefacts in {', '.join(map(str, below))}: {_OPENED}")


def no_policies(run: RunDirectory) -> InputError:
    """Return what to raise for a run without policies."""
    when = "any more" if len(run.evaluations) else "yet: its first evaluation writes them"
    return InputError(f"{run.path} holds no policies {when}")


def has_policy(run: RunDirectory, seed: int, which: Which) -> bool:
    """Whether a seed that has left a policy has this one: a best one comes with its first evaluation."""
    return which == "last" or run.policy(seed, which).exists() or bool((run.evaluations["seed"] == seed).any())


def choose_seed(run: RunDirectory, seed: int | None = None) -> int:
    """Return the label of the seed that `load` takes. Raises InputError as `load` does."""
    seeds = run.seeds_with_policies()
    if not seeds:
        raise no_policies(run)
    if seed is None:
        return _best_seed(run, _without_failed(run, seeds))
    if isinstance(seed, bool) or not isinstance(seed, Integral):
        raise InputError(f"seed is the label of one, a whole number, not {seed!r:.40}")
    if seed not in seeds:
        raise InputError(f"{run.path} has no policy of seed {seed}; it has those of {_listed(seeds)}")
    return int(seed)


def _without_failed(run: RunDirectory, seeds: list[int]) -> list[int]:
    """Return the seeds that did not fail. What a failed one has left may never have learnt anything."""
    failures = run.manifest.failures
    sound = [seed for seed in seeds if seed not in failures]
    if not sound:
        raise InputError(
            f"every seed of {run.path} failed (seed {seeds[0]} at {failures[seeds[0]]}): train again, "
            f"or ask for what one has left by its seed, one of {_listed(seeds)}"
        )
    return sound


def _best_seed(run: RunDirectory, seeds: list[int]) -> int:
    if len(seeds) == 1:
        return seeds[0]
    rows = run.evaluations
    if "return" not in (rows.dtype.names or ()):
        raise InputError(f"the evaluations.csv of {run.path} has no returns: give a seed, or restore it from a copy")
    scores = {seed: score for seed, score in last_evaluations(rows).items() if not math.isnan(score)}
    ranked = [(scores[seed], -seed) for seed in seeds if seed in scores]
    if not ranked:
        raise InputError(f"{run.path} has no evaluations to choose by: give a seed, one of {_listed(seeds)}")
    return -max(ranked)[1]


def _listed(seeds: list[int]) -> str:
    return ", ".join(str(seed) for seed in seeds)


def step_of_policy(run: RunDirectory, seed: int, which: Which) -> int:
    """Return how many environment steps a seed had made when its last or best policy was taken.

    The file of the policy says so. One from before it did is taken for that of the best evaluation, or for as old as
    its seed. Raises InputError for a file that is not there or damaged.
    """
    step = Policy.load(run.policy(seed, which), Contract.load(run.contract)).step
    if step is not None:
        return step
    rows = run.evaluations
    return best_step(rows[rows["seed"] == seed]) if which == "best" else run.manifest.steps_of(seed)


def best_step(rows: np.ndarray) -> int:
    """Return the step of the evaluation with the highest mean return, the first of equals; the rows are of one seed."""
    steps, _, returns = evaluation_matrix(rows)
    return int(steps[np.argmax(returns[0])])
