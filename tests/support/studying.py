"""Tiny studies and their cells."""

from __future__ import annotations

from pathlib import Path

from resuming import SMALL

from csac.studies.cells import Cell, Store
from csac.studies.job import Job

TINY = """
title = "Tiny"
tasks = ["Hopper-v4"]
seeds = 2
steps = 300
evaluation_interval = 100
evaluation_episodes = 2

[[methods]]
label = "SAC"
algorithm = "sac"
[methods.hyperparameters]
actor_hidden_sizes = [8, 8]
critic_hidden_sizes = [8, 8]
batch_size = 8
warmup_steps = 40
replay_size = 150
"""


def write(path: Path, text: str = TINY) -> Path:
    path.write_text(text)
    return path


def cell(seed: int = 0, task: str = "Hopper-v4", **changes) -> Cell:
    given = {"steps": 300, "evaluation_interval": 100, "evaluation_episodes": 2, **changes}
    algorithm, hyperparameters = given.pop("algorithm", "sac"), given.pop("hyperparameters", {})
    return Cell.make(task, algorithm, {**SMALL, **hyperparameters}, seed=seed, **given)


def jobs(directory: Path, *cells: Cell, **options) -> list[Job]:
    store = Store(directory)
    options = {"checkpoint_interval": 120, "tensorboard": False, "keep_checkpoints": True, **options}
    return [Job(one, store.path(one), **options) for one in cells]
