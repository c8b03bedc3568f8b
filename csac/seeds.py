"""The reset seed of every episode, in training and in evaluations: no two kinds share one."""

from __future__ import annotations

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
