"""What is measured: the libraries, every contender in every setting, and the ratios that are to be reached."""

from __future__ import annotations

import os
import shutil
import sys
import sysconfig
from pathlib import Path
from typing import NamedTuple

from benchmarks.measuring import ROOT

PEERS_PYTHON = os.environ.get("PEERS_PYTHON") or str(ROOT / ".venv-peers" / "bin" / "python")
PARL_PYTHON = os.environ.get("PARL_PYTHON") or str(ROOT / ".venv-parl" / "bin" / "python")

SINGLE, SINGLE_ONE_CORE = "one seed, 2 cores", "one seed, 1 core"
FIVE, FIVE_ONE_CORE = "five seeds, 2 cores", "five seeds, 1 core"
EVALUATED = "one seed, 2 cores, evaluation on"
TD3, PPO = "TD3, one seed, 2 cores", "PPO, one seed, 2 cores"


class Library(NamedTuple):
    """How one measurement of a library is launched, and what does its arithmetic."""

    script: str  # in benchmarks/peers; none for csac's own worker
    python: str
    engine: str
    options: tuple[str, ...] = ()

    @property
    def has_threads(self) -> bool:
        """Whether it is told how many threads to use; XLA finds out by itself."""
        return self.engine != "XLA"

    def lacks(self) -> str:
        """Return what the machine lacks to run it, in words, or nothing."""
        if not Path(self.python).exists():
            return "it is not installed; `make peers` does that, or says why not"
        if self.engine == "torch.compile" and not shutil.which(os.environ.get("CXX") or "g++"):
            return "torch.compile needs a C++ compiler: g++, or the one that CXX names"
        if self.engine == "torch.compile" and not Path(sysconfig.get_path("include"), "Python.h").exists():
            return "torch.compile needs Python's headers, Python.h (python3-dev)"
        return ""


LIBRARIES = {
    "csac": Library("", sys.executable, "XLA"),
    "sbx": Library("sb3_speed.py", PEERS_PYTHON, "XLA", ("--library=sbx",)),
    "sb3": Library("sb3_speed.py", PEERS_PYTHON, "PyTorch", ("--library=sb3",)),
    "eager": Library("cleanrl_speed.py", PEERS_PYTHON, "PyTorch"),
    "compiled": Library("cleanrl_speed.py", PEERS_PYTHON, "torch.compile", ("--compile",)),
    "tianshou": Library("tianshou_speed.py", PEERS_PYTHON, "PyTorch"),
    "parl": Library("parl_speed.py", PARL_PYTHON, "Paddle"),
}


class Case(NamedTuple):
    """One contender in one setting. The first of a setting is what the others are compared with."""

    setting: str
    contender: str
    library: str  # one of LIBRARIES
    algorithm: str = "sac"
    seeds: int = 1
    cores: int = 2
    together: int = 1  # processes side by side, the cores divided among them
    threads: int = 0  # of a library that is told, 0 for one on each core
    evaluated: bool = False
    repeated: bool = False  # measured in every repetition, and not only in the first

    @property
    def name(self) -> str:
        """What --only looks in."""
        return f"{self.setting}: {self.contender}"

    @property
    def threads_each(self) -> int:
        """Threads of each process."""
        return self.threads or self.cores // self.together

    @property
    def allowed(self) -> str:
        """What does its arithmetic, and on how much of the machine."""
        library = LIBRARIES[self.library]
        count = self.threads_each if library.has_threads else self.cores // self.together
        unit = ("thread" if library.has_threads else "core") + "s" * (count > 1)
        return f"{library.engine}, {count} {unit}" + " each" * (self.together > 1)


class Reach(NamedTuple):
    """A ratio that is to be reached between two contenders of one setting."""

    setting: str
    contender: str
    peer: str
    ratio: float


CASES = [
    Case(SINGLE, "csac SAC", "csac", repeated=True),
    Case(SINGLE, "SBX SAC", "sbx", repeated=True),
    Case(SINGLE, "SB3 SAC", "sb3", repeated=True),
    Case(SINGLE, "csac CSAC", "csac", "csac", repeated=True),
    Case(SINGLE, "CleanRL-style SAC", "eager"),
    Case(SINGLE, "CleanRL-style SAC, compiled", "compiled"),
    Case(SINGLE, "Tianshou SAC", "tianshou"),
    Case(SINGLE, "PARL SAC", "parl", threads=1),  # with two it takes twice as long
    Case(FIVE, "csac SAC", "csac", seeds=5, repeated=True),
    Case(FIVE, "SBX SAC, two at a time", "sbx", together=2, repeated=True),
    Case(FIVE, "SB3 SAC, two at a time", "sb3", together=2),
    Case(FIVE, "csac CSAC", "csac", "csac", seeds=5),
    Case(SINGLE_ONE_CORE, "csac SAC", "csac", cores=1),
    Case(SINGLE_ONE_CORE, "SBX SAC", "sbx", cores=1),
    Case(SINGLE_ONE_CORE, "SB3 SAC", "sb3", cores=1),
    Case(SINGLE_ONE_CORE, "csac CSAC", "csac", "csac", cores=1),
    Case(SINGLE_ONE_CORE, "CleanRL-style SAC", "eager", cores=1),
    Case(SINGLE_ONE_CORE, "CleanRL-style SAC, compiled", "compiled", cores=1),
    Case(FIVE_ONE_CORE, "csac SAC", "csac", seeds=5, cores=1),
    Case(EVALUATED, "csac SAC", "csac", evaluated=True),
    Case(EVALUATED, "SBX SAC", "sbx", evaluated=True),
    Case(EVALUATED, "SB3 SAC", "sb3", evaluated=True),
    Case(EVALUATED, "csac CSAC", "csac", "csac", evaluated=True),
    Case(TD3, "csac TD3", "csac", "td3", repeated=True),
    Case(TD3, "SBX TD3", "sbx", "td3", repeated=True),
    Case(TD3, "SB3 TD3", "sb3", "td3", repeated=True),
    Case(TD3, "CleanRL-style TD3", "eager", "td3"),
    Case(TD3, "Tianshou TD3", "tianshou", "td3"),
    Case(TD3, "csac SD3", "csac", "sd3"),
    Case(PPO, "csac PPO", "csac", "ppo", repeated=True),
    Case(PPO, "SBX PPO", "sbx", "ppo", repeated=True),
    Case(PPO, "SB3 PPO", "sb3", "ppo", repeated=True),
    Case(PPO, "SB3 PPO, 1 thread", "sb3", "ppo", threads=1, repeated=True),
]

REACHES = [
    Reach(SINGLE, "csac SAC", "SBX SAC", 1.4),
    Reach(SINGLE, "csac SAC", "SB3 SAC", 2.7),
    Reach(FIVE, "csac SAC", "SBX SAC, two at a time", 1.25),
    Reach(TD3, "csac TD3", "SBX TD3", 1.3),
    Reach(PPO, "csac PPO", "SB3 PPO", 3.0),
    Reach(PPO, "csac PPO", "SB3 PPO, 1 thread", 3.0),
]
