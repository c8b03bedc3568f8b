"""The tables of results/: their rules by hand, and that the committed ones follow from the committed rows."""

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any

import collect
import make
import numpy as np
import pytest
import tables
from chaos import MARKERS, Kill, summary
from shown import make_set

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results.md"
PAGES = [*ROOT.glob("results/*/README.md"), ROOT / "results" / "reference" / "mechanism.md", RESULTS]


def rows(*curves: list[float]) -> np.ndarray:
    """Evaluations at steps 10, 20, ... of seeds 0, 1, ..."""
    told = [(seed, 10 * (i + 1), value, np.nan) for seed, curve in enumerate(curves) for i, value in enumerate(curve)]
    return np.array(told, make.COLUMNS)


def cells(table: str, *labels: str) -> list[str]:
    """What stands in the row of a table that begins with these labels."""
    lines = [line.strip("| ").split(" | ") for line in table.splitlines()]
    (row,) = [line for line in lines if line[: len(labels)] == list(labels)]
    return row[len(labels) :]


def test_the_final_return_is_the_mean_of_the_last_fifth_of_the_steps():
    # Of 50 steps those after 40 count; the falls are from 5 to 2 and none.
    found = tables.measure(rows([1, 5, 2, 2, 3], [1, 2, 3, 4, 4]), 50)
    assert found.final.tolist() == [3, 4]
    assert found.drawdown.tolist() == found.loss.tolist() == [3, 0]
    assert np.isnan(found.early).all()  # nothing was evaluated at 100,000


def test_the_loss_after_a_change_is_the_area_lost_as_a_share_of_the_return_before():
    # After step 20 the return 4 falls to 2 and comes back: losses 0, 2, 0, 0 at 20, 30, 40, 50 make 20 in area, over 4.
    assert tables.measure(rows([4, 4, 2, 4, 4]), 50, changed_at=20).loss.tolist() == [5.0]


def test_dispersion_across_runs_worked_by_hand():
    # At 100: quartiles of 0, 1, 2, 3, 4 are 1 and 3, range 2. At 200: of 0, 10, 20, 30, 40 range 20. At 300 one lacks.
    returns = np.array([[n, 10 * n, n] for n in (0.0, 1.0, 2.0, 3.0, 4.0)])
    returns[2, 2] = np.nan
    assert tables.dispersion_across(returns) == pytest.approx((2 + 20) / 2)
    assert np.isnan(tables.dispersion_across(returns[:1]))
    assert np.isnan(tables.dispersion_across(np.full((2, 3), np.nan)))


def test_scores_are_shares_of_the_first_arm_and_pairs_of_seeds_are_compared():
    found = {
        "Hopper-v4": {
            "SAC, 0.2": tables.measure(rows([0, 0, 0, 0, 2], [0, 0, 0, 0, 4]), 50),
            "CSAC, paper": tables.measure(rows([0, 9, 0, 0, 5], [0, 0, 0, 0, 1]), 50),
        }
    }
    _, overall, compared = tables.study_tables("S", found, [0, 1])
    assert cells(overall, "CSAC, paper") == ["1.000", "1.000", "0.333"]  # 5/3 and 1/3
    # 5 is above 2 and 4, 1 above neither; falls of 9 and 0 against 0 and 0: two pairs lost, two drawn.
    assert cells(compared, "CSAC, paper", "**SAC, 0.2**") == ["0.500", "no verdict", "0.250", "no verdict", "0.500"]


@pytest.mark.parametrize(
    ("interval", "said"),
    [((0.51, 0.9), "better"), ((0.1, 0.49), "worse"), ((0.5, 0.9), "no significant difference"), (None, "no verdict")],
)
def test_a_verdict_needs_an_interval_beside_one_half(interval, said):
    assert tables.verdict(interval) == said


def test_returns_are_set_against_the_first_arm():
    table = tables.returns_table({"one": rows([2, 2, 2, 2]), "two": rows([9, 6, 6, 6], [0, 0, 0, 0])})
    assert cells(table, "one") == ["1", "40", "2.00", "1 seed: no interval", "1.00", "2.00 at 10"]
    assert cells(table, "two") == ["2", "40", "3.00 ± 4.24", "2 seeds: no interval", "1.50", "4.50 at 10"]


def test_seeds_that_miss_the_boundary_are_censored_and_tie():
    # Of two arms of five seeds one reaches 5 at step 20 in four seeds, the other at step 30 in one: 20 pairs won,
    # one seed that never gets there loses one pair and ties four.
    quick, slow, never = [0.0, 5, 5, 5, 5], [0.0, 0, 5, 5, 5], [0.0] * 5
    runs = {"one": rows(quick, quick, quick, quick, never), "two": rows(slow, never, never, never, never)}
    told = tables.boundary_tables(runs, 5, 50)
    assert cells(told, "two")[0] == "0: 30, 1: not reached, 2: not reached, 3: not reached, 4: not reached"
    assert cells(told, "is first at the boundary")[0].startswith("0.880 ")
    assert "Difference of the returns: 3 (" in told
    assert "against" not in tables.boundary_tables({name: of[of["seed"] < 4] for name, of in runs.items()}, 5, 50)


