"""Random policies of tasks, and finished runs that hold them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from manifests import make_set

from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.record.sets import RunSet
from csac.tasks.environment import Environment
from csac.types import Layer, PolicyNetwork, PolicyParameters


def policy_for(task: Any, width: int = 8, seed: int = 0) -> Policy:
    """Return a random policy with one hidden layer."""
    environment = Environment(task)
    (inputs, outputs), generator = environment.spec[:2], np.random.default_rng(seed)
    layers = tuple(
        Layer(generator.normal(0, 0.3, shape).astype(np.float32), np.zeros(shape[1], np.float32))
        for shape in ((inputs, width), (width, 2 * outputs))
    )
    contract = Contract(environment.task_name, "sac", "relu", "tanh_gaussian", *environment.contract_parts)
    environment.close()
    return Policy(PolicyNetwork(PolicyParameters((layers,))), contract, step=9)


def run_of_task(
    path: Path, task: str, events: tuple[str, ...] = (), seeds: tuple[int, ...] = (0,), arguments: Any = None
) -> RunSet:
    """Return a finished set with a random policy for each seed."""
    given = {"algorithm": "sac", "steps": 9, "events": events, "environment_arguments": arguments or {}}
    runs = make_set(path, seeds, task=task, **given)
    for run in runs.runs:
        policy_for(task, seed=run.seed).write(run.policy_file())
    return runs
