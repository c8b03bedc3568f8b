"""A task that has others work for it, each of which it has to end: what becomes of them is written down."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
from pathlib import Path

import gymnasium
import psutil
from probes import Probe


class Helped(Probe):
    """A task with a simulator, which is another program, and a helper that Python starts."""

    def __init__(self, folder: str, forks: bool = True) -> None:
        super().__init__()
        self.path = Path(folder, f"{os.getpid()}-{id(self)}")
        self.path.write_text("never closed")
        context = multiprocessing.get_context("fork") if forks else multiprocessing.get_context("spawn")
        self.helper = context.Process(target=signal.pause)
        self.helper.start()
        self.simulator = subprocess.Popen(["sleep", "300"])

    def close(self) -> None:
        for one in (self.helper, self.simulator):
            one.terminate()
        self.helper.join(30)
        try:
            ends = f"{self.helper.exitcode} {self.simulator.wait(30)}"
        except subprocess.TimeoutExpired:
            ends = "the simulator went on"
        for one in (self.helper, self.simulator):
            one.kill()
        self.path.write_text(ends)


class Forking(Probe):
    """Kills its process, if that is one of several, in its first step, and leaves a fork that holds all pipes open."""

    def __init__(self, folder: str) -> None:
        super().__init__()
        self.folder = folder

    def step(self, action):
        if multiprocessing.parent_process():
            if not (fork := os.fork()):
                signal.alarm(30)  # ends it in any case
                signal.pause()
            Path(self.folder, str(fork)).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)


if "Helped-v0" not in gymnasium.registry:
    gymnasium.register("Helped-v0", entry_point=f"{__name__}:Helped")


def ends_of(folder: Path) -> tuple[int, set[str]]:
    """How many processes have made such tasks in this folder, and how those have ended."""
    files = list(folder.iterdir())
    return len({path.name.split("-")[0] for path in files}), {path.read_text() for path in files}


def end_forks(folder: Path) -> int:
    """End the forks of `Forking` tasks; return how many had not ended."""
    forks = [one for one in psutil.process_iter() if Path(folder, str(one.pid)).exists()]
    alive = [fork for fork in forks if fork.status() != psutil.STATUS_ZOMBIE]
    for fork in alive:
        fork.kill()
    return len(alive)
