"""Real processes are killed, and what they leave in the end is what an uninterrupted run leaves.

`python tests/support/chaos.py` does the same at random moments, a hundred times.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from collections.abc import Sequence, Set
from pathlib import Path

import psutil
import pytest
from chaos import RESTARTED, TRAIN, TWO_PROCESSES, differences, reached, start, strike, workers_of

from csac.training.checkpoint import FOLDER, steps_in

# A hundred updates at each step, so that a run takes seconds and is still on its way when its kill comes.
SHORTER = ["--steps", "800", "--evaluation-interval", "200", "--updates-per-step", "100"]
ALONE = [*TRAIN, *SHORTER]
pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="POSIX signals")]


class Csac:
    """One csac process in a folder; its output is read line by line."""

    def __init__(self, folder: Path, cache: Path, arguments: Sequence[str]) -> None:
        self.run = folder / "run"
        self.process = start(folder, arguments, cache, subprocess.PIPE)
        self.lines: list[str] = []

    def until(self, text: str) -> None:
        """Read until a line has this text."""
        assert self.process.stdout
        for line in self.process.stdout:
            self.lines.append(line)
            if text in line:
                return
        raise AssertionError(f"ended with {self.process.wait()} before {text!r}:\n{''.join(self.lines)}")

    def end(self) -> int:
        """Wait for the end and return the exit code."""
        self.lines += self.process.communicate()[0].splitlines(keepends=True)
        assert "Traceback" not in "".join(self.lines)
        return self.process.returncode


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("programs")


@pytest.fixture(scope="module")
def whole(tmp_path_factory, cache):
    """An uninterrupted run of one seed."""
    csac = Csac(tmp_path_factory.mktemp("whole"), cache, ALONE)
    assert csac.end() == 0
    return csac.run


def test_a_run_survives_every_kind_of_end_in_turn(tmp_path, cache, whole):
    """SIGKILL, then SIGTERM, then Ctrl-C: one run, taken up again by each way that there is."""
    csac = Csac(tmp_path, cache, ALONE)
    csac.until("step 400 of 800")
    strike("parent", csac.process, None)
    assert csac.end() == -signal.SIGKILL
    assert steps_in(csac.run / FOLDER) == [300]
    plant_what_a_torn_write_leaves(csac.run)

    csac = Csac(tmp_path, cache, ["resume", "run"])
    csac.until("step 400 of 800")
    strike("terminate", csac.process, None)
    assert csac.end() == 128 + signal.SIGTERM
    assert "to go on, type:" in csac.lines[-1]
    stopped_at = max(steps_in(csac.run / FOLDER))
    assert stopped_at >= 400

    csac = Csac(tmp_path, cache, ALONE)  # the same command: it has --resume
    csac.until("step 600 of 800")
    strike("interrupt", csac.process, None)
    assert csac.end() == 128 + signal.SIGINT

    csac = Csac(tmp_path, cache, ["resume", "run"])
    assert csac.end() == 0
    assert differences(csac.run, whole) == []
    history = json.loads((csac.run / "manifest.json").read_text())["history"]
    assert [entry["step"] for entry in history][:2] == [300, stopped_at]
    assert all(entry["exact"] and not entry["complaints"] for entry in history)


def test_a_fork_onto_a_perturbed_task_survives_before_and_after_the_change(tmp_path, cache, whole):
    """Friction changes and noise begins between its own checkpoint, which each kill throws it back to, and the next."""
    fork = [*ALONE, "--from", f"{whole}@600", "--steps", "1000"]
    fork += ["--perturb", "friction=1.5@650", "--perturb", "action_noise=0.05@750"]
    uninterrupted = Csac(tmp_path / "whole", cache, fork)
    assert uninterrupted.end() == 0

    csac = Csac(tmp_path / "fork", cache, fork)
    csac.until("step 800 of 1,000")  # noise is on
    strike("parent", csac.process, None)
    assert csac.end() == -signal.SIGKILL
    assert steps_in(csac.run / FOLDER) == [600]

    csac = Csac(tmp_path / "fork", cache, ["resume", "run"])
    csac.until("step 800 of 1,000")
    strike("terminate", csac.process, None)
    assert csac.end() == 128 + signal.SIGTERM
    assert max(steps_in(csac.run / FOLDER)) >= 800

    csac = Csac(tmp_path / "fork", cache, ["resume", "run"])
    assert csac.end() == 0
    assert differences(csac.run, uninterrupted.run) == []


def plant_what_a_torn_write_leaves(run: Path) -> None:
    """Files without their names yet, files that no checkpoint counts on yet, and half a row."""
    folder = run / FOLDER
    (folder / ".step_600.json.4711").write_bytes(b'{"schema_ver')
    (folder / "replay" / ".seed_0.300-600.safetensors.4711").write_bytes(b"\0" * 100)
    shutil.copy(folder / "step_300.seed_0.safetensors", folder / "step_600.seed_0.safetensors")
    (run / ".manifest.json.4711").write_bytes(b"{")
    (run / "policy" / ".seed_0.safetensors.4711").write_bytes(b"\0")
    with open(run / "episodes.csv", "a") as table:
        table.write("0,3")


def test_a_worker_that_is_killed_is_replaced_and_a_second_time_named(tmp_path, cache, whole):
    """Two seeds in two processes; seed 0's is killed once, so seed 0 is as alone, and seed 1's is killed twice."""
    csac = Csac(tmp_path, cache, [*ALONE, *TWO_PROCESSES])
    csac.until("step 200 of 800")
    first, second = workers_of(csac.process)  # in the order of their start
    strike("worker", csac.process, first)
    csac.until(f"seed 0: its process was killed by SIGKILL (out of memory?); {RESTARTED}")
    replacement = newcomer(csac, {first, second})
    strike("worker", csac.process, second)
    csac.until(f"seed 1: its process was killed by SIGKILL (out of memory?); {RESTARTED}")
    strike("worker", csac.process, newcomer(csac, {first, second, replacement}))
    assert csac.end() == 3
    failures = json.loads((csac.run / "manifest.json").read_text())["failures"]
    assert list(failures) == ["1"]
    assert "for the second time, its process was killed by SIGKILL" in failures["1"]
    assert rows_of(csac.run, seed=0) == rows_of(whole, seed=0)
    assert reached(csac.run) == 800


def newcomer(csac: Csac, known: Set[psutil.Process]) -> psutil.Process:
    """Return the worker that is not among the known ones, once it can be told from its parent."""
    while csac.process.poll() is None:
        if fresh := [worker for worker in workers_of(csac.process) if worker not in known]:
            return fresh[0]
    raise AssertionError(f"ended before a worker was replaced:\n{''.join(csac.lines)}")


def rows_of(run: Path, seed: int) -> dict[str, list[str]]:
    names = ("episodes.csv", "evaluations.csv")
    return {
        name: [line for line in (run / name).read_text().splitlines() if line.startswith(f"{seed},")] for name in names
    }
