"""Runs as a study leaves them, without training: directories with a manifest and evaluations that are made up."""

import re

import numpy as np

from csac.record.manifest import Machine, Manifest
from csac.record.run import RunDirectory
from csac.studies.study import read_study


def write_run(path, config, height=1000.0, points=10, state="finished", episodes=2, **columns):
    """Write a run whose returns rise to about `height`; `columns` are more columns of its evaluations."""
    run = RunDirectory.create(path, Manifest(config=config, program=(config.seed,)))
    generator = np.random.default_rng(config.seed)
    interval = config.steps // 10
    for point in range(1, points + 1):
        run.append(
            "evaluations",
            [
                {"seed": config.seed, "step": point * interval, "episode": episode, "length": 10, "success": None}
                | {"return": height * point / 10 + generator.normal(0, abs(height) / 50), **columns}
                for episode in range(episodes)
            ],
        )
        run.log(f"step {point * interval}: mean return 1.0")
    failure = "step 5: reward is not finite" if state == "failed" else ""
    machine = Machine(processor="a processor", cores=1)
    changes = {"state": state, "steps_done": points * interval, "process": 1, "failure": failure}
    run.update_manifest(**changes, machine=machine, versions={"jax": "0.10"}, commit="abc")
    return run


TINY = """
tasks = ["Pendulum-v1"]
seeds = 2
steps = 1_000
evaluation_interval = 500
evaluation_episodes = 1
[common.sac]
warmup_steps = 500
batch_size = 16
replay_size = 2_000
actor_hidden_sizes = [8]
critic_hidden_sizes = [8]
[common.csac]
warmup_steps = 500
batch_size = 16
replay_size = 2_000
actor_hidden_sizes = [8]
critic_hidden_sizes = [8]
[[methods]]
algorithm = "sac"
[[methods]]
algorithm = "csac"
"""


def tiny_study(folder, **changes):
    """Two small networks on a pendulum, two seeds each."""
    path = folder / "study" / "tiny.toml"
    path.parent.mkdir(exist_ok=True)
    lines = TINY
    for name, value in changes.items():
        lines = re.sub(rf"^{name} = .*$", f"{name} = {value!r}".replace("'", '"'), lines, flags=re.MULTILINE)
    path.write_text(lines)
    return read_study(path)
