"""Small learners and short runs that are killed at a given step, and what such runs leave."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from csac.algorithms import CSAC, PPO, SAC, SD3, TD3
from csac.record.run import RunDirectory
from csac.training.train import train

FILES = ("evaluations.csv", "episodes.csv", "metrics.csv", "policy/last.safetensors", "policy/best.safetensors")
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
]
ADAPTIVE = CSAC(
    entropy_weight="auto",
    weight_learning_rate=0.01,
    reference_policy="periodic",
    reference_period=30,
    relative_entropy_estimator="closed_form",
    critic_normalisation="batch",
    normalise_observations=True,
    policy_delay=3,
    policy_average_rate=0.2,
    adam_momentum=0.5,
    learning_rate_schedule="cosine",
    n_steps=3,
    normalise_rewards=True,
    exploration_noise="pink",
    activation="gelu",
    critic_layer_norm=True,
    **SMALL,
)
SHORT: dict[str, Any] = {
    "evaluation_interval": 100,
    "evaluation_episodes": 2,
    "tensorboard": False,
    "evaluation_processes": 0,
    "checkpoint_interval": 120,
    "progress": False,
}


def run(directory: Path | None, algorithm=LEARNERS[0], steps: int = 500, task: Any = "Hopper-v4", **settings: Any):
    return train(algorithm, task, steps=steps, directory=directory, **{**SHORT, **settings})


def contents(run: RunDirectory) -> dict[str, bytes]:
    """The files of a run that one that was never stopped would have too."""
    return {name: (run.path / name).read_bytes() for name in FILES if (run.path / name).exists()}


class Crash(BaseException):
    """Ends a process as if it was killed: no callback's mistake, after which the run would be saved."""


def crash_at(step: int):
    def on_evaluation(evaluated: int, _: Any) -> None:
        if evaluated >= step:
            raise Crash

    return on_evaluation


def run_with_copies(directory: Path, *steps: int, **settings: Any):
    """Run to the end; after the evaluation at each of `steps`, copy what is on disk to `<directory>-<step>`.

    A copy is what a process that is killed at that moment leaves.
    """

    def on_evaluation(evaluated: int, _: Any) -> None:
        if evaluated in steps:
            shutil.copytree(directory, f"{directory}-{evaluated}")

    return run(directory, on_evaluation=on_evaluation, **settings)
