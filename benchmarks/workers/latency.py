"""How long an exported policy of csac takes for an action, flat out: networks of SAC's size, nothing learnt."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

from benchmarks.measuring import TASK
from csac.algorithms import SAC
from csac.deploy.artefact_contract import ArtefactContract
from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.deploy.writing import write_artefact
from csac.evaluation.latency import measure as measure_artefact
from csac.tasks.environment import Environment

if TYPE_CHECKING:
    from csac.deploy.artefact_contract import Format


def measure(format: Format, calls: int) -> dict[str, float]:
    """Return the microseconds of single calls: percentiles."""
    algorithm, environment = SAC(), Environment(TASK)
    network = algorithm.policy(algorithm.init(jax.random.key(0), environment.spec, steps=1))
    contract = Contract(TASK, algorithm.name, network.activation, network.head, *environment.contract_parts)
    environment.close()
    with tempfile.TemporaryDirectory() as folder:
        policy = Policy(network, contract)
        write_artefact(Path(folder), policy.network, ArtefactContract(contract, format))
        (latency,) = measure_artefact(folder, calls, seconds=0)
    percentiles = np.percentile(latency.durations, [50, 99, 99.9, 100], method="higher") / 1e3
    return dict(zip(("p50", "p99", "p99.9", "max"), percentiles.tolist(), strict=True))
