"""Training speed compared with Stable-Baselines3 and SBX: environment steps, each with its update, per second."""

from __future__ import annotations

import os
import statistics
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from benchmarks.measuring import ROLLOUT_STEPS, ROOT, Launch, Window, csac_command, time_training, usable_cores
from benchmarks.part import Options, Part
from benchmarks.tables import Row, grouped, table, with_range
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

PYTHON = os.environ.get("PEERS_PYTHON") or str(ROOT / ".venv-peers" / "bin" / "python")
ENGINES = {"csac": "XLA", "sbx": "XLA", "sb3": "PyTorch"}  # XLA uses the cores it is bound to
PACKAGES = ("stable_baselines3", "torch", "sbx-rl", "jax", "gymnasium", "mujoco", "numpy")
QUIET = 0.2  # cores that other programs may keep busy on a quiet machine

SINGLE, SINGLE_ONE_CORE, FIVE = "one seed, 2 cores", "one seed, 1 core", "five seeds, 2 cores"
TD3, PPO = "TD3, one seed, 2 cores", "PPO, one seed, 2 cores"


class Case(NamedTuple):
    """One contender in one setting; the others are compared with the first of the setting."""

    setting: str
    contender: str
    library: str
    algorithm: str = "sac"
    seeds: int = 1
    cores: int = 2
    processes: int = 1  # in parallel, sharing the cores
    threads: int = 0  # of PyTorch; 0: one per core

    @property
    def name(self) -> str:
        """The text that --only searches."""
        return f"{self.setting}: {self.contender}"

    @property
    def threads_each(self) -> int:
        """Threads or cores per process."""
        return self.threads or self.cores // self.processes

    @property
    def allowed(self) -> str:
        """The arithmetic backend, and its threads or cores."""
        unit = "thread" if ENGINES[self.library] == "PyTorch" else "core"
        plural, each = "s" * (self.threads_each > 1), " each" * (self.processes > 1)
        return f"{ENGINES[self.library]}, {self.threads_each} {unit}{plural}{each}"

    @property
    def command(self) -> list[str]:
        """The command that starts one process."""
        if self.library == "csac":
            return csac_command(self.algorithm, seeds=self.seeds)
        words = f"--library {self.library} --algorithm {self.algorithm} --threads {self.threads_each}".split()
        return [PYTHON, str(ROOT / "benchmarks" / "peers" / "speed.py"), *words]


CASES = [
    Case(SINGLE, "csac SAC", "csac"),
    Case(SINGLE, "SBX SAC", "sbx"),
    Case(SINGLE, "SB3 SAC", "sb3"),
    Case(SINGLE, "csac CSAC", "csac", "csac"),
    Case(FIVE, "csac SAC", "csac", seeds=5),
    Case(FIVE, "SBX SAC, two at a time", "sbx", processes=2),
    Case(FIVE, "SB3 SAC, two at a time", "sb3", processes=2),
    Case(SINGLE_ONE_CORE, "csac SAC", "csac", cores=1),
    Case(SINGLE_ONE_CORE, "SBX SAC", "sbx", cores=1),
    Case(SINGLE_ONE_CORE, "SB3 SAC", "sb3", cores=1),
    Case(TD3, "csac TD3", "csac", "td3"),
    Case(TD3, "SBX TD3", "sbx", "td3"),
    Case(TD3, "SB3 TD3", "sb3", "td3"),
    Case(PPO, "csac PPO", "csac", "ppo"),
    Case(PPO, "SBX PPO", "sbx", "ppo"),
    Case(PPO, "SB3 PPO", "sb3", "ppo"),
    Case(PPO, "SB3 PPO, 1 thread", "sb3", "ppo", threads=1),  # with such small networks one thread may be faster
]


def measure(case: Case, options: Options) -> list[Row]:
    """Measure the training speed of one contender.

    Raises:
        InputError: the peers are not installed.
    """
    if case.library != "csac" and not Path(PYTHON).exists():
        raise InputError(f"there is no {PYTHON}: run `make peers` first, or choose with --only")
    cores = usable_cores()[: case.cores]
    launches = [Launch(case.command, cores[i :: case.processes]) for i in range(case.processes)]
    found = time_training(launches, window(case, options), max(case.seeds, case.processes))
    return [{"setting": case.setting, "contender": case.contender, "allowed": case.allowed, **found}]


def window(case: Case, options: Options) -> Window:
    """Return when steps are counted: longer for five seeds, in whole rollouts with their updates for PPO."""
    counted = options.window(20.0 if case.seeds > 1 else 5.0)
    if case.algorithm == "ppo":
        return counted._replace(warmup=ROLLOUT_STEPS, settled=ROLLOUT_STEPS, every=ROLLOUT_STEPS)
    return counted


def notes(rows: list[Row]) -> list[str]:
    """Return what the results depend on besides the machine."""
    loads = [row["other_load"] for row in rows]
    quiet = "" if max(loads) <= QUIET else ": **not a quiet machine**"
    return [
        *([f"peers: {_versions()}"] if Path(PYTHON).exists() else []),
        f"other programs kept {statistics.mean(loads):.2f} cores busy on average, {max(loads):.2f} at most{quiet}",
    ]


def _versions() -> str:
    code = "import sys, importlib.metadata as m; print(', '.join(f'{n} {m.version(n)}' for n in sys.argv[1:]))"
    return subprocess.run([PYTHON, "-c", code, *PACKAGES], capture_output=True, text=True, check=True).stdout.strip()


def ratios(
    rows: Sequence[Row], setting: str, contender: str, peer: str, column: str = "steps_per_second"
) -> list[float]:
    """Return the speed ratio of contender and peer for each repetition that has both."""
    ours, theirs = (
        {row["repetition"]: row[column] for row in rows if (row["setting"], row["contender"]) == key}
        for key in ((setting, contender), (setting, peer))
    )
    return [ours[repetition] / theirs[repetition] for repetition in sorted(ours.keys() & theirs.keys())]


def render(rows: Sequence[Row]) -> str:
    """Return a table with a row for each contender of each setting."""
    lines = []
    for (setting, contender), mine in grouped(rows, "setting", "contender").items():
        first = next(row["contender"] for row in rows if row["setting"] == setting)
        against = ratios(rows, setting, first, contender) if contender != first else []
        lines.append(
            [
                *(setting, contender, mine[0]["allowed"]),
                with_range([row["steps_per_second"] for row in mine], ".0f"),
                with_range(against, ".2f") if against else "",
                f"{statistics.median(row['start_seconds'] for row in mine):.1f}",
                f"{max(row['peak_mib'] for row in mine):.0f}",
            ]
        )
    head = ["setting", "", "allowed", "steps/s", "the setting's first / this", "start, s", "peak memory, MiB"]
    return table(head, lines)


PARTS = [Part("peers", "benchmarks/README.md", "steps per second", CASES, measure, render, 3, notes)]
