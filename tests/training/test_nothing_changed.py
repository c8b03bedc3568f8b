"""A change that is not meant to alter learning alters no number of a fixed-seed run.

`digests.json` holds what these runs gave on processors at hand; its keys say what the last bits depend on. The runs
are made by a process of their own, with programs as a user has them: those of other tests are optimised less.
After a change that is meant to alter numbers, and only then: python tests/training/test_nothing_changed.py
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from csac.algorithms import CSAC, PPO, SAC, SD3, TD3
from csac.presets import hyperparameters
from csac.training.train import train

pytestmark = pytest.mark.slow
DIGESTS = Path(__file__).with_name("digests.json")
SMALL: dict[str, Any] = {
    "actor_hidden_sizes": (32, 32),
    "critic_hidden_sizes": (32, 32),
    "batch_size": 32,
    "warmup_steps": 100,
}
LEARNERS = {
    "csac": CSAC(reference_policy="periodic", reference_period=50, relative_entropy_estimator="closed_form", **SMALL),
    "csac, paper": CSAC(**hyperparameters("paper", "csac", "Hopper-v4") | SMALL),
    "csac, strong": CSAC(**hyperparameters("strong", "csac", "Hopper-v4") | SMALL),
    "csac, average": CSAC(**SMALL),
    "sac": SAC(**SMALL),
    "sac, paper": SAC(**hyperparameters("paper", "sac", "Hopper-v4") | SMALL),
    "sac, strong": SAC(**hyperparameters("strong", "sac", "Hopper-v4") | SMALL),
    "td3": TD3(**SMALL),
    "sd3": SD3(noise_samples=5, **SMALL),
    "ppo": PPO(rollout_steps=128, minibatches=4, hidden_sizes=(32, 32)),
}
TABLES = ("evaluations.csv", "episodes.csv", "metrics.csv")


def digest(name: str, seeds: int, directory: Path) -> str:
    """Train on Hopper and return a checksum of the tables."""
    run = train(
        LEARNERS[name],
        "Hopper-v4",
        steps=500,
        seeds=seeds,
        seeds_per_process=seeds,
        evaluation_processes=0,
        directory=directory,
        evaluation_interval=250,
        evaluation_episodes=2,
        checkpoint_interval=0,
        tensorboard=False,
    )
    return hashlib.sha256(b"".join(joined([one.path / table for one in run.runs]) for table in TABLES)).hexdigest()[:16]


def joined(tables: list[Path]) -> bytes:
    """Return the rows of these tables, step by step and seed by seed, below their header."""
    headers, *_ = {table.read_bytes().splitlines(keepends=True)[0] for table in tables}
    rows = [line for table in tables for line in table.read_bytes().splitlines(keepends=True)[1:]]
    columns = headers.decode().strip().split(",")
    order = [columns.index(name) for name in ("step", "seed", "episode") if name in columns]
    return headers + b"".join(sorted(rows, key=lambda row: [int(bytes(row).split(b",")[place]) for place in order]))


def machine() -> str:
    """What the last bits depend on, beside the group's size."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    facts = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    flags = [flag for flag in ("avx2", "fma", "avx512f", "avx512_bf16") if flag in facts.get("flags", "").split()]
    model = " ".join(facts.get(name, "?") for name in ("vendor_id", "cpu family", "model"))
    packages = ", ".join(f"{name} {version(name)}" for name in ("jaxlib", "mujoco", "gymnasium", "optax", "numpy"))
    return f"{model}, {' '.join(flags)}; {packages}"


CASES = [*((name, 1) for name in LEARNERS), ("csac", 2), ("ppo", 2)]  # the seeds of one group
COMPARED = [("csac", 1), ("csac", 2)]  # with each other, on any machine


@pytest.fixture(scope="module")
def given() -> dict[str, str]:
    """What the runs give here and now, those that there is something to compare with, and one of them again."""
    surroundings = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    command = [sys.executable, __file__, "--print"]
    return json.loads(subprocess.run(command, env=surroundings, stdout=subprocess.PIPE, text=True, check=True).stdout)


@pytest.mark.parametrize(("name", "seeds"), CASES)
def test_the_numbers_are_those_that_were_written_down(given, name, seeds):
    case, known = f"{name}, {seeds}", json.loads(DIGESTS.read_text()).get(machine(), {})
    if case not in known:
        pytest.skip(f"nothing was written down for {case} on such a machine: {machine()}")
    assert given[case] == known[case]


def test_two_runs_give_the_same_numbers_and_another_number_of_seeds_others(given):
    assert given["csac, 1, again"] == given["csac, 1"]
    assert given["csac, 2"] != given["csac, 1"]


def made(cases: list[tuple[str, int]]) -> dict[str, str]:
    """Return what these runs give here and now."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
        return {f"{name}, {seeds}": digest(name, seeds, Path(folder) / f"{name} {seeds}") for name, seeds in cases}


def write_down() -> None:
    """Add or replace what the runs give on this machine."""
    known = json.loads(DIGESTS.read_text()) if DIGESTS.exists() else {}
    DIGESTS.write_text(json.dumps({**known, machine(): made(CASES)}, indent=2) + "\n")


if __name__ == "__main__":
    if sys.argv[1:] == ["--print"]:
        known = json.loads(DIGESTS.read_text()).get(machine(), {})
        wanted = [case for case in CASES if "{}, {}".format(*case) in known or case in COMPARED]
        print(json.dumps({**made(wanted), "csac, 1, again": made([("csac", 1)])["csac, 1"]}))
    else:
        write_down()
