"""The tables of stage 4 in results/strong, by hand: returns at equal time, comparisons, and what is left out."""

from __future__ import annotations

import csv
import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made import MadeRecords

from benchmarks.equal_time import CANDIDATE, FOLDER, OWN, PEERS, SHARES, STEPS, STUDY
from csac.studies.cells import Cell
from csac.studies.study import read_study
from csac.types import InputError

SCRIPT = Path(__file__).parents[1] / "results" / "strong" / "equal_time.py"
TABLES = SimpleNamespace(**runpy.run_path(str(SCRIPT)))
CONFIRMED = read_study(STUDY)
LIMITS = {"Walker2d-v4": 20.0, "Ant-v4": 30.0}
SAC = "SAC, candidate"
RATES = {CANDIDATE: 5_000.0, SAC: 4_600.0, **dict.fromkeys(PEERS, 100.0)}  # steps per second
STEPS_IN_T = {(CANDIDATE, task): STEPS for task in LIMITS} | {(SAC, "Walker2d-v4"): 110_000, (SAC, "Ant-v4"): 92_000}
# What every seed of a peer reaches on Walker2d and Ant.
RETURNS = dict(zip(PEERS, [(100.0, 200.0), (50.0, 300.0), (350.0, 90.0), (450.0, 80.0), (10.0, 20.0)], strict=True))


def write_peer(path: Path, limit: float, early: float, late: float) -> None:
    """Evaluations of ten episodes, whose returns are 1 above and 1 below their mean.

    That is `early`, and in the last fifth half, half, one and a half times and one and a half times `late`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("peer", "task", "seed", "step", "updates", "episode", "return", "length"))
        for share in SHARES:
            for episode in range(10):
                mean = early if share <= 0.8 else late * (0.5 if share <= 0.9 else 1.5)
                value = mean + (1 if episode % 2 else -1)
                writer.writerow(("a peer", "a task", 0, round(100 * share * limit), 900, episode, value, 7))


@pytest.fixture
def folder(tmp_path) -> Path:
    """A plan for every contender, and every run of every peer."""
    lines = ["task,contender,limit,rate,share,steps"]
    for task, limit in LIMITS.items():
        for contender, rate in RATES.items():
            steps = STEPS_IN_T.get((contender, task), rate * limit)
            name = f'"{contender}"' if "," in contender else contender
            lines += [f"{task},{name},{limit},{rate},{share},{round(share * steps)}" for share in SHARES]
    (tmp_path / "plan.csv").write_text("\n".join([*lines, ""]))
    for peer, values in RETURNS.items():
        for (task, limit), value in zip(LIMITS.items(), values, strict=True):
            for seed in range(100, 105):
                write_peer(tmp_path / task / peer / f"seed-{seed}.csv", limit, value / 2, value)
    return tmp_path


def candidate(cell: Cell, step: int) -> float:
    """On Walker2d 300, 300, 500 and 500 in the last fifth; on Ant 100; before that 7. SAC's are step / 100."""
    if cell.algorithm == "sac":
        return step / 100
    if step <= 80_000:
        return 7.0
    return 100.0 if cell.task == "Ant-v4" else 300.0 + 200.0 * (step > 90_000)


def told(folder: Path, value: Callable[[Cell, int], float | None] = candidate, **made: Callable[[Cell], str]) -> str:
    return TABLES.told(CONFIRMED, MadeRecords(value, **made), folder)


def test_the_return_at_equal_time_is_the_mean_of_the_last_fifth(folder):
    lines = told(folder).splitlines()

    assert "| Ant-v4 | SBX TQC | 100.0 | 30 | 3,000 |" in lines
    assert f"| Ant-v4 | {CANDIDATE} | 5000.0 | 30 | 100,000 |" in lines
    assert "**Ant-v4: seeds 100, 101, 102, 103, 104**" in lines
    crossq = "| 225.0 | 225.0 | 225.0 | 225.0 | 675.0 |"  # at 0.2, 0.4, 0.6, 0.8 and 1 of the time
    assert f"| SBX CrossQ | 450.0 ± 0.0 | 450.0 {crossq}" in lines
    assert f"| {CANDIDATE} | 400.0 ± 0.0 | 400.0 | 7.00 | 7.00 | 7.00 | 7.00 | 500.0 |" in lines  # Walker2d
    assert f"| {CANDIDATE} | 100.0 ± 0.0 | 100.0 | 7.00 | 7.00 | 7.00 | 7.00 | 100.0 |" in lines  # Ant


