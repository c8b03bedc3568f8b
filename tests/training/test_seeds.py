"""A seed's numbers do not depend on which seeds share its program."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from resuming import LEARNERS
from trainer import run


@pytest.mark.parametrize(
    "algorithm",
    [LEARNERS[0], pytest.param(LEARNERS[2], marks=pytest.mark.slow), *LEARNERS[3:5]],  # SAC's update is CSAC's
    ids=lambda algorithm: algorithm.name,
)
def test_seeds_together_equal_a_seed_alone(algorithm):
    together = run(algorithm, "Pendulum-v1", 128, (0, 1, 2))
    alone = run(algorithm, "Pendulum-v1", 128, (2,))
    np.testing.assert_allclose(together.memories[2], alone.memories[0], rtol=1e-5, atol=1e-5)
    for ours, theirs in zip(*map(jax.tree.leaves, (together.states[2], alone.states[0])), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-5)
    for other in (0, 1):
        assert not np.allclose(together.memories[other], together.memories[2], atol=0.1)
