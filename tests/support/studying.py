"""Tiny studies and their cells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from resuming import SMALL

from csac.record.manifest import EvaluationPlan, Manifest
from csac.record.run import RunDirectory
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


def make_run(store: Store, one: Cell, **manifest: Any) -> RunDirectory:
    """A run as `train` would leave it."""
    return RunDirectory.create(
        store.path(one),
        Manifest(
            task=one.task,
            algorithm=one.algorithm,
            hyperparameters=one.hyperparameters,
            seeds=(one.seed,),
            steps=one.steps,
            evaluation=EvaluationPlan(one.evaluation_interval, one.evaluation_episodes),
            perturbations=one.perturbations,
            environment_arguments=one.environment_arguments,
            events=one.events,
            **manifest,
        ),
    )
