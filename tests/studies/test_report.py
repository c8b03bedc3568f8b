"""Reports: what they show of runs whose numbers are known, and that they are one file."""

import re
from dataclasses import replace

import numpy as np
import pytest
from studying import tiny_study, write_run
from test_arms import config

from csac.cli import main
from csac.record.manifest import Origin
from csac.record.rendering import Table
from csac.studies import paper
from csac.studies.arms import Arm, gather, read_arms
from csac.studies.report import (
    Commands,
    Heading,
    Picture,
    efficiency,
    over_tasks,
    overview,
    provenance,
    report_of,
    robustness,
    success,
    write,
)
from csac.studies.study import find

HEIGHTS = {"csac": 3_000.0, "sac": 2_000.0, "ppo": 1_000.0, "td3": 2_500.0, "sd3": 2_200.0}


def arms_of(name, folder, heights=HEIGHTS, scale=1.0, tasks=(), **columns):
    """The arms of a study, by default on all of its tasks, each seed of a method near its height."""
    study = replace(find(name), scale=scale).narrowed(tasks)
    for run in study.runs():
        write_run(folder / run.folder, run.config, heights[run.config.algorithm], **columns)
    return gather(study, folder)


@pytest.fixture(scope="module")
def mujoco(tmp_path_factory):
    """The arms of the whole study `mujoco`."""
    return arms_of("mujoco", tmp_path_factory.mktemp("mujoco"))


def tables(parts):
    return [part for part in parts if isinstance(part, Table)]


def cells(table):
    return [[cell.text for cell in row.cells] for row in table.rows]


def test_a_report_is_one_file_with_everything_in_it(tmp_path, capsys):
    for seed in range(2):
        write_run(tmp_path / "runs" / "a" / f"seed-{seed}", config(seed=seed, perturbations=("friction=2@500",)))
        write_run(tmp_path / "runs" / "b" / f"seed-{seed}", config("td3", seed=seed, perturbations=("friction=2@500",)))
    out = tmp_path / "report.html"
    assert main(["report", str(tmp_path / "runs"), "--out", str(out), "--title", "<Ours>"]) == 0
    page = out.read_text()
    headings = re.findall("<h2>(.*)</h2>", page)
    told = ["Runs", "Learning curves", "Returns", "Perturbations", "Hyperparameters"]
    assert headings == [*told, "Where the numbers come from", "Commands"]
    assert "&lt;Ours&gt;" in page
    assert page.count("data:image/svg+xml;base64,") == 1
    assert not re.search(r"<script|(src|href)=.http", page)
    assert "csac report" in page
    assert "csac train Ant-v4 --algorithm td3 --steps 1000 --seeds 2 --perturb friction=2@500" in page
    assert str(out) in capsys.readouterr().out


