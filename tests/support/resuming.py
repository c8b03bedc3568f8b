"""Small learners and short runs that crash where they are told to, and what such runs leave."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from logs import without_times

from csac.algorithms import CSAC, PPO, SAC, SD3, TD3
from csac.training.train import train

FILES = ("evaluations.csv", "episodes.csv", "metrics.csv", "log.txt", "policy/seed_0.safetensors")
SMALL: dict[str, Any] = {
    "actor_hidden_sizes": (8, 8),
    "critic_hidden_sizes": (8, 8),
    "batch_size": 8,
    "warmup_steps": 40,
    "replay_size": 150,
}
ROLLOUT = PPO(rollout_steps=64, minibatches=4, epochs=2, hidden_sizes=(8, 8), learning_rate_schedule="constant")
LEARNERS = [
    CSAC(reference_policy="periodic", reference_period=30, relative_entropy_estimator="closed_form", **SMALL),
    SAC(**SMALL),
    TD3(**SMALL),
    SD3(noise_samples=4, **SMALL),
    ROLLOUT,
    SAC(update_interval=7, **SMALL),
    CSAC(update_interval=3, **SMALL),
]
ADAPTIVE = CSAC(
    entropy_weight="auto",
    relative_entropy_weight="auto",
    weight_learning_rate=0.01,
    reference_policy="periodic",
    reference_period=30,
    relative_entropy_estimator="closed_form",
    critic_normalisation="batch",
    normalise_observations=True,
    policy_delay=3,
    adam_momentum=0.5,
    **SMALL,
)
SHORT: dict[str, Any] = {"evaluation_interval": 100, "evaluation_episodes": 2, "tensorboard": False}


def run(directory: Path, algorithm=LEARNERS[0], steps: int = 500, task: Any = "Hopper-v4", **settings: Any):
    settings = {"checkpoint_interval": 120, **SHORT, **settings}
    return train(algorithm, task, steps=steps, directory=directory, **settings)


def contents(directory: Path) -> dict[str, bytes]:
    """The files that an uninterrupted run would have too."""
    files = [*FILES, *(path.relative_to(directory).as_posix() for path in directory.glob("policy/*"))]
    found = {name: (directory / name).read_bytes() for name in files if (directory / name).exists()}
    return {name: without_times(content) if name == "log.txt" else content for name, content in found.items()}


class Crash(Exception):
    pass


def crash_at(step: int):
    def on_evaluation(evaluated: int, _: Any) -> None:
        if evaluated >= step:
            raise Crash

    return on_evaluation