def test_sac_is_told_by_the_steps_that_it_makes_in_t_and_of_no_more_than_it_was_run_for(folder):
    lines = told(folder).splitlines()

    assert "| Walker2d-v4 | SAC, candidate | 4600.0 | 20 | 110,000 |" in lines
    note = "110,000 steps in T, but it was run for 100,000, which is what is told of it"
    assert f"- SAC, candidate on Walker2d-v4: {note}" in lines
    assert not any("SAC, candidate on Ant-v4:" in line for line in lines)
    # Evaluated every 5,000 steps: at 0.2 to 1 T the last by 22,000 to 110,000; the mean of 85,000 to 100,000.
    assert "| SAC, candidate | 925.0 ± 0.0 | 925.0 | 200.0 | 400.0 | 650.0 | 850.0 | 1,000.0 |" in lines
    # The last by 18,400 to 92,000 steps; the mean of those above 73,600 = 0.8 x 92,000: 75,000 to 90,000.
    assert "| SAC, candidate | 825.0 ± 0.0 | 825.0 | 150.0 | 350.0 | 550.0 | 700.0 | 900.0 |" in lines


def test_a_share_by_which_a_peer_has_made_no_step_is_empty(folder):
    plan, path = folder / "plan.csv", folder / "Ant-v4" / "sbx-tqc"
    lines = plan.read_text().splitlines()
    plan.write_text("\n".join(line for line in lines if not re.match(r"Ant-v4,sbx-tqc,.*,0\.[1-4],", line)))
    for run in path.iterdir():
        rows = run.read_text().splitlines()
        run.write_text("\n".join([rows[0], *rows[41:]]))

    assert "| SBX TQC | 90.00 ± 0.00 | 90.00 |  |  | 45.00 | 45.00 | 135.0 |" in told(folder).splitlines()


def test_scores_are_shares_of_sb3_s_sac(folder):
    lines = told(folder).splitlines()

    # The candidate has 400 / 100 five times and 100 / 200 five times; of these ten the middle six are three of each.
    assert f"| {CANDIDATE} | 2.250 | 2.250 (2.250 to 2.250) | 0.500 |" in lines
    assert "| SB3 SAC | 1.000 | 1.000 (1.000 to 1.000) | 1.000 |" in lines


def test_the_candidate_is_compared_with_every_peer_over_both_tasks_and_on_each(folder):
    page, _, secondary = told(folder).partition("**SAC, candidate (secondary), against each peer: seeds 100, ")
    lines = page.strip().splitlines()

    always, never, half = "1.000 (1.000 to 1.000)", "0.000 (0.000 to 0.000)", "0.500 (0.500 to 0.500)"
    assert f"| SB3 SAC | {half} | not told apart | {always} | {never} |" in lines
    assert f"| SBX TQC | {always} | better | {always} | {always} |" in lines
    assert f"| SBX CrossQ | {half} | not told apart | {never} | {always} |" in lines
    assert lines[-1] == "Better than every one of the 5: missed."
    assert re.findall(r"^\| (S.*?) \| (.*) \| better \|", secondary, re.MULTILINE) == [
        (label, always) for label in TABLES.PEERS.values()
    ]


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
    assert "**Walker2d-v4: seeds 100, 101, 102, 103, 104**" in lines
    assert "**Ant-v4: seeds 100, 101, 103, 104**" in lines
    assert f"**{CANDIDATE}, against each peer: seeds 100, 101, 103, 104**" in lines
    assert "| SBX TQC | 1.000 | no verdict | 1.000 (1.000 to 1.000) | 1.000 |" in lines
    assert "Better than every one of the 5: open: too few seeds." in lines


def test_a_seed_that_failed_counts_as_0_and_is_listed(folder):
    write_peer(folder / "Walker2d-v4" / "sb3-sac" / "seed-101.csv", LIMITS["Walker2d-v4"], np.nan, np.nan)
    failed = ("csac", "Ant-v4", 104)
    lines = told(
        folder, failing=lambda cell: "NaN" if (cell.algorithm, cell.task, cell.seed) == failed else ""
    ).splitlines()

    assert "- failed, and counted as 0: SB3 SAC on Walker2d-v4: seeds 101" in lines
    assert f"- failed, and counted as 0: {CANDIDATE} on Ant-v4: seeds 104" in lines
    # Of 100, 0, 100, 100, 100 the mean is 80 and the standard deviation 40 * 5 / sqrt(20) = 44.7.
    assert "| SB3 SAC | 80.00 ± 44.72 | 0.00 |  |  |  |  |  |" in lines
    assert f"| {CANDIDATE} | 80.00 ± 44.72 | 0.00 |  |  |  |  |  |" in lines


def test_the_machine_and_what_else_ran_there_are_told(folder):
    (folder / "machine.txt").write_text("processor: a fast one\n")
    (folder / "speeds.csv").write_text("contender,load\nsb3-sac,0.01\nsbx-sac,0.05\n")
    page = told(folder)

    load = "while speeds were measured, other programs kept 0.03 cores busy on average, 0.05 at most"
    assert f"- processor: a fast one\n- {load}\n" in page