def test_a_report_in_markdown_has_its_pictures_beside_it(tmp_path):
    write_run(tmp_path / "seed-0", config())
    assert main(["report", str(tmp_path), "--out", str(tmp_path / "page.md")]) == 0
    page = (tmp_path / "page.md").read_text()
    (picture,) = re.findall(r"!\[Ant-v4\]\((.*)\)", page)
    assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")
    assert "| SAC | Ant-v4 | 0 | 1,000 | 1 finished |" in page


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ([], "run directories"),
        (["{}", "--out", "page.pdf"], "page.html"),
        (["{}", "--label", "ours"], "NAME=DIR"),
        (["{}", "--until", "0"], "--until"),
        (["{}", "--until", "1"], "--until"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, capsys, words, named):
    write_run(tmp_path / "seed-0", config())
    assert main(["report", *(word.format(tmp_path) for word in words)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert named in line


def test_what_failed_and_what_is_incomplete_is_said(tmp_path):
    write_run(tmp_path / "seed-0", config())
    write_run(tmp_path / "seed-1", config(seed=1), state="failed")
    write_run(tmp_path / "seed-2", config(seed=2), state="interrupted", points=4)
    arms = read_arms([tmp_path])
    parts = list(overview(arms))
    assert cells(tables(parts)[0]) == [["SAC", "Ant-v4", "0, 1, 2", "1,000", "1 finished, 1 failed, 1 interrupted"]]
    told = " ".join(part for part in parts if isinstance(part, str))
    assert "Failed: SAC on Ant-v4, seed 1: step 5: reward is not finite" in told
    assert "SAC on Ant-v4, seed 2 at step 400" in told
    assert "Not finished" not in told
    write_run(tmp_path / "early", config(discount=0.9), state="interrupted", points=4)
    assert "step 400 of 1,000" in str(list(overview(read_arms([tmp_path / "early"]))))


def test_runs_without_evaluations_have_a_report_too(tmp_path):
    write_run(tmp_path / "seed-0", config(), points=0, state="interrupted")
    parts = report_of(read_arms([tmp_path]), ["csac report"], ["curves", "returns"])
    write(tmp_path / "report.html", "Nothing yet", parts)
    assert not [part for part in parts if isinstance(part, Picture)]


def test_a_fork_is_repeated_by_the_command_that_made_it(tmp_path):
    origin = Origin("a/seed-0", 500, ())
    write_run(tmp_path / "seed-0", config()).update_manifest(forked_from=origin, command="csac train Ant-v4 --from a")
    commands = [part.lines for part in provenance(read_arms([tmp_path]), ["csac report"]) if isinstance(part, Commands)]
    assert commands == [("csac report",), ("csac train Ant-v4 --from a",)]


def test_seeds_with_a_gap_are_trained_by_several_commands(tmp_path):
    for seed in (0, 1, 100):
        write_run(tmp_path / f"seed-{seed}", config(seed=seed))
    (*_, commands) = [part for part in provenance(read_arms([tmp_path]), []) if isinstance(part, Commands)]
    assert "--seeds 2" in commands.lines[0]
    assert "--seeds 1 --first-seed 100" in commands.lines[1]


def test_methods_are_compared_over_all_tasks_with_common_seeds(mujoco, tmp_path):
    arms = [arm for arm in mujoco if arm.label in ("CSAC (paper)", "SAC")]
    parts = list(over_tasks(arms))
    (table,) = tables(parts)
    csac, sac = cells(table)
    assert (csac[0], csac[1][:4], csac[2], csac[3]) == ("CSAC (paper)", "1.50", "1.00 (1.00 to 1.00)", "20")
    assert (sac[1][:4], sac[2]) == ("1.00", "")
    assert not list(over_tasks([arm for arm in arms if arm.task == "Ant-v4"]))
    costs = dict.fromkeys(HEIGHTS, -100.0)
    negative = arms_of("mujoco", tmp_path, costs, tasks=["Ant-v4", "Hopper-v4"])
    assert not list(over_tasks(negative))


def test_the_papers_claims_have_verdicts(mujoco, tmp_path):
    claims = {(c.arm.label, c.text, c.other.label, c.arm.task): c for c in paper.claims(mujoco)}
    higher = "a higher maximum average return"
    verdict, why = claims["CSAC (paper)", higher, "SAC", "Ant-v4"].verdict()
    assert (verdict, why) == ("reproduced", "better in 100% of the pairs of seeds, 95 % interval 100% to 100%")
    assert ("CSAC (paper)", higher, "SD3", "Hopper-v4") not in claims  # where the paper has SD3 higher
    assert claims["CSAC (periodic)", "fewer steps to the lower boundary", "SAC", "Ant-v4"].verdict()[0] == "reproduced"
    worse = arms_of("mujoco", tmp_path, {**HEIGHTS, "csac": 500.0}, tasks=["Ant-v4"])
    assert next(c for c in paper.claims(worse) if c.text == higher).verdict()[0] == "not reproduced"


def test_shortened_runs_and_few_seeds_decide_nothing(tmp_path):
    (claim, *_) = paper.claims(arms_of("mujoco", tmp_path, scale=0.1, tasks=["Ant-v4"]))
    assert claim.verdict()[0] == "not yet decidable"
    assert "shorter" in claim.verdict()[1]
    whole = arms_of("mujoco", tmp_path / "whole", tasks=["Ant-v4"])
    unfinished = [replace(arm, until=100_000) if arm.label == "SAC" else arm for arm in whole]
    assert {one.verdict()[0] for one in paper.claims(unfinished) if one.other.label == "SAC"} == {"not yet decidable"}
    four = claim._replace(ours=claim.ours[:4])
    assert "fewer than five seeds" in four.verdict()[1]


def test_claims_of_weights_of_friction_and_of_robots(tmp_path):
    weights = paper.claims(arms_of("ablation", tmp_path / "ablation"))
    assert len(weights) == 8  # 0.5 against each other weight, in both forms
    friction = paper.claims(arms_of("robustness", tmp_path / "robustness"))
    assert {claim.text for claim in friction} == {"loses less of its return", "regains it sooner", "ends higher"}
    assert len(friction) == 2 * 3 * 3
    flights = paper.claims(arms_of("quadx", tmp_path / "quadx", collision=1.0, out_of_bounds=0.0, env_complete=0.0))
    assert "fewer episodes with collision" in {claim.text for claim in flights}
    reaches = paper.claims(arms_of("panda", tmp_path / "panda", success=1.0))
    assert "success in 95% of the episodes sooner" in {claim.text for claim in reaches}


def test_steps_to_the_lower_boundary(mujoco):
    """SAC reaches PPO's best, about 1,000 of its 2,000, at half of its steps."""
    arms = [arm for arm in mujoco if arm.task == "Ant-v4" and arm.label in ("SAC", "PPO")]
    (table,) = tables(efficiency(arms))
    sac, ppo = cells(table)
    assert sac[1:] in (["500,000", "5 of 5", "300,000"], ["600,000", "5 of 5", "300,000"])
    assert ppo[3] == "980,000"


def test_without_ppo_the_boundary_is_the_papers(tmp_path):
    """On HalfCheetah it is 4,181.89; shorter runs decide who is first there."""
    arms = arms_of("paper", tmp_path, {"csac": 6_000, "sac": 4_000}, tasks=["HalfCheetah-v4"])
    (table,) = tables(efficiency(arms))
    assert table.title == "HalfCheetah-v4, return 4,181.9"
    assert [row[2] for row in cells(table)] == ["5 of 5", "0 of 5"]
    verdicts = {claim.text: claim.verdict()[0] for claim in paper.claims(arms)}
    assert verdicts["fewer steps to the lower boundary"] == "reproduced"
    assert verdicts["a higher maximum average return"] == "not yet decidable"


def test_each_change_has_a_table_as_far_as_the_next(tmp_path):
    write_run(tmp_path / "seed-0", config(perturbations=("friction=2@300", "gravity=1.1@600")))
    titles = [table.title for table in tables(robustness(read_arms([tmp_path])))]
    assert titles == ["Ant-v4, friction x 2 after step 300", "Ant-v4, gravity x 1.1 after step 600"]


def test_success_has_curves_where_the_task_tells_of_it(tmp_path):
    write_run(tmp_path / "seed-0", config(), success=1.0)
    heading, picture = success(read_arms([tmp_path]))
    assert isinstance(picture, Picture)
    assert (heading, picture.title) == (Heading("Success"), "Ant-v4, success")
    assert np.all(picture.figure.axes[0].lines[0].get_ydata() == 1.0)


def test_the_report_of_a_study_is_of_what_is_there(tmp_path, capsys):
    study = tiny_study(tmp_path)
    path, runs = str(tmp_path / "study" / "tiny.toml"), tmp_path / "runs"
    assert main(["study", "report", path, "--directory", str(runs)]) == 2
    assert "there is no run of tiny" in capsys.readouterr().err
    for run in study.runs()[:3]:
        write_run(runs / run.folder, run.config)
    assert main(["study", "report", path, "--directory", str(runs)]) == 0
    page = (runs / "report.html").read_text()
    assert "1 finished, 1 missing" in page
    assert f"csac study run {path} --directory {runs}" in page


def test_an_arm_without_runs_is_no_obstacle():
    parts = report_of([Arm("sac", "Ant-v4", (), missing=[0])], ["csac study report x"], ["curves"])
    assert "0 at step 0" in " ".join(part for part in parts if isinstance(part, str))
