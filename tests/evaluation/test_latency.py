"""How long an artefact takes: what is counted and what is not, told apart by a clock that the test moves."""

from __future__ import annotations

import io
import re
import shlex
import time
from pathlib import Path

import numpy as np
import pytest
from artefacts import WITHOUT_ABSOLUTE_SLEEP, needs_compiler
from policies import algorithm_policy
from rich.console import Console

from csac.cli import main
from csac.console.exports import size_table
from csac.console.latencies import latency_cells, latency_table
from csac.deploy.artefact_contract import ArtefactContract
from csac.deploy.c_size import Size
from csac.deploy.writing import write_artefact
from csac.evaluation import latency
from csac.evaluation.export import Exported
from csac.evaluation.latency import Latency, measure, measure_python
from csac.types import InputError

FORMATS = [
    "numpy",
    pytest.param("c", marks=needs_compiler),
]


def leave(folder, format):
    folder.mkdir()
    policy = algorithm_policy("csac")
    write_artefact(folder, policy.network, ArtefactContract(policy.contract, format, control_rate=2000.0))
    return folder


class Clock:
    """Time that passes by sleeping, by calls, and by nothing else."""

    def __init__(self, monkeypatch) -> None:
        self.now, self.seen = 0, []
        monkeypatch.setattr(time, "perf_counter_ns", lambda: self.now)
        monkeypatch.setattr(time, "sleep", self.sleep)

    def sleep(self, seconds):
        self.now += round(seconds * 1e9) + 50  # woken 50 ns late

    def act(self, observation):
        self.seen.append(int(observation[0]))
        self.now += 3_000 if len(self.seen) == 3 else 100


def test_flat_out_only_the_call_is_counted(monkeypatch):
    clock = Clock(monkeypatch)
    durations, lateness = np.ones((2, 5), np.int64)
    measure_python(clock.act, np.array([[0.0], [1.0]], np.float32))(5, 0, durations, lateness)
    assert durations.tolist() == [100, 100, 3_000, 100, 100]
    assert lateness.tolist() == [0] * 5
    assert clock.seen == [0, 1, 0, 1, 0]


def test_at_a_rate_a_call_that_is_too_long_makes_those_after_it_late(monkeypatch):
    clock = Clock(monkeypatch)
    durations, lateness = np.zeros((2, 6), np.int64)
    measure_python(clock.act, np.zeros((2, 1), np.float32))(6, 1_000, durations, lateness)
    assert durations.tolist() == [100, 100, 3_000, 100, 100, 100]
    # Due at 1,000, 2,000, ...; the third begins at 3,050 and ends at 6,050. Nobody sleeps then: 4,000 is due since
    # 2,050, 5,000 since 1,150 (at 6,150), 6,000 since 250 (at 6,250).
    assert lateness.tolist() == [50, 50, 50, 2_050, 1_150, 250]


def test_lateness_is_carried_from_part_to_part(monkeypatch):
    """The same calls as above: what is too long in one part makes those of the next ones late."""
    clock = Clock(monkeypatch)
    _, lateness = latency._in_parts(measure_python(clock.act, np.zeros((2, 1), np.float32)), 6, 3, 1_000)
    assert lateness.tolist() == [50, 50, 50, 2_050, 1_150, 250]


@needs_compiler
@pytest.mark.parametrize("before", ["", WITHOUT_ABSOLUTE_SLEEP], ids=["until a time", "for a while"])
def test_in_c_calls_are_due_after_those_before_them(tmp_path, monkeypatch, before):
    source, period = tmp_path / "latency.c", 2_000_000
    source.write_text(before + latency.LATENCY.read_text())
    monkeypatch.setattr(latency, "LATENCY", source)
    make_calls = latency._measure_c(latency.open_artefact(leave(tmp_path / "artefact", "c")))
    durations, lateness = np.zeros((2, 5), np.int64)
    due = make_calls(5, period, durations, lateness)
    assert (lateness >= 0).all()
    again = make_calls(5, period, durations, lateness, due - 1_000 * period)
    assert again == due - 995 * period
    assert (lateness > 990 * period).all()


@pytest.mark.parametrize("format", FORMATS)
def test_each_call_is_counted_flat_out_and_at_the_tasks_rate(tmp_path, monkeypatch, format):
    monkeypatch.setattr(latency, "WARM_UP", 10)
    flat_out, timed = measure(leave(tmp_path / "artefact", format), calls=25, seconds=0.02)
    assert (len(flat_out.durations), flat_out.lateness, flat_out.rate) == (25, None, None)
    assert timed.lateness is not None
    assert (len(timed.durations), len(timed.lateness), timed.rate) == (40, 40, 2000.0)
    for durations in (flat_out.durations, timed.durations):
        assert (durations > 0).all()
    assert (timed.lateness >= 0).all(), "none begins before it is due"


