"""The training loop itself, run in this process, with what the seeds learnt at hand."""

from __future__ import annotations

import dataclasses
import tempfile
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from csac.record.config import RunConfig
from csac.record.manifest import Manifest
from csac.record.run import RunDirectory
from csac.training.config import name_of
from csac.training.loop import Loop
from csac.training.program import Program
from csac.training.resume import ResumePoint
from csac.training.watch import Watcher

if TYPE_CHECKING:
    import numpy as np

    from csac.types import Algorithm


class Outcome(NamedTuple):
    """What the seeds have learnt and remembered, their last evaluations and how they failed."""

    states: list[Any]
    memories: list[np.ndarray]  # [steps, width] packed transitions, in the order of the steps
    evaluations: list[np.ndarray]
    failures: list[str]


def run(
    algorithm: Algorithm,
    task: Any,
    steps: int,
    seeds: tuple[int, ...] = (0,),
    episodes: int = 1,
    environments: int = 1,
    environment_processes: int = 0,
    **arguments: Any,
) -> Outcome:
    """Train `seeds` in one program, evaluating at the end alone, and return what there is to look at."""
    with tempfile.TemporaryDirectory() as folder:
        runs = []
        for seed in seeds:
            config = RunConfig(
                task=task if isinstance(task, str) else "probe",
                algorithm=name_of(algorithm),
                hyperparameters=dataclasses.asdict(algorithm),  # pyright: ignore[reportArgumentType]
                seed=seed,
                steps=steps,
                environments=environments,
                evaluation_interval=steps,
                evaluation_episodes=episodes,
                checkpoint_interval=0,
                environment_arguments=arguments,
            )
            runs.append(RunDirectory.create(Path(folder, f"seed-{seed}"), Manifest(config=config)))
        paths = tuple(one.path for one in runs)
        program = Program(paths, algorithm, task, 1, environment_processes=environment_processes, tensorboard=False)
        with closing(Loop(program, runs, [ResumePoint(None, [])] * len(runs), Watcher())) as loop:
            loop.run(lambda: False)
            states = [loop.learner.state(index) for index in range(len(seeds))]
            memories = [loop.learner.memory(index, steps).rows for index in range(len(seeds))]
            return Outcome(states, memories, [one.evaluations for one in runs], [one.manifest.failure for one in runs])
