"""Each algorithm learns to swing a pendulum up, and does not where the actor climbs its loss."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from trainer import run

from csac.algorithms import CSAC, PPO, SAC, SD3, TD3

pytestmark = pytest.mark.slow
SETTINGS: dict[str, Any] = {
    "discount": 0.95,
    "target_rate": 0.01,
    "actor_learning_rate": 2e-3,
    "critic_learning_rate": 2e-3,
    "actor_hidden_sizes": (64, 64),
    "critic_hidden_sizes": (64, 64),
    "batch_size": 128,
    "warmup_steps": 500,
}
# A random policy returns about -1200 and a good one about -150.
THRESHOLD = -250.0


class Climbing(CSAC):
    def actor_loss(self, *arguments, **networks):
        loss, metrics = super().actor_loss(*arguments, **networks)
        return -loss, metrics


def mean_return(algorithm, steps: int = 3000, seed: int = 0) -> float:
    (rows,) = run(algorithm, "Pendulum-v1", steps, (seed,), episodes=10).evaluations
    assert len(rows) == 10
    return float(np.mean(rows["return"]))


@pytest.mark.parametrize(
    ("algorithm", "steps"),
    [
        (CSAC(**SETTINGS), 3000),
        (SAC(weight_learning_rate=2e-3, **SETTINGS), 3000),
        # Its actor moves at every second update.
        (TD3(exploration_std=0.3, **SETTINGS), 4500),
        (SD3(exploration_std=0.3, noise_samples=4, **SETTINGS), 3000),
    ],
    ids=["csac", "sac", "td3", "sd3"],
)
def test_the_pendulum_is_learnt(algorithm, steps):
    assert mean_return(algorithm, steps) > THRESHOLD


def test_ppo_learns_it_too_from_more_steps():
    algorithm = PPO(
        discount=0.9, learning_rate=1e-3, clip_value_loss=False, rollout_steps=512, minibatches=16, epochs=20
    )
    assert mean_return(algorithm, steps=30_000) > THRESHOLD


def test_the_pendulum_is_not_learnt_with_the_sign_of_the_actor_loss_turned():
    assert mean_return(Climbing(**SETTINGS)) < 4 * THRESHOLD
