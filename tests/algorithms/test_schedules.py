"""Learning rates that fall over a run, to zero at its end."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import pytest
from equations import SPEC, begin, transitions, update
from probes import ConstantReward
from trainer import run

from csac.algorithms import PPO, SAC, SD3, TD3
from csac.algorithms.networks import Progress, init_optimiser, scheduled

TINY: dict[str, Any] = {
    "actor_hidden_sizes": (4,),
    "critic_hidden_sizes": (4,),
    "batch_size": 4,
    "warmup_steps": 10,
}
# Adam's step is the learning rate where the gradient is always 1. Of four planned steps of 0.1 these are left; the
# cosines are 0.05 (1 + cos(0, 45, 90, 135, 180 degrees)).
STEPS = {
    "constant": [0.1, 0.1, 0.1, 0.1, 0.1],
    "linear": [0.1, 0.075, 0.05, 0.025, 0.0],
    "cosine": [0.1, 0.0853553, 0.05, 0.0146447, 0.0],
}


@pytest.mark.parametrize("schedule", STEPS)
def test_the_steps_of_a_schedule_by_hand(schedule):
    optimiser, parameter = SAC(learning_rate_schedule=schedule).optimiser(0.1, 4), jnp.zeros(())
    state, steps = init_optimiser(optimiser, parameter), []
    for _ in range(5):
        step, state = optimiser.update(jnp.ones(()), state, parameter)
        steps.append(-float(jnp.asarray(step)))
    assert steps == pytest.approx(STEPS[schedule], rel=1e-4, abs=1e-8)


@pytest.mark.parametrize("schedule", STEPS)
def test_ppo_follows_the_same_schedules(schedule):
    ppo = PPO(learning_rate=0.1, learning_rate_schedule=schedule)
    rates = [float(ppo.learning_rate_at(jnp.int32(step), jnp.float32(4.0))) for step in range(5)]
    assert rates == pytest.approx(STEPS[schedule], rel=1e-4, abs=1e-8)
    assert ppo.cadence.has_schedule == (schedule != "constant")
    assert float(scheduled(schedule, jnp.float32(1.0))) == pytest.approx(float(schedule == "constant"), abs=1e-7)


def progress_of(optimiser_state: Any) -> tuple[int, int]:
    """Steps made and steps planned."""
    (progress,) = (part for part in optimiser_state if isinstance(part, Progress))
    return int(progress.done), int(progress.planned)


def test_a_schedule_ends_with_the_run():
    # 40 steps of two environments: an update after every second, from number 10 on, is 16, of which a delay of 3 leaves
    # the actor 5.
    algorithm = TD3(learning_rate_schedule="linear", updates_per_step=0.5, policy_delay=3, **TINY)
    state = run(algorithm, ConstantReward, 40, environments=2).states[0]
    assert progress_of(state.critic_optimiser) == (16, 16)
    assert progress_of(state.actor_optimiser) == (5, 5)


def test_both_pairs_of_sd3_follow_the_schedule():
    algorithm = SD3(learning_rate_schedule="linear", noise_samples=2, **TINY)
    first, second = update(algorithm, begin(algorithm, SPEC), transitions(8))[0]
    for optimiser in (first.actor_optimiser, first.critic_optimiser, second.actor_optimiser, second.critic_optimiser):
        assert progress_of(optimiser) == (1, 991)  # of the 1000 steps of `begin`
