"""`csac report`: runs side by side, as a report and as a table of a page."""

import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from made import make_run_of

from csac.cli import main
from csac.presets import hyperparameters
from csac.record import manifest as manifests
from csac.record.manifest import EvaluationPlan
from csac.studies.cells import complete
from csac.studies.collected import read_collected
from csac.studies.comparison import _given_cell, _times
from csac.studies.configurations import name_of

ROWS = "seed,step,episode,return,length,success"


def csac(line):
    return main(shlex.split(line))


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def write_rows(name, seeds, columns="", values=""):
    """A file of evaluations at 10, 20, ...: `seeds` [seed][point] are the returns."""
    rows = [
        f"{seed},{10 * (t + 1)},0,{value},5,{values}" for seed, line in enumerate(seeds) for t, value in enumerate(line)
    ]
    Path(f"{name}.csv").write_text("\n".join([ROWS + columns, *rows, ""]))


def table_of(options="", **runs):
    """The lines of the table that is written between the markers of a page."""
    for name, seeds in runs.items():
        write_rows(name, seeds)
    Path("page.md").write_text("before\n<!-- it: begin -->\nold\n<!-- it: end -->\nafter\n")
    labels = " ".join(f"--label {name}={name}.csv" for name in runs)
    assert csac(f"report --into page.md#it {labels} {options}") == 0
    first, begin, *lines, end, last = Path("page.md").read_text().splitlines()
    assert (first, begin, end, last) == ("before", "<!-- it: begin -->", "<!-- it: end -->", "after")
    return lines


# One table.


def test_three_seeds_have_no_interquartile_mean():
    head, _, row = table_of(few=[[40.0], [50.0], [60.0]])
    assert "IQM" not in head
    assert row == "| few | 3 | 10 | 50 ± 10 | 25 to 75 | 1.00 | 50 at 10 |"  # 10 / sqrt(3) * t(2) = 24.8


def test_five_seeds_have_one_with_its_interval():
    head, _, few, many, outlier = table_of(
        few=[[40.0], [50.0], [60.0]],
        many=[[0.0, 100.0, 100.0, 100.0]] * 5,
        outlier=[[100.0], [200.0], [300.0], [400.0], [10_000.0]],
    )
    assert head.endswith("| maximum average return | IQM, 95 % bootstrap interval | above the first, probability |")
    assert few.endswith("| 50 at 10 | 50 |  |")  # too few for an interval
    assert many.endswith("| 2.00 | 100 at 20 | 100 (100 to 100) | 1.00 |")  # of the last three evaluations
    assert "| 300 (" in outlier  # the mean of 200, 300 and 400; the mean of all is 2200


def test_a_spread_below_one_is_told():
    row = table_of(near=[[20.1], [20.4], [20.2]])[2]
    assert row.startswith("| near | 3 | 10 | 20.23 ± 0.15 | 19.85 to 20.61 |")  # 0.1528 / sqrt(3) * 4.303 = 0.38


def test_two_seeds_and_one_have_no_interval():
    _, _, two, one = table_of(two=[[40.0], [60.0]], one=[[30.0]])
    assert two == "| two | 2 | 10 | 50 ± 14 | 2 seeds: no interval | 1.00 | 50 at 10 |"
    assert one == "| one | 1 | 10 | 30 | 1 seed: no interval | 0.60 | 30 at 10 |"


def test_what_a_change_cost_several_runs():
    lines = table_of(
        "--table recovery --perturb friction=2@20",
        A=[[100, 100, 40, 95], [100, 100, 100, 100]],
        B=[[100, 100, 40, 40], [100, 100, 50, 60]],
    )
    assert lines[2:] == [
        "| A | 0 | 100.0 | 60.0 | 60% | 20 | 625 | 67.5 | 60.0 |",
        "| A | 1 | 100.0 | 0.0 | 0% | 0 | 0 | 100.0 | 0.0 |",
        "| A | mean | 100.0 | 30.0 | 30% | 10 | 312 | 83.8 | 30.0 |",
        "| A | ± std | 0.0 | 42.4 | 42% | 14 | 442 | 23.0 | 42.4 |",
        "| B | 0 | 100.0 | 60.0 | 60% | never | 900 | 40.0 | 60.0 |",
        "| B | 1 | 100.0 | 50.0 | 50% | never | 700 | 55.0 | 50.0 |",
        "| B | mean | 100.0 | 55.0 | 55% | 0 of 2 | 800 | 47.5 | 55.0 |",
        "| B | ± std | 0.0 | 7.1 | 7% |  | 141 | 10.6 | 7.1 |",
    ]


