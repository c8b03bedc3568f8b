"""Which policy to load: of a run one seed's, or that of the seed with the best last evaluations; or a saved one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import get_args

from csac.checks import check_path
from csac.deploy.contract import CONTRACT, read_json
from csac.deploy.policy import POLICY, Policy
from csac.record.run import RunDirectory, Which, is_run
from csac.record.statistics import last_evaluations
from csac.types import InputError


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
    if not is_run(folder) and os.path.exists(folder / POLICY):
        if seed is not None or which != "last":
            raise InputError(f"{folder} holds one policy and no run: leave out seed and which")
        fields = read_json(folder / CONTRACT)
        if isinstance(fields, dict) and fields.get("guards", {}).get("fallback") is not None:
            raise InputError(f"{folder} is an artefact with guards: csac.deploy.artefact.open_artefact keeps them")
        return Policy.load(folder / POLICY)
    run = RunDirectory.open(directory)
    label = choose_seed(run, seed)
    if not has_policy(run, label, which):
        raise InputError(f"{run.path} has no best policy of seed {label}, which was never evaluated: load its last")
    return Policy.load(run.policy(label, which))


def no_policies(run: RunDirectory) -> InputError:
    """Return the error for a run without policies."""
    when = "any more" if len(run.evaluations) else "yet: its first evaluation writes them"
    return InputError(f"{run.path} holds no policies {when}")


def has_policy(run: RunDirectory, seed: int, which: Which) -> bool:
    """Whether a seed that has left a policy has this one: a best one comes with its first evaluation."""
    return which == "last" or run.policy(seed, which).exists() or bool((run.evaluations["seed"] == seed).any())


def choose_seed(run: RunDirectory, seed: int | None = None) -> int:
    """Return the label of the seed that `load` takes. Raises InputError as `load` does."""
    seeds, failures = run.seeds_with_policies(), run.manifest.failures
    labels = ", ".join(map(str, seeds))
    if not seeds:
        raise no_policies(run)
    if seed is not None:
        if seed not in seeds:
            raise InputError(f"{run.path} has no policy of seed {seed!r}; it has those of {labels}")
        return int(seed)
    sound = [seed for seed in seeds if seed not in failures]
    if not sound:
        raise InputError(
            f"every seed of {run.path} failed (seed {seeds[0]} at {failures[seeds[0]]}): train again, "
            f"or ask for what one has left by its seed, one of {labels}"
        )
    if len(sound) == 1:
        return sound[0]
    scores = last_evaluations(run.evaluations)
    ranked = [(scores[seed], -seed) for seed in sound if scores.get(seed, float("nan")) == scores.get(seed)]
    if not ranked:
        raise InputError(f"{run.path} has no evaluations to choose by: give a seed, one of {labels}")
    return -max(ranked)[1]
