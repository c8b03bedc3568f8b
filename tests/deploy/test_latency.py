"""How long an artefact takes: what is counted and what is not, by a clock that the test moves."""

from __future__ import annotations

import shlex
import time

import numpy as np
import pytest
from artefacts import leave
from policies import algorithm_policy

from csac.cli import main
from csac.console.tables import latency_table
from csac.deploy.artefact import open_artefact
from csac.deploy.latency import Latency, measure, time_calls


class Clock:
    """Time that passes by sleeping, by calls, and by nothing else."""

    def __init__(self, monkeypatch) -> None:
        self.now, self.seen = 0, []
        monkeypatch.setattr(time, "perf_counter_ns", lambda: self.now)
        monkeypatch.setattr(time, "sleep", self.sleep)

    def sleep(self, seconds):
        self.now += round(seconds * 1e9) + 50  # woken 50 ns late

    def call(self, observation):
        self.seen.append(int(observation[0]))
        duration = 3_000 if len(self.seen) == 3 else 100
        self.now += duration
        return duration


def test_flat_out_only_the_call_is_counted(monkeypatch):
    clock = Clock(monkeypatch)
    durations, lateness = time_calls(clock.call, [np.zeros(1), np.ones(1)], 5)
    assert durations.tolist() == [100, 100, 3_000, 100, 100]
    assert lateness.tolist() == [0] * 5
    assert clock.seen == [0, 1, 0, 1, 0]


def test_at_a_rate_a_call_that_is_too_long_makes_those_after_it_late(monkeypatch):
    durations, lateness = time_calls(Clock(monkeypatch).call, [np.zeros(1)], 6, 1_000)
    assert durations.tolist() == [100, 100, 3_000, 100, 100, 100]
    # Due at 1,000, 2,000, ...; the third begins at 3,050 and ends at 6,050. Nobody sleeps then: 4,000 is due since
    # 2,050, 5,000 since 1,150 (at 6,150), 6,000 since 250 (at 6,250).
    assert lateness.tolist() == [50, 50, 50, 2_050, 1_150, 250]


def test_each_call_is_counted_flat_out_and_at_the_tasks_rate(tmp_path, format):
    folder = leave(tmp_path, algorithm_policy("csac"), format, control_rate_hz=2000.0)
    flat_out, timed = measure(open_artefact(folder, optimise=True), calls=25, seconds=0.02)
    assert (len(flat_out.durations), flat_out.lateness, flat_out.rate) == (25, None, None)
    assert timed.lateness is not None
    assert (len(timed.durations), len(timed.lateness), timed.rate) == (40, 40, 2000.0)
    assert (np.concatenate([flat_out.durations, timed.durations]) > 0).all()
    assert (timed.lateness >= 0).all(), "none begins before it is due"


def test_percentiles_are_calls_that_were_made():
    """Of 1, 2, ..., 1,000 μs: the 50th percentile is that of the 501st of 1,000, since half of them are quicker."""
    microseconds = np.arange(1, 1_001)
    (row,) = latency_table({"c": [Latency(1_000 * microseconds, 2_000 * microseconds, 10.0)]}).table.rows
    texts = [cell.text for cell in row.cells]
    assert texts == ["c, at 10 Hz", "1,000", "501.0", "991.0", "1,000", "1,000", "1,982", "2,000"]


def test_the_command_prints_a_row_for_each(tmp_path, capsys):
    folder = leave(tmp_path / "numpy", algorithm_policy("csac"), "numpy")
    assert main(shlex.split(f"latency {folder} --calls 20 --rate 1000 --seconds 0.01")) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    rows = [line[1:] for line in lines if line and line[0].endswith("/numpy,")]
    assert [row[:3] for row in rows] == [["flat", "out", "20"], ["at", "1000", "Hz"]]
    assert [len(row) for row in rows] == [7, 10]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "give the folder of an artefact"),
        ("nowhere", "nowhere is not an artefact"),
        ("numpy --calls 0", "calls 0"),
        ("numpy --rate 0", "rate 0"),
        ("numpy --rate 0.05 --seconds 10", "rate 0.05"),
    ],
)
def test_mistakes_are_told_in_one_line(tmp_path, monkeypatch, capsys, line, message):
    monkeypatch.chdir(tmp_path)
    leave(tmp_path / "numpy", algorithm_policy("csac"), "numpy")
    assert main(["latency", *shlex.split(line)]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
