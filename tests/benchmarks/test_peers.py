"""Speed beside the peers, which are not installed here: the cases, the clock and the table."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks import peers, stamps
from benchmarks.measuring import Window, read_stamps, speed_of
from benchmarks.part import Options
from benchmarks.peers import CASES, measure, ratios, render, window
from csac.types import InputError


def measured(repetition: int, contender: str, steps_per_second: float) -> dict:
    row = {"repetition": repetition, "setting": "one seed", "contender": contender, "allowed": "XLA, 2 cores"}
    return {**row, "steps_per_second": steps_per_second, "start_seconds": 9.0, "peak_mib": 600.0}


MEASURED = [
    measured(0, "ours", 120.0),
    measured(0, "theirs", 100.0),
    measured(1, "ours", 90.0),
    measured(1, "theirs", 60.0),
    measured(2, "ours", 500.0),
]


def test_a_ratio_is_of_one_repetition():
    assert ratios(MEASURED, "one seed", "ours", "theirs") == [1.2, 1.5]
    row = "| one seed | theirs | XLA, 2 cores | 80 (60 to 100) | 1.35 (1.20 to 1.50) | 9.0 | 600 |"
    assert row in render(MEASURED).splitlines()


def test_each_contender_is_once_in_a_setting_and_the_first_is_ours():
    places = [(case.setting, case.contender) for case in CASES]
    assert len(set(places)) == len(places)
    for setting in {case.setting for case in CASES}:
        assert next(case for case in CASES if case.setting == setting).library == "csac"


def test_without_the_peers_only_csac_is_measured(monkeypatch):
    monkeypatch.setattr(peers, "PYTHON", "/no/such/python")
    with pytest.raises(InputError, match="run `make peers` first"):
        measure(next(case for case in CASES if case.library == "sbx"), Options())


def test_a_stamp_says_when_steps_were_over(tmp_path, monkeypatch):
    monkeypatch.setenv(stamps.FOLDER, str(tmp_path))
    monkeypatch.setenv(stamps.EVERY, "2")
    environment, began = stamps.make(), time.monotonic()
    environment.reset(seed=0)
    for _ in range(5):
        environment.step(np.zeros(6, np.float32))
    (path,) = tmp_path.iterdir()
    with path.open("a") as file:
        file.write("6 12")  # half a line
    (stamp,) = read_stamps(tmp_path)
    assert stamp[:, 0].tolist() == [2, 4]
    assert began < stamp[0, 1] < stamp[1, 1] < time.monotonic()


def test_a_window_begins_once_settled_and_lasts_its_seconds():
    stamp = np.array([[step, 100 + step / 10] for step in range(10, 101, 10)])  # 10 steps a second
    found = speed_of([stamp], Window(seconds=5.0, warmup=20, settled=40), seeds=1, launched=99.0)
    assert found == {"steps_per_second": 10.0, "steps": 60.0, "seconds": 6.0, "start_seconds": 3.0}
    assert speed_of([stamp], Window(seconds=6.5, warmup=20, settled=40), seeds=1, launched=99.0) is None
    assert speed_of([stamp], Window(seconds=1.0, warmup=20, settled=40), seeds=2, launched=99.0) is None


def test_the_window_of_several_seeds_is_the_time_that_all_train():
    fast = np.array([[step, step / 20] for step in range(10, 401, 10)])
    late = np.array([[step, 5 + step / 10] for step in range(10, 101, 10)])
    found = speed_of([fast, late], Window(seconds=5.0, warmup=20, settled=40), seeds=2, launched=0.0)
    assert found == pytest.approx({"steps_per_second": 30, "steps": 180, "seconds": 6, "start_seconds": 7})


def test_ppo_s_windows_are_whole_rollouts():
    case = next(case for case in CASES if case.algorithm == "ppo")
    counted = window(case, Options())
    assert (counted.warmup, counted.settled, counted.every) == (2048, 2048, 2048)


needs_peers = pytest.mark.skipif(not Path(peers.PYTHON).exists(), reason="the peers are not installed: make peers")


@pytest.mark.slow
@needs_peers
@pytest.mark.parametrize("library", ["sb3", "sbx"])
def test_a_peer_is_measured(library, monkeypatch):
    monkeypatch.delenv("JAX_NUMPY_RANK_PROMOTION")  # the peers promote
    case = next(case for case in CASES if case.library == library and case.cores == 1)
    (row,) = measure(case, Options(quick=True))
    assert row["steps"] >= 50
    assert row["steps_per_second"] > 0
