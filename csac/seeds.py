"""The reset seed of every episode, training and evaluations apart: no two kinds share one; what seeds are called."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# Of episode 0 of an evaluation; episode j is reset with the j-th number after it.
EVALUATION_SEED = 1_000_000  # in training: the curves
FRESH_EVALUATION_SEED = 2_000_000  # of finished policies: what nothing was chosen by
TUNING_EVALUATION_SEED = 3_000_000  # in training for `csac tune`: what hyperparameters are chosen by
FIRST_TRAINING_SEED = 2**30  # above every evaluation seed, and with as many again still a C int


def training_seed(seed: int, episode: int, environment: int = 0) -> int:
    """Return the reset seed of an environment's training episode: its own, and never an evaluation episode's."""
    word = int(np.random.SeedSequence([seed, episode, environment]).generate_state(1)[0])
    return FIRST_TRAINING_SEED + word % FIRST_TRAINING_SEED


def seeds_told(seeds: Sequence[int]) -> str:
    """Return what seeds are called in a line: seed 3; seeds 3, 5; seeds 0 to 4."""
    if len(seeds) > 2 and seeds[-1] - seeds[0] == len(seeds) - 1:
        return f"seeds {seeds[0]} to {seeds[-1]}"
    return f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