def test_a_finished_run_is_collected_once(tmp_path):
    for name, head in (("runs", collect.RUNS), ("evaluations", collect.EVALUATIONS)):
        (tmp_path / f"{name}.csv").write_text(",".join(head) + "\n")
    (tmp_path / "configs.json").write_text("{}")
    run = make_set(tmp_path / "runs", [[1.0, 2.0]]).runs[0]
    assert [collect.add_run(tmp_path, "SAC, mine", run) for _ in range(2)] == [True, False]
    (told,) = make.read_csv(tmp_path / "runs.csv")
    assert (told["arm"], told["seed"], told["config"]) == ("SAC, mine", "0", "sac-mine")
    assert [row["return"] for row in make.read_csv(tmp_path / "evaluations.csv")] == ["1", "2"]


def test_an_arm_that_no_run_has_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="'SAC' is 0 arms"):
        make.Page(tmp_path, {("CSAC", "Hopper-v4", ""): rows([1])}).arms(["SAC"])


@pytest.mark.slow
def test_the_tables_of_every_page_follow_from_the_rows_beside_it(tmp_path):
    shutil.copytree(ROOT / "results", tmp_path / "results", ignore=shutil.ignore_patterns("*.png", "__pycache__"))
    (tmp_path / "docs").mkdir()
    for page in PAGES:
        emptied, count = make.TABLE.subn(r"\1\3", page.read_text())
        assert count or page.parent.name == "reliability"
        (tmp_path / page.relative_to(ROOT)).write_text(emptied)
    make.main(tmp_path, has_pictures=False)
    for page in PAGES:
        assert (tmp_path / page.relative_to(ROOT)).read_text() == page.read_text()


def test_every_interval_that_documents_tell_stands_in_a_table():
    quoted = re.compile(r"\d\.\d{3} \(\d\.\d{3} to \d\.\d{3}\)")
    known = {
        one for page in PAGES for found in make.TABLE.finditer(page.read_text()) for one in quoted.findall(found[0])
    }
    told = {
        one
        for page in (ROOT / "README.md", *ROOT.glob("docs/algorithms/*.md"), ROOT / "docs" / "design.md", *PAGES)
        for one in quoted.findall(make.TABLE.sub("", page.read_text()).replace("95 % interval ", ""))
    }
    assert told
    assert told <= known


def test_where_all_25_pairs_of_seeds_agree_they_are_told_so_instead_of_an_interval():
    text = " ".join(RESULTS.read_text().split())
    assert text.count("SAC `strong` is higher in all 25 pairs of seeds of each task") == 2
    assert "1.000 (1.000 to 1.000)" not in text
    runs = make.read_runs(ROOT / "results")
    early, all_four = ("Ant-v4", "Walker2d-v4"), ("Ant-v4", "Walker2d-v4", "HalfCheetah-v4", "Hopper-v4")
    compared = [("SAC, candidate", 100, task) for task in early] + [("two steps", 300, task) for task in all_four]
    for ours, first, task in compared:
        arms = make.Page(RESULTS, runs).arms([ours, "SAC, automatic"], task, [*range(first, first + 5)], 100_000)
        higher, lower = (tables.measure(rows, 100_000).final for rows in arms.values())
        assert len(higher) * len(lower) == 25
        assert higher.min() > lower.max()


def test_the_front_page_quotes_the_results_and_the_benchmarks():
    page = (ROOT / "README.md").read_text()
    returns = "".join(re.findall(r"^\| (?:C?SAC `strong`|plain SAC) \|(.*)", page, re.MULTILINE))
    means = re.findall(r"([\d,]+\.\d) ±", RESULTS.read_text())
    assert len(_numbers(returns)) == 12
    assert _numbers(returns) <= {round(float(mean.replace(",", ""))) for mean in means}
    speeds = "".join(re.findall(r"^\| (?:SAC|TD3|PPO|CSAC)(?:, [^|]*)? \|(.*)", page, re.MULTILINE))
    measured = "".join((ROOT / name).read_text() for name in ("benchmarks/README.md", "docs/gpu.md"))
    assert len(_numbers(speeds)) == 11
    assert _numbers(speeds) <= _numbers(measured)


def test_make_train_promises_what_the_runs_had_at_its_length():
    (expected,) = re.findall(r"return of about ([\d,]+)", (ROOT / "README.md").read_text())
    assert "STEPS ?= 30000" in (ROOT / "Makefile").read_text()
    runs = make.Page(RESULTS, make.read_runs(ROOT / "results")).arms(["two steps"], "HalfCheetah-v4")
    returns = [row["return"] for row in runs["two steps"] if row["step"] == 30_000]
    assert np.mean(returns) == pytest.approx(int(expected.replace(",", "")), abs=100)


def _numbers(text: str) -> set[int]:
    return {int(one.replace(",", "")) for one in re.findall(r"\b\d[\d,]*", text)}


def test_every_run_has_evaluations_and_known_settings():
    for path in ROOT.glob("results/*/runs.csv"):
        runs = make.read_csv(path)
        evaluated = {row["run"] for row in make.read_csv(path.with_name("evaluations.csv"))}
        assert {run["run"] for run in runs} == evaluated
        settings = json.loads(path.with_name("configs.json").read_text())
        assert {run["config"] for run in runs} == settings.keys()


def test_the_table_of_kills_follows_from_its_rows():
    folder = ROOT / "results" / "reliability"
    with open(folder / "chaos.csv", newline="") as file:
        kills = [Kill(**{name: _value(row.get(name, "")) for name in Kill._fields}) for row in csv.DictReader(file)]
    assert f"{MARKERS[0]}\n{summary(kills)}\n{MARKERS[1]}" in (folder / "README.md").read_text()


def _value(text: str) -> Any:
    return int(text) if text.lstrip("-").isdecimal() else text or None
