"""Reset seeds of episodes, which training and the kinds of evaluation never share, and the wording of seed lists."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# Reset seeds of episode 0 of an evaluation; episode j has this number + j.
EVALUATION_SEED = 1_000_000  # during training: the curves
FRESH_EVALUATION_SEED = 2_000_000  # of finished policies: episodes that no choice was based on
TUNING_EVALUATION_SEED = 3_000_000  # during training for `csac tune`: to choose hyperparameters
FIRST_TRAINING_SEED = 2**30  # above every evaluation seed; all below twice this fit a C int


def training_seed(seed: int, episode: int, environment: int = 0) -> int:
    """Return the reset seed of an environment's training episode, which no evaluation episode has."""
    word = int(np.random.SeedSequence([seed, episode, environment]).generate_state(1)[0])
    return FIRST_TRAINING_SEED + word % FIRST_TRAINING_SEED


def name_seeds(seeds: Sequence[int]) -> str:
    """Return seeds in words: seed 3; seeds 3, 5; seeds 0 to 4."""
    if len(seeds) > 2 and seeds[-1] - seeds[0] == len(seeds) - 1:
        return f"seeds {seeds[0]} to {seeds[-1]}"
    return f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