def test_the_picture_shows_means_and_ranges_by_the_wall_clock(folder, monkeypatch):
    write_peer(folder / "Ant-v4" / "sbx-crossq" / "seed-101.csv", LIMITS["Ant-v4"], 40.0, 180.0)  # the others: 80
    drawn = []
    monkeypatch.setitem(TABLES.draw.__globals__, "save", lambda figure, *_: drawn.append(figure))
    TABLES.draw(CONFIRMED, MadeRecords(candidate), folder, Path("picture.png"))

    walker, ant = drawn[0].axes
    assert (walker.get_title("left"), walker.get_xlim(), ant.get_xlim()) == ("Walker2d-v4", (0, 20), (0, 30))
    assert len(walker.lines) == len(ant.lines) == len(PEERS) + len(OWN)
    mean = dict(zip(ant.lines[PEERS.index("sbx-crossq")].get_xdata(), ant.lines[3].get_ydata(), strict=True))
    assert (mean[3.0], mean[30.0]) == (40.0, 1.5 * (4 * 80 + 180) / 5)  # after 0.1 and 1 of 30 s
    band = ant.collections[3].get_paths()[0].vertices
    assert (band[:, 1].max(), band[:, 1].min()) == (1.5 * 180, 40.0)
    texts = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert texts == ["CSAC, preset strong", "SAC, preset strong", *TABLES.PEERS.values()]


def test_without_the_candidate_s_stage_nothing_is_compared(folder):
    lines = told(folder, lambda cell, step: None).splitlines()

    assert f"- not run: {CANDIDATE} on Ant-v4: seeds 100, 101, 102, 103, 104" in lines
    assert lines[-1].startswith(f"| Ant-v4 | {SAC} |")


def test_rows_of_another_plan_or_half_a_file_are_refused(folder):
    path = folder / "Ant-v4" / "sbx-tqc" / "seed-103.csv"
    write_peer(path, 29.0, 0.0, 1.0)
    with pytest.raises(InputError, match=r"seed-103.csv does not hold the evaluations of plan.csv: remove it"):
        told(folder)
    write_peer(path, 30.0, 0.0, 1.0)
    path.write_text("\n".join(path.read_text().splitlines()[:-1]))
    with pytest.raises(InputError, match=r"seed-103.csv does not hold the evaluations of plan.csv"):
        told(folder)
    path.write_text("something else\n1\n")
    with pytest.raises(InputError, match=r"seed-103.csv is missing or damaged: python -m benchmarks.equal_time run"):
        told(folder)


def test_without_a_whole_plan_there_are_no_tables(folder):
    plan = folder / "plan.csv"
    plan.write_text("\n".join(line for line in plan.read_text().splitlines() if not line.startswith("Ant-v4,sbx-sac")))
    with pytest.raises(InputError, match=r"sbx-sac on Ant-v4 was not measured: python -m benchmarks.equal_time speeds"):
        told(folder)
    plan.write_text("\n".join(line for line in plan.read_text().splitlines() if f'"{SAC}"' not in line))
    with pytest.raises(InputError, match=r"SAC, candidate on Walker2d-v4 was not measured"):
        told(folder)
    plan.unlink()
    with pytest.raises(InputError, match=r"plan.csv is missing or damaged: python -m benchmarks.equal_time speeds"):
        told(folder)


def run_script(monkeypatch, *arguments: str | Path) -> None:
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *map(str, arguments)])
    runpy.run_path(str(SCRIPT), run_name="__main__")


def test_the_tables_are_written_between_the_marks_of_a_page(folder, tmp_path, monkeypatch, capsys):
    page = tmp_path / "page.md"
    page.write_text("Before.\n\n<!-- time: begin -->\nold\n<!-- time: end -->\n\nAfter.\n")
    given = ("--folder", folder, "--results", tmp_path / "nothing", "--into")
    run_script(monkeypatch, *given, f"{page}#time")

    before, _, rest = page.read_text().partition("<!-- time: begin -->\n")
    tables, _, after = rest.partition("<!-- time: end -->")
    assert (before, after, capsys.readouterr().out) == ("Before.\n\n", "\n\nAfter.\n", "")
    run_script(monkeypatch, *given[:-1])
    assert tables.strip() == capsys.readouterr().out.strip() != ""
    with pytest.raises(SystemExit, match="the page lacks the lines <!-- other: begin -->"):
        run_script(monkeypatch, *given, f"{page}#other")
    with pytest.raises(SystemExit, match=r"say between which marks to write: .*page\.md#NAME"):
        run_script(monkeypatch, *given, page)


def test_the_tables_are_of_the_runs_that_are_made():
    assert tuple(TABLES.PEERS) == PEERS
    assert (TABLES.CANDIDATE, TABLES.OWN, TABLES.STEPS) == (CANDIDATE, OWN, STEPS)
    assert FOLDER.parent == SCRIPT.parent == STUDY.parent