def test_percentiles_are_calls_that_were_made():
    """Of 1, 2, ..., 1,000 μs: the 50th percentile is that of the 501st of 1,000, since half of them are quicker."""
    microseconds = np.arange(1, 1_001)
    cells = latency_cells(Latency(1_000 * microseconds, 2_000 * microseconds, 10.0))
    assert cells == ["501.0", "991.0", "1,000", "1,000", "1,982", "2,000"]
    assert latency_cells(Latency(np.array([1_500])))[:4] == ["1.5"] * 4


def test_the_command_prints_a_row_for_each_and_draws(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(latency, "WARM_UP", 10)
    folder, picture = leave(tmp_path / "numpy", "numpy"), tmp_path / "latency.png"
    assert main(shlex.split(f"latency {folder} --calls 20 --rate 1000 --seconds 0.01 --plot {picture}")) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    rows = [line[1:] for line in lines if line and line[0].endswith("/numpy,")]
    assert [row[:3] for row in rows] == [["flat", "out", "20"], ["at", "1000", "Hz"]]
    assert [len(row) for row in rows] == [7, 10]
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_no_number_is_cut_at_any_width(width):
    console = Console(file=io.StringIO(), width=width)
    several = [Latency(np.full(100_000, 3_800)), Latency(np.full(500, 4_000), np.full(500, 123_456_789), 50.0)]
    console.print(latency_table({"runs/cheetah/export/numpy": several}))
    size = Size("this machine", 2_345, 1_234_567, 0, 1_024)
    console.print(size_table([Exported(Path(), None, [], None, [size])]))  # pyright: ignore[reportArgumentType]
    text = console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]
    words = [word for line in text.splitlines() for word in line.split()]
    for word in ("100,000", "500", "3.8", "4.0", "123,457", "2,345", "1,234,567", "1,024", "p99.9"):
        assert word in words
    assert "…" not in text
    assert all(len(line) <= width for line in text.splitlines())


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "give the folder of an artefact (csac export writes one)"),
        ("nowhere", "nowhere does not exist; give the folder of an artefact (csac export writes one)"),
        (".", ". holds no artefact itself: give numpy"),
        ("numpy --calls 0", "calls must be at least 1, not 0"),
        ("numpy --calls 100000000000000", "calls must be at most 100,000,000, not 100,000,000,000,000"),
        (
            "numpy --rate 1e6 --seconds 1e9",
            "1e+09 seconds at 1e+06 Hz are more than 100,000,000 calls: take fewer seconds",
        ),
        ("numpy --rate 0", "the rate must be more than 0 Hz and at most 1e9, not 0"),
        ("numpy --seconds nan", "seconds must be 0 or more and at most 1e+09, not nan"),
        ("numpy --rate 1e-11 --seconds 1e12", "seconds must be 0 or more and at most 1e+09, not 1e+12"),
        (
            "numpy --rate 0.05 --seconds 10",
            "10 seconds at 0.05 Hz are less than one call: give more seconds or a higher rate",
        ),
        (
            "numpy --rate 1e-300",
            "10 seconds at 1e-300 Hz are less than one call: give more seconds or a higher rate",
        ),
        ("numpy --plot curve.pdf", "the picture is a .png file: name it curve.png"),
    ],
)
def test_mistakes_are_told_in_one_line(tmp_path, monkeypatch, capsys, line, message):
    monkeypatch.chdir(tmp_path)
    leave(tmp_path / "numpy", "numpy")
    assert main(["latency", *shlex.split(line)]) == 2
    assert capsys.readouterr() == ("", f"csac: {message}\n")


def test_a_rate_that_no_call_can_keep_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(latency, "WARM_UP", 10)
    folder = leave(tmp_path / "numpy", "numpy")
    assert main(["latency", str(folder), *shlex.split("--calls 20 --rate 1e9 --seconds 0.01")]) == 2
    assert re.search(r"numpy: at 1e\+09 Hz a call is due every 1 ns, and one takes [\d,]+ ns", capsys.readouterr().err)


def test_an_observation_lies_between_the_bounds_that_a_task_has(tmp_path):
    policy, folder = algorithm_policy("csac"), tmp_path / "bounded"
    folder.mkdir()
    low, high = np.array([-1.0, -np.inf, 5.0, 0.0, -1e30]), np.array([1.0, np.inf, 6.0, 0.0, 1e30])
    fields = ArtefactContract(policy.contract, "numpy", observation_low=low, observation_high=high)
    write_artefact(folder, policy.network, fields)
    drawn = latency._observations(latency.open_artefact(folder))
    assert ((drawn >= low) & (drawn <= high)).all()
    assert 5.0 < drawn[:, 2].min() < drawn[:, 2].max() < 6.0
    with pytest.raises(InputError, match="does not exist"):
        measure(tmp_path / "gone")