def test_what_several_changes_cost_is_told_change_by_change():
    lines = table_of("--table recovery --perturb friction=2@20 --perturb gravity=2@40", A=[[100, 100, 40, 95, 50, 60]])
    titles = [line for line in lines if line and not line.startswith("|")]
    assert titles == ["**friction x 2 after step 20**", "**gravity x 2 after step 40**"]
    run = make_run_of("run", [[100.0] * 6], algorithm="sac", perturbations=("friction=2@20", "gravity=2@40"))
    Path("page.md").write_text("<!-- it: begin -->\n<!-- it: end -->\n")
    assert csac(f"report --into page.md#it --table recovery {run.path}") == 0
    titles = re.findall(r"\*\*(.*)\*\*", Path("page.md").read_text())
    assert titles == [
        f"{run.manifest.task}, {change}" for change in ("friction x 2 after step 20", "gravity x 2 after step 40")
    ]


def test_what_comes_later_is_left_out():
    _, _, row = table_of("--until 20", a=[[10.0, 20.0, 99.0], [30.0, 40.0, 99.0]])
    assert row == "| a | 2 | 20 | 25 ± 14 | 2 seeds: no interval | 1.00 | 30 at 20 |"


def test_files_of_one_label_are_one_arm():
    write_rows("a", [[10.0]])
    Path("b.csv").write_text(f"{ROWS},extra\n7,10,0,30,5,,1\n")  # another seed, and a column that a has not got
    assert table_of("--label both=a.csv,b.csv")[2].startswith("| both | 2 | 10 | 20 ± 14 |")


def test_how_rollouts_end():
    Path("cases.csv").write_text(f"{ROWS},crash\n0,10,0,30,5,,1\n0,10,1,50,5,,0\n1,10,0,60,5,,0\n1,10,1,60,5,,0\n")
    assert table_of("--table cases --label it=cases.csv") == [
        "| per 1,000 rollouts (from 2 of each seed) | it |",
        "| --- | ---: |",
        "| return (mean) | 50.0 ± 14.1 |",
        "| crash | 250.0 ± 353.6 |",
    ]


def test_the_curves_of_one_task_are_a_picture():
    write_rows("a", [[10.0, 20.0]])
    assert csac("report --curve curve.png --title T --label a=a.csv --perturb friction=2@10") == 0
    assert Path("curve.png").stat().st_size > 10_000
    assert sorted(path.name for path in Path().iterdir()) == ["a.csv", "curve.png"]


def collected(place, returns, rollouts="", **changes):
    """Cells as `csac study run --results` collects them: `returns` [seed][point]."""
    for seed, line in enumerate(returns):
        run = make_run_of(f"made/{place}/{seed}", [line], seeds=(seed,), **changes)
        path = Path(place, f"seed-{seed}.json")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(manifests.written(replace(run.manifest, steps_done=10 * len(line))))
        path.with_suffix(".csv").write_bytes((run.path / "evaluations.csv").read_bytes())
        if rollouts:
            path.with_name(f"seed-{seed}.rollouts.csv").write_text(f"{ROWS},crash\n" + rollouts.format(seed=seed))
    shutil.rmtree("made")


def test_collected_cells_are_the_runs_that_they_were():
    collected("cells/Hopper-v4/sac", [[10.0, 20.0], [30.0, 40.0]])
    collected("cells/Ant-v4/sac", [[5.0, 5.0]], task="Ant-v4")
    # (10 + 20) / 2 = 15 and (30 + 40) / 2 = 35
    assert table_of("--label it=cells/Hopper-v4/sac")[2].startswith("| it | 2 | 20 | 25 ± 14 |")
    text = report("cells")
    assert "| cells/Hopper-v4/sac/seed-1.csv | Hopper-v4 | sac | 1 | 20 | finished |" in text
    assert "| cells/Ant-v4/sac/seed-0.csv | Ant-v4 | sac | 0 | 20 | finished |" in text
    assert "| SAC | 2 | 20 | 25 ± 14 |" in text


