"""A seed's numbers do not depend on its company, nor on when or where it is run."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest
from trainer import run

from csac.algorithms import CSAC, PPO, SAC, SD3, TD3

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
        *(pytest.param(algorithm(**SMALL), marks=pytest.mark.slow) for algorithm in (SAC, TD3)),
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
