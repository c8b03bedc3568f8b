"""What environments give for actions that are drawn from a fixed generator."""

from __future__ import annotations

import numpy as np

from csac.tasks.vector import SeedEnvironments


def steps_of(environments: SeedEnvironments, count: int) -> list[tuple]:
    generator, outcomes = np.random.default_rng(5), []
    for _ in range(count):
        shape = (len(environments.seeds), environments.spec.action_size)
        outcome = environments.step(generator.uniform(-1, 1, shape).astype(np.float32))
        outcomes.append((outcome.next_observation.tolist(), outcome.reward.tolist(), outcome.episodes))
    return outcomes