def test_the_rollouts_of_collected_cells_are_counted():
    collected("cells", [[10.0], [20.0]], rollouts="{seed},10,0,50,5,,1\n{seed},10,1,50,5,,0\n")
    assert table_of("--table cases --label it=cells")[-1] == "| crash | 500.0 ± 0.0 |"


def test_a_run_directory_goes_before_what_lies_beside_it(capsys):
    collected("both/cells", [[10.0]])
    make_run_of("both/run", [[99.0]])
    assert table_of("--label it=both")[2].startswith("| it | 1 | 10 | 99 |")
    Path("empty").mkdir()
    assert csac("report empty") == 2
    assert "empty holds no run" in capsys.readouterr().err


def test_damaged_cells_are_told_by_their_file(capsys):
    collected("cells", [[10.0]])
    Path("cells/seed-0.csv").write_text("seed,step\n0\n")
    assert csac("report cells") == 2
    assert "cells/seed-0.csv" in capsys.readouterr().err
    Path("cells/seed-0.json").write_text("{}")
    assert csac("report cells") == 2
    assert "cells/seed-0.json is not a cell's" in capsys.readouterr().err
    Path("cells/seed-0.csv").unlink()  # then it is a file of another kind, as a study keeps of its runs
    assert csac("report cells") == 2
    assert "cells holds no run" in capsys.readouterr().err


# A report of runs.


def report(line):
    """The Markdown of a report, whose page says the same."""
    assert csac(f"report {line} --out out/report.html") == 0
    page, text = (Path(f"out/report.{kind}").read_text() for kind in ("html", "md"))
    assert page.startswith("<!doctype html>")
    return text


def test_runs_that_differ_in_their_seeds_alone_are_one_arm():
    make_run_of("runs/a", [[10.0, 20.0]], seeds=(0,))
    make_run_of("runs/b", [[30.0, 40.0]], seeds=(1,))
    make_run_of("runs/c", [[5.0, 5.0]], hyperparameters={"discount": 0.9})
    make_run_of("runs/d", [[1.0, 2.0]], algorithm="csac")
    text = report("runs")
    assert "| SAC, discount 0.99 | 30 ± 14 | 20 | 2 |" in text
    assert "| SAC, discount 0.9 | 5.00 | 10 | 1 |" in text
    assert "| CSAC | 2.00 | 20 | 1 |" in text
    assert "| discount | 0.99 | 0.9 | 0.99 |" in text
    assert "| batch_size | 8 |" in text.partition("the same in all")[2]
    assert "csac report runs --out out/report.html\n" in text
    assert "csac train Hopper-v4 --seeds 1\n" in text
    assert "Commit: 0123456" in text


def test_what_a_trial_was_chosen_by_is_not_merged_with_fresh_seeds():
    """The winner of a tuning differs from its repetition in the episodes that it was evaluated on."""
    for name, seed, first in (("trial", 0, 2_000_000), ("fresh", 100, 1_000_000)):
        make_run_of(f"runs/{name}", [[10.0 + seed]], seeds=(seed,), evaluation=EvaluationPlan(first_seed=first))
    text = report("runs")
    assert "| SAC, evaluation seed 2,000,000 | 10.00 | 10 | 1 |" in text
    assert "| SAC, evaluation seed 1,000,000 | 110 | 10 | 1 |" in text
    assert "| evaluation seed | 1,000,000 | 2,000,000 |" in text


def test_runs_of_one_label_that_differ_are_told_with_every_value():
    make_run_of("a", [[10.0]], seeds=(0,))
    make_run_of("b", [[30.0]], seeds=(1,), hyperparameters={"discount": 0.9, "policy_delay": 2})
    make_run_of("c", [[5.0]], hyperparameters={"discount": 0.9})
    text = report("--label both=a,b --label c=c")
    assert "| both | 20 ± 14 | 10 | 2 |" in text
    assert "| discount | 0.99; 0.9 | 0.9 |" in text
    assert "| policy_delay | 1; 2 | 1 |" in text  # an older run has the default of what is newer than it


