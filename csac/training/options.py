"""The options of a set of runs that are flags of `csac train` and `csac tune` as they stand. No JAX."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from csac.checks import check_whole
from csac.record.config import MOST_EPISODES, NEVER, SEED_LIMIT, STEPS_LIMIT
from csac.types import InputError

MOST_SEEDS = 10_000


@dataclass(frozen=True, kw_only=True)
class Options:
    """How a set of runs is made. Raises InputError for a number outside its range."""

    steps: int = 1_000_000
    """Environment steps per seed, warm-up included."""
    seeds: int = 1
    """Number of independent seeds to train."""
    first_seed: int = 0
    """Label of the first seed; the others are numbered from it."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Device that the networks are trained on."""
    evaluation_interval: int = 5_000
    """Environment steps between evaluations; there is always one at the last step. 0: none at all."""
    evaluation_episodes: int = 10
    """Episodes per evaluation."""
    checkpoint_interval: int = 50_000
    """Environment steps between checkpoints; there is also one every ten minutes and at the end. 0: none at all."""
    keep_checkpoints: int = 2
    """Number of newest checkpoints to keep; 0 keeps all."""

    def __post_init__(self) -> None:
        if self.device not in ("cpu", "gpu"):
            raise InputError(f"device must be cpu or gpu, not {self.device!r}")
        for name, least, most in (
            ("steps", 1, STEPS_LIMIT),
            ("seeds", 1, MOST_SEEDS),
            ("first_seed", 0, SEED_LIMIT - 1),
            ("evaluation_interval", 0, NEVER),
            ("evaluation_episodes", 1, MOST_EPISODES),
            ("checkpoint_interval", 0, NEVER),
            ("keep_checkpoints", 0, NEVER),
        ):
            check_whole(name, getattr(self, name), least, most)
        check_whole("first_seed", self.first_seed, 0, SEED_LIMIT - self.seeds)

    @property
    def labels(self) -> list[int]:
        """The seeds, in order."""
        return list(range(self.first_seed, self.first_seed + self.seeds))
