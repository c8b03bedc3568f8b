"""A seed's numbers do not depend on its company, nor on when or where it is run."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from trainer import run

from csac.algorithms import CSAC, PPO, SAC, SD3, TD3
from csac.training.train import train

SMALL: dict[str, Any] = {
    "actor_hidden_sizes": (16, 16),
    "critic_hidden_sizes": (16, 16),
    "batch_size": 16,
    "warmup_steps": 20,
}


@pytest.mark.parametrize(
    "algorithm",
    [
        CSAC(reference_policy="periodic", reference_period=7, **SMALL),
        SAC(**SMALL),
        TD3(**SMALL),
        SD3(noise_samples=4, **SMALL),
        PPO(rollout_steps=32, minibatches=2, hidden_sizes=(16, 16)),
    ],
    ids=lambda a: a.name,
)
def test_seeds_together_equal_seeds_alone(algorithm):
    seeds, steps = (0, 1, 2), 100
    together = run(algorithm, "Pendulum-v1", steps, seeds)
    for i, seed in enumerate(seeds):
        alone = run(algorithm, "Pendulum-v1", steps, (seed,))
        np.testing.assert_allclose(together.memories[i], alone.memories[0], rtol=1e-5, atol=1e-5)
        ours, theirs = jax.tree.leaves(together.states[i]), jax.tree.leaves(alone.states[0])
        for our, their in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(our, their, rtol=1e-3, atol=1e-5)
    assert not np.allclose(together.memories[0], together.memories[1], atol=0.1)


TABLES = ("evaluations.csv", "episodes.csv", "metrics.csv")


def tables(directory: Path, **settings: Any) -> dict[str, bytes]:
    """Train on Pendulum and return the bytes of each table."""
    algorithm = CSAC(**SMALL)
    settings = {"steps": 410, "evaluation_interval": 200, "evaluation_episodes": 2, "tensorboard": False, **settings}
    path = train(algorithm, "Pendulum-v1", directory=directory, **settings).path
    return {name: (path / name).read_bytes() for name in TABLES}


def lines(table: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(table.decode().splitlines()))


def test_equal_runs_write_equal_tables_and_groups_change_nothing(tmp_path):
    grouped = tables(tmp_path / "groups", seeds=2, groups=2)
    first, second = (tables(tmp_path / str(seed), first_seed=seed) for seed in (0, 1))
    assert tables(tmp_path / "again") == first
    for name in TABLES:
        apart = sorted(
            lines(first[name]) + lines(second[name]),
            key=lambda row: (int(row["step"]), int(row["seed"]), int(row.get("episode", 0))),
        )
        assert lines(grouped[name]) == apart
        assert [row for row in apart if row["seed"] == "0"] != [row for row in apart if row["seed"] == "1"]