def test_a_run_from_before_a_hyperparameter_is_one_arm_with_what_has_its_default():
    make_run_of("runs/old", [[10.0]], seeds=(0,))
    make_run_of("runs/new", [[30.0]], seeds=(1,), hyperparameters={"policy_delay": 1, "adam_momentum": 0.9})
    assert "| SAC | 20 ± 14 | 10 | 2 |" in report("runs")


@pytest.mark.parametrize(
    ("algorithm", "preset", "changed", "name"),
    [
        ("sac", "strong", {}, "SAC (strong)"),
        ("sac", "strong", {"warmup_steps": 100}, "SAC (strong), warmup_steps 100"),
        ("csac", "paper", {"warmup_steps": 1_000, "replay_size": 5_000},
         "CSAC (paper), warmup_steps 1,000, replay_size 5,000"),
        ("sac", "strong", {"warmup_steps": 100, "policy_delay": 1}, "SAC"),
        ("csac", "paper", {"warmup_steps": 100, "adam_momentum": 0.5}, "CSAC"),  # of which the preset says nothing
        ("ppo", "paper", {"minibatches": 4}, "PPO"),
        ("mine", None, {"warmup_steps": 100}, "MINE"),
    ],
)  # fmt: skip
def test_what_is_fitted_to_a_run_s_length_hides_no_preset(algorithm, preset, changed, name):
    own = {**(complete(algorithm, hyperparameters(preset, algorithm, "Ant-v4")) if preset else {}), **changed}
    follows = preset if not changed else None
    run = manifests.Manifest(
        task="Ant-v4", algorithm=algorithm, seeds=(0,), steps=9, hyperparameters=own, preset=follows
    )
    assert name_of(run) == name


def test_a_method_has_one_label_on_all_tasks():
    """Two weights on Ant make the weight a part of the label on Hopper too."""
    for name, weight, task in (("a", 0.5, "Ant-v4"), ("b", 5.0, "Ant-v4"), ("c", 0.5, "Hopper-v4")):
        given = {"relative_entropy_weight": weight}
        make_run_of(f"runs/{name}", [[10.0]], algorithm="csac", task=task, hyperparameters=given)
    text = report("runs")
    assert text.count("| CSAC, relative_entropy_weight 0.5 | 10.00 |") == 2
    assert "1 of 2 methods, 2 of 2 tasks, 1 of 1 seeds." in text
    assert "Not the same on every task" not in text


def test_a_method_that_is_another_on_another_task_is_told():
    for name, discount, task, steps in (("a", 0.99, "Ant-v4", 100), ("b", 0.9, "Hopper-v4", 200)):
        make_run_of(f"runs/{name}", [[10.0]], task=task, steps=steps, hyperparameters={"discount": discount})
    text = report("runs")
    assert "Not the same on every task, see Hyperparameters: SAC." in text
    assert "| SAC | discount | 0.99 | 0.9 |" in text
    assert "| SAC | steps |" not in text


def test_a_seed_that_is_behind_the_others_is_in_no_number():
    make_run_of("runs/a", [[100.0, 900.0], [100.0, 910.0]], seeds=(0, 1))
    make_run_of("runs/b", [[200.0]], seeds=(2,), steps_done=10, state="interrupted")
    text = report("runs")
    assert "| SAC | 905 ± 7 | 20 | 2 |" in text
    told = "Left out, as others of the same have come further (--until STEP compares what all have made): SAC, seed 2."
    assert told in text
    assert "| SAC | 133 ± 58 | 10 | 3 |" in report("runs --until 10")
    assert table_of("--label it=runs")[2:] == [
        "| it | 2 | 20 | 502 ± 4 | 2 seeds: no interval | 1.00 | 905 at 20 |",
        "",
        told.replace("SAC", "it"),
    ]


def test_seeds_that_are_equally_far_on_their_way_are_compared():
    for seed in (0, 1):
        make_run_of(f"runs/{seed}", [[10.0 + seed]], seeds=(seed,), steps_done=10, state="running")
    assert "| SAC | 10.50 ± 0.71 | 10 | 2 |" in report("runs")


