"""The tables of stage 4 in results/strong, by hand: returns at equal time, comparisons, and what is left out."""

from __future__ import annotations

import csv
import runpy
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made import MadeRecords

from benchmarks.equal_time import CANDIDATE, FOLDER, PEERS, STUDY
from csac.studies.cells import Cell
from csac.studies.study import read_study
from csac.types import InputError

SCRIPT = Path(__file__).parents[1] / "results" / "strong" / "equal_time.py"
TABLES = SimpleNamespace(**runpy.run_path(str(SCRIPT)))
CONFIRMED = read_study(STUDY)
LIMITS = {"Walker2d-v4": 20.0, "Ant-v4": 30.1}
# What every seed of a peer reaches on Walker2d and Ant.
RETURNS = dict(zip(PEERS, [(100.0, 200.0), (50.0, 300.0), (350.0, 90.0), (450.0, 80.0), (10.0, 20.0)], strict=True))


def write_peer(path: Path, first: float, second: float, limit: float, steps: int = 1_000, updates: int = 900) -> None:
    """Two evaluations of ten episodes, whose returns are 1 above and 1 below their mean by turns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("peer", "task", "seed", "limit", "seconds", "step", "updates", "episode", "return", "length"))
        for share, mean in ((0.9, first), (1.0, second)):
            reached = (share * limit, round(share * steps), round(share * updates))
            for episode in range(10):
                value = mean + (1 if episode % 2 else -1)
                writer.writerow(("a peer", "a task", 0, limit, *reached, episode, value, 7))


@pytest.fixture
def folder(tmp_path) -> Path:
    """Every run of every peer, and three timed runs of the candidate on each task."""
    lines = [f"{task},{i},{seconds + i - 1}" for task, seconds in LIMITS.items() for i in range(3)]
    (tmp_path / "seconds.csv").write_text("\n".join(["task,repetition,seconds", *lines, ""]))
    for peer, values in RETURNS.items():
        for (task, limit), value in zip(LIMITS.items(), values, strict=True):
            for seed in range(100, 105):
                write_peer(tmp_path / task / peer / f"seed-{seed}.csv", 0.0, 2 * value, limit)
    return tmp_path


def candidate(cell: Cell, step: int) -> float:
    """On Walker2d 300 at 90,000 steps and 500 at 100,000; on Ant 100 at both; elsewhere what must not count."""
    if cell.task == "Ant-v4":
        return {90_000: 100.0, 100_000: 100.0}.get(step, -9_999.0)
    return {90_000: 300.0, 100_000: 500.0}.get(step, 9_999.0)


def told(folder: Path, value: Callable[[Cell, int], float | None] = candidate, **made: Callable[[Cell], str]) -> str:
    return TABLES.told(CONFIRMED, MadeRecords(value, **made), folder)


def test_the_return_at_equal_time_is_the_mean_of_both_evaluations(folder):
    lines = told(folder).splitlines()

    assert "| Walker2d-v4 | 20 | 19.0, 20.0, 21.0 |" in lines
    assert "**Ant-v4: 30.1 s, seeds 100, 101, 102, 103, 104**" in lines
    assert "| SBX CrossQ | 450.0 ± 0.0 | 450.0 | 1,000 | 900 |" in lines
    assert f"| {CANDIDATE} | 400.0 ± 0.0 | 400.0 | 100,000 |  |" in lines  # Walker2d
    assert f"| {CANDIDATE} | 100.0 ± 0.0 | 100.0 | 100,000 |  |" in lines  # Ant


def test_scores_are_shares_of_sb3_s_sac(folder):
    lines = told(folder).splitlines()

    # The candidate has 400 / 100 five times and 100 / 200 five times; of these ten the middle six are three of each.
    assert f"| {CANDIDATE} | 2.250 | 2.250 (2.250 to 2.250) | 0.500 |" in lines
    assert "| SB3 SAC | 1.000 | 1.000 (1.000 to 1.000) | 1.000 |" in lines


def test_the_candidate_is_compared_with_every_peer_over_both_tasks_and_on_each(folder):
    lines = told(folder).splitlines()

    always, never, half = "1.000 (1.000 to 1.000)", "0.000 (0.000 to 0.000)", "0.500 (0.500 to 0.500)"
    assert f"| SB3 SAC | {half} | not told apart | {always} | {never} |" in lines
    assert f"| SBX TQC | {always} | better | {always} | {always} |" in lines
    assert f"| SBX CrossQ | {half} | not told apart | {never} | {always} |" in lines
    assert lines[-1] == "Better than every one of the 5: missed."


@pytest.mark.parametrize(
    ("verdicts", "said"),
    [
        (["better"] * 5, "reached"),
        (["better"] * 4 + ["worse"], "missed"),
        (["better"] * 4 + ["no verdict"], "open: too few seeds"),
    ],
)
def test_the_aim(verdicts, said):
    assert TABLES.aim(verdicts) == said


def test_below_five_common_seeds_there_is_no_verdict(folder):
    (folder / "Ant-v4" / "sbx-simba" / "seed-102.csv").unlink()
    page = told(folder)
    lines = page.splitlines()

    assert "- not run: SBX SimBa on Ant-v4: seeds 102" in lines
    assert "- left out, since not every method has them on every task: seeds 102" in lines
    assert "**Walker2d-v4: 20 s, seeds 100, 101, 102, 103, 104**" in lines
    assert "**Ant-v4: 30.1 s, seeds 100, 101, 103, 104**" in lines
    assert "**The candidate against each peer, seeds 100, 101, 103, 104**" in lines
    assert "| SBX TQC | 1.000 | no verdict | 1.000 (1.000 to 1.000) | 1.000 |" in lines
    assert lines[-1] == "Better than every one of the 5: open: too few seeds."


def test_a_seed_that_failed_counts_as_0_and_is_listed(folder):
    write_peer(folder / "Walker2d-v4" / "sb3-sac" / "seed-101.csv", np.nan, np.nan, LIMITS["Walker2d-v4"])
    lines = told(folder, failing=lambda cell: "NaN" if (cell.task, cell.seed) == ("Ant-v4", 104) else "").splitlines()

    assert "- failed, and counted as 0: SB3 SAC on Walker2d-v4: seeds 101" in lines
    assert f"- failed, and counted as 0: {CANDIDATE} on Ant-v4: seeds 104" in lines
    # Of 100, 0, 100, 100, 100 the mean is 80 and the standard deviation 40 * 5 / sqrt(20) = 44.7.
    assert "| SB3 SAC | 80.00 ± 44.72 | 0.00 | 1,000 | 900 |" in lines
    assert f"| {CANDIDATE} | 80.00 ± 44.72 | 0.00 |  |  |" in lines


def test_the_machine_and_what_else_ran_there_are_told(folder):
    (folder / "machine.txt").write_text("processor: a fast one\n")
    (folder / "load.csv").write_text("peer,task,seed,load\nsb3-sac,Ant-v4,100,0.01\nsb3-sac,Ant-v4,101,0.05\n")
    page = told(folder)

    assert "- processor: a fast one\n- other programs kept 0.03 cores busy on average, 0.05 at most\n" in page


def test_without_the_candidate_s_stage_nothing_is_compared(folder):
    lines = told(folder, lambda cell, step: None).splitlines()

    assert f"- not run: {CANDIDATE} on Ant-v4: seeds 100, 101, 102, 103, 104" in lines
    assert lines[-1].startswith("| Ant-v4 | 30.1 |")


def test_rows_of_another_time_or_half_a_file_are_refused(folder):
    path = folder / "Ant-v4" / "sbx-tqc" / "seed-103.csv"
    write_peer(path, 0.0, 1.0, 29.0)
    with pytest.raises(InputError, match=r"seed-103.csv does not hold two evaluations of a run of 30.1 seconds"):
        told(folder)
    path.write_text("\n".join(path.read_text().splitlines()[:12]))
    with pytest.raises(InputError, match=r"seed-103.csv does not hold two evaluations"):
        told(folder)
    path.write_text("something else\n1\n")
    with pytest.raises(InputError, match=r"seed-103.csv is missing or damaged: python -m benchmarks.equal_time run"):
        told(folder)
    (folder / "seconds.csv").unlink()
    with pytest.raises(InputError, match=r"seconds.csv is missing or damaged: python -m benchmarks.equal_time seconds"):
        told(folder)


def test_the_tables_are_of_the_runs_that_are_made():
    assert tuple(TABLES.PEERS) == PEERS
    assert TABLES.CANDIDATE == CANDIDATE
    assert FOLDER.parent == SCRIPT.parent == STUDY.parent
