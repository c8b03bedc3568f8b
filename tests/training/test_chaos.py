"""Real processes are killed, and what they leave in the end is what uninterrupted ones leave (more: `make chaos`)."""

from __future__ import annotations

import subprocess
import time

import numpy as np
import pytest
from chaos import CASES, TRAIN, make_wholes, one_run, reached, start, strike, workers_of

from csac.record.sets import RunSet

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Uninterrupted runs of each case, and the compiled programs."""
    place = tmp_path_factory.mktemp("chaos")
    make_wholes(place, place / "programs")
    return place


@pytest.mark.parametrize("case", CASES)
def test_a_set_survives_every_kind_of_kill(folder, case):
    generator = np.random.default_rng(list(CASES).index(case))
    kills = one_run(folder / f"killed-{case}", case, folder / case / "run", folder / "programs", 0, generator)
    assert kills
    assert all(kill.exact and not kill.orphans for kill in kills), kills


def test_a_worker_that_is_killed_is_replaced_and_a_second_time_named(folder, tmp_path):
    command = [*TRAIN, "--steps", "4000"]
    process = start(tmp_path, command, folder / "programs", subprocess.DEVNULL)
    run = tmp_path / "run" / "seed-0"
    known: set[int] = set()
    for step in (300, 700):
        while process.poll() is None and reached(run) < step:
            time.sleep(0.02)
        fresh = [worker for worker in workers_of(process) if worker.pid not in known]
        known |= {worker.pid for worker in workers_of(process)}
        holder = int((run / ".lock").read_text())
        (victim,) = [worker for worker in fresh if worker.pid == holder]
        strike("worker", process, victim)
    assert process.wait(600) == 3
    runs = RunSet.open(tmp_path / "run")
    assert list(runs.failures) == [0]
    assert "SIGKILL" in runs.failures[0]
    assert runs.run(1).manifest.state == "finished"