def test_runs_of_one_label_are_as_long_as_what_is_left_of_them():
    make_run_of("a", [[10.0, 20.0]], seeds=(0,))
    make_run_of("b", [[30.0, 40.0]], seeds=(1,), steps=200)
    assert "| both | 20 ± 14 | 10 | 2 |" in report("--label both=a,b --until 10")


def test_a_label_on_several_tasks_is_an_arm_on_each():
    """So that labels can be compared over tasks; a file of rows is of its label's task where there is one."""
    for label, height in (("A", 4.0), ("B", 2.0)):
        for task in ("Ant-v4", "Hopper-v4"):
            make_run_of(f"{label}/{task}", [[height]], task=task)
    text = report("--label A=A --label B=B")
    assert "2 of 2 methods, 2 of 2 tasks, 1 of 1 seeds." in text
    assert "| B | 0.500 | 1 seed: no interval | 2 |" in text  # shares of A's return
    write_rows("more", [[], [4.0]])
    assert "| A | 3.00 ± 1.41 | 10 | 2 |" in report("--label A=B/Ant-v4,more.csv")


def test_a_report_tells_of_perturbations_success_and_what_failed():
    returns = [[100.0, 40.0, 90.0], [100.0, 60.0, 95.0], [100.0, 0.0, 0.0]]
    make_run_of("runs/a", returns, perturbations=("friction=2@10",), failures={2: "critic is not finite"}, success=1)
    text = report("runs/a")
    assert "SAC, seed 2 failed: critic is not finite" in text
    assert "| SAC | 2 (1 failed) | 30 |" in text
    assert "**Hopper-v4, friction x 2 after step 10**" in text
    assert "| mean | 100.0 | 50.0 | 50% |" in text  # of two seeds
    assert "## Success" in text
    assert "| success | 1,000.0 ± 0.0 |" in text
    assert {path.suffix for path in Path("out").iterdir()} == {".html", ".md", ".png", ".svg"}


def test_the_table_of_returns_counts_the_seeds_that_failed():
    make_run_of("runs/a", [[100.0], [80.0]], failures={1: "critic is not finite"})
    make_run_of("runs/b", [[100.0], [80.0]])
    Path("page.md").write_text("<!-- it: begin -->\n<!-- it: end -->\n")
    assert csac("report --into page.md#it --label a=runs/a --label b=runs/b") == 0
    assert re.findall(r"^\| (a|b) \| ([^|]+) \|", Path("page.md").read_text(), re.MULTILINE) == [
        ("a", "1 (1 failed)"),
        ("b", "2"),
    ]


def test_a_manifest_says_what_perturbed_a_run_and_an_option_does_not():
    make_run_of("runs/a", [[100.0, 40.0, 90.0]])
    write_rows("b", [[100.0, 40.0, 90.0]])
    text = report("runs/a --label b=b.csv --perturb friction=2@10")
    titles = re.findall(r"\*\*(.*friction.*)\*\*", text)
    assert titles
    assert all(title.startswith("friction x 2 after step 10") for title in titles)  # b's, whose task is not known


def test_fresh_rollouts_of_a_policy_that_has_learnt_for_longer_are_left_out():
    """The run made 100 steps; in its evaluation at step 10 nothing succeeds, in its rollouts half."""
    path = make_run_of("runs/a", [[10.0, 20.0]], success=0).path
    (path / "rollouts.csv").write_text(f"{ROWS}\n0,0,0,30,5,1\n0,0,1,30,5,0\n")
    assert "| success | 500.0 |" in report("runs/a --until 100")
    text = report("runs/a --until 10")
    assert "| success | 0.0 |" in text
    assert "of a run that has none, or went on after step 10, its last evaluation's episodes." in text


def test_an_arm_has_one_colour_on_all_tasks():
    make_run_of("runs/a", [[10.0]], algorithm="csac")
    for task in ("Hopper-v4", "Ant-v4"):
        make_run_of(f"runs/{task}", [[20.0]], task=task)
    report("runs")
    page = Path("out/report.html").read_text()
    assert len(set(re.findall(r'"name":"SAC \(1 seed\)".*?"color":"(#\w+)"', page))) == 1


