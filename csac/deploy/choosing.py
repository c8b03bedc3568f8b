"""Load a saved policy, or one of a run: a given seed's, or that of the seed with the best last evaluations."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import get_args

from csac.checks import check_path
from csac.deploy.contract import CONTRACT, read_json
from csac.deploy.policy import POLICY, Policy
from csac.record.run import RunDirectory, Which
from csac.record.sets import RunSet
from csac.record.statistics import last_evaluations
from csac.types import InputError


def load(directory: str | os.PathLike[str], seed: int | None = None, which: Which = "last") -> Policy:
    """Return a policy of a run, or one saved on its own by `Policy.save`.

    Args:
        directory: a set of runs, a run, or the folder of a policy saved on its own.
        seed: the seed's label; by default the seed with the best mean return over its last three evaluation points,
            among those that did not fail. That choice favours a lucky seed: report the policy's return on fresh
            evaluation seeds.
        which: the seed's `last` policy, or the one of its `best` evaluation. The best is a maximum over all evaluation
            points, each a mean over a few fixed starts (ten by default), so its recorded return is biased upwards,
            the more so the noisier the evaluations: evaluate it on fresh seeds before you report it.

    Raises:
        InputError: there is no run or no such seed (the message names the seeds there are), a file is damaged, or every
            seed failed and none was given.
    """
    if which not in get_args(Which):
        raise InputError(f"which={which!r}: choose 'last' or 'best'")
    check_path("a run directory", directory)
    folder = Path(directory)
    if os.path.exists(folder / POLICY):
        if seed is not None or which != "last":
            raise InputError(f"{folder} holds one policy and no run: leave out seed and which")
        fields = read_json(folder / CONTRACT)
        if isinstance(fields, dict) and fields.get("guards", {}).get("fallback") is not None:
            raise InputError(f"{folder} is an artefact with guards: csac.deploy.artefact.open_artefact keeps them")
        return Policy.load(folder / POLICY)
    return load_run(choose_run(RunSet.open(directory), seed, which), which)


class TrainedRuns(RunSet):
    """The runs that `train` and `resume` return, with a method that loads their policies."""

    def policy(self, seed: int | None = None, which: Which = "last") -> Policy:
        """Return the policy that `load` would. Raises InputError as `load` does."""
        return load(self, seed, which)


def load_run(run: RunDirectory, which: Which = "last") -> Policy:
    """Return a policy of one run. Raises InputError if it has none yet or the file is damaged."""
    if not has_policy(run, which):
        raise InputError(f"{run.path} has no {which} policy yet: its first evaluation writes it")
    return Policy.load(run.policy_file(which))


def has_policy(run: RunDirectory, which: Which) -> bool:
    """Return whether a run has written this policy; the best one is first written at the first evaluation."""
    return run.policy_file(which).exists()


def choose_run(runs: RunSet, seed: int | None = None, which: Which = "last") -> RunDirectory:
    """Return the run whose policy `load` returns. Raises InputError as `load` does."""
    if seed is not None:
        return runs.run(seed)
    candidates = [run for run in runs.runs if run.manifest.state != "failed" and has_policy(run, which)]
    if not candidates and runs.failures:
        failed, reason = next(iter(runs.failures.items()))
        raise InputError(f"every seed of {runs.path} failed (seed {failed} at {reason}): train again, or give a seed")
    if not candidates:
        raise InputError(f"{runs.path} holds no policies: an evaluation writes them")
    scores = last_evaluations(RunSet(runs.path, candidates).evaluations)
    scores = {seed: score for seed, score in scores.items() if not math.isnan(score)}
    if len(candidates) > 1 and not scores:
        seeds = ", ".join(map(str, runs.seeds))
        raise InputError(f"{runs.path} has no evaluations to choose by: give a seed, one of {seeds}")
    return max(candidates, key=lambda run: (scores.get(run.seed, -math.inf), -run.seed))