def test_equal_runs_with_equal_seeds_stand_side_by_side():
    for name in ("a", "b"):
        make_run_of(f"runs/{name}", [[10.0]])
    text = report("runs/a runs/b/evaluations.csv")
    assert "| SAC, runs/a | 10.00 |" in text
    assert "| SAC, runs/b | 10.00 |" in text


def test_a_run_that_is_named_again_counts_once():
    make_run_of("runs/a", [[10.0]])
    write_rows("b", [[30.0]])
    text = report("runs/a runs runs/../runs/a runs/a/evaluations.csv b.csv ./b.csv b.csv")
    assert "| SAC | 10.00 | 10 | 1 |" in text
    assert [text.count(f"\n| {name} |") for name in ("runs/a", "b.csv", "./b.csv")] == [1, 1, 0]


def test_the_time_of_a_run_that_had_enough_is_of_the_steps_that_it_made():
    run = make_run_of("run", [[1.0]], steps_done=30, created="2026-01-01T00:00:00+00:00")
    (run.path / "log.txt").write_text("2026-01-01T00:03:00+00:00 finished\n")
    (time,) = _times(run.path, run.manifest)
    assert (time.seconds, time.steps) == (180, 30)


def test_the_time_of_a_collected_cell_counts_unless_it_failed():
    collected("cells", [[10.0]])
    path = Path("cells/seed-0.json")
    for failures, counted in (({}, [60.0]), ({0: "step 5: a reward is NaN"}, [])):
        state = "failed" if failures else "finished"
        one = replace(read_collected(path).manifest, state=state, failures=failures)
        path.write_bytes(manifests.written(one)[:-2] + b', "seconds": 60.0}\n')
        assert [time.seconds for time in _given_cell(None, path).times] == counted


def test_a_damaged_run_is_named_and_left_out(capsys):
    make_run_of("runs/a", [[10.0]])
    broken = make_run_of("runs/b", [[10.0]], seeds=(1,)).path / "manifest.json"
    broken.write_text("{")
    assert "| SAC | 10.00 | 10 | 1 |" in report("runs")
    (told,) = capsys.readouterr().err.splitlines()
    assert told.startswith("damaged: runs/b/manifest.json")
    shutil.rmtree("runs/a")
    assert csac("report runs") == 2
    assert capsys.readouterr().err.startswith("damaged: runs/b/manifest.json")


def test_a_run_without_evaluations_is_told(capsys):
    make_run_of("runs/a", [])
    text = report("runs/a")
    assert "| runs/a | Hopper-v4 | sac |" in text
    assert "## Learning curves" not in text
    assert "note: there is no evaluation in these runs" in capsys.readouterr().out


def test_a_report_that_leaves_every_evaluation_out_says_so(capsys):
    make_run_of("runs/a", [[10.0, 20.0]])
    report("runs/a --until 5")
    assert "note: there is no evaluation up to step 5 in these runs" in capsys.readouterr().out


@pytest.mark.parametrize("place", [".", "out", "out.html"])
def test_a_report_in_a_directory_is_called_report(capsys, place):
    make_run_of("runs/a", [])
    Path(place).mkdir(exist_ok=True)
    assert csac(f"report runs --out {place}") == 0
    assert capsys.readouterr().out.splitlines()[:2] == [str(Path(place, f"report.{kind}")) for kind in ("html", "md")]
    assert Path(place, "report.html").read_text().startswith("<!doctype html>")


def test_returns_by_seed_and_step_are_enough():
    Path("others.csv").write_text("seed,step,return\n0,10,30\n0,20,50\n")
    text = report("others.csv")
    assert "| 0 | 20 |" in text


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("report", "there is nothing to report on: give run directories"),
        ("report nowhere", "nowhere does not exist; give a run directory"),
        ("report --label a", "--label is written NAME=DIR,DIR, not 'a'"),
        ("report --label a=a.csv,", "--label is written NAME=DIR,DIR, not 'a=a.csv,'"),
        ("report --label a=a.csv,a.csv", "a: a.csv and a.csv both hold seed 0; label them apart"),
        ("report --label a=a.csv --into page.md", "--into is written FILE.md#NAME, not 'page.md'"),
        ("report --label a=a.csv --into page.md#x", "the page lacks the lines <!-- x: begin -->"),
        ("report --label a=a.csv --into none.md#x", "cannot write into none.md: there is no such page; make it"),
        ("report --label a=a.csv --into page.md#it --table cases", "these runs have no table of cases"),
        ("report --label a=a.csv --into page.md#it --curve a.gif", "a picture is a .png, .pdf or .svg file, not a.gif"),
        ("report --label a=a.csv --into page.md#it --out a.pdf", "the report is a page: name it a.html"),
        ("report run other --into page.md#it --curve a.png", "these runs are of several tasks"),
        ("report run --table recovery", "--table chooses what --into writes: give --into FILE.md#NAME too"),
        ("report --label a=a.csv --curve a.gif", "a picture is a .png, .pdf or .svg file, not a.gif"),
        ("report --label a=a.csv --out a.pdf", "the report is a page: name it a.html"),
        ("report --label a=a.csv --out page.md/a.html", "cannot write page.md/a.html"),
        ("report --label a=a.csv --perturb frction=2", "no perturbation is called 'frction'"),
        ("report run --perturb frction=2", "no perturbation is called 'frction'"),
        ("report run --perturb friction=2@10", "--perturb is for a CSV file alone: these runs tell themselves what"),
        ("report --label a=a.csv --until 0", "--until must be a whole number of at least 1, not 0"),
        ("report run --until -5", "--until must be a whole number of at least 1, not -5"),
        ("report --label a=run,other,b.csv", "a: b.csv does not tell which of Ant-v4 and Hopper-v4 it is of; label it"),
        ("report --label a=run,pushed", "a: its runs differ in perturbations, none and friction=2@10; give"),
        ("report --label a=run,longer", "a: its runs differ in steps, 100 and 200; give each a label of its own"),
        ("report --label a=run,seldom", "a: its runs differ in evaluation interval, 5,000 and 20; give each a label"),
        ("report --label a=run,csac", "a: its runs differ in algorithm, sac and csac; give each a label of its own"),
        ("report --label a=metrics.csv", "metrics.csv has no returns: give an evaluations.csv"),
        ("report --label a=infinite.csv", "infinite.csv has returns beyond ±1e+100"),
        ("report --label a=cut.csv", "cut.csv ends within a line, which may be cut off: end it with a newline"),
        ("report strange", "evaluations.csv is damaged: it has no column episode; restore it"),
        ("report --label a=crash.csv --until 5 --into page.md#it --table cases", "have no table of cases"),
        ("report run other --curve a.png", "these runs are of several tasks"),
    ],
)
def test_mistakes_are_told_in_one_line(capsys, line, message):
    write_rows("a", [[1.0]])
    make_run_of("run", [[1.0]])
    write_rows("b", [[1.0]])
    make_run_of("other", [[1.0]], seeds=(1,), task="Ant-v4")
    make_run_of("pushed", [[1.0]], seeds=(1,), perturbations=("friction=2@10",))
    make_run_of("longer", [[1.0]], seeds=(1,), steps=200)
    make_run_of("seldom", [[1.0]], seeds=(1,), evaluation=EvaluationPlan(20))
    make_run_of("csac", [[1.0]], seeds=(1,), algorithm="csac")
    Path("metrics.csv").write_text("seed,step,q_mean\n0,10,1.5\n")
    Path("infinite.csv").write_text(f"{ROWS}\n0,10,0,inf,5,\n")
    Path("cut.csv").write_text("seed,step,return\n0,10,1.0\n0,20,50.0")
    Path("crash.csv").write_text(f"{ROWS},crash\n0,10,0,1,5,,1\n")
    Path("strange").mkdir()
    make_run_of("strange/run", [[1.0]])
    Path("strange/run/evaluations.csv").write_text("seed,step\n0,5\n")
    Path("page.md").write_text("<!-- it: begin -->\n<!-- it: end -->\n")
    before = sorted(path.name for path in Path().iterdir())
    assert csac(line) == 2
    (complaint,) = capsys.readouterr().err.splitlines()
    assert message in complaint
    assert sorted(path.name for path in Path().iterdir()) == before
    assert Path("page.md").read_text() == "<!-- it: begin -->\n<!-- it: end -->\n"
