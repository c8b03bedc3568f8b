"""Studies as data: what a TOML file may hold, and the runs that come of it."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from csac.algorithms import ALGORITHMS
from csac.studies.study import find, named, read_study
from csac.types import InputError

RESULTS = Path(__file__).parents[2] / "results"
METHOD = '[[methods]]\nalgorithm = "sac"\n'


def study_of(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return read_study(path)


def test_a_study_is_the_product_of_its_parts_seed_by_seed(tmp_path):
    study = study_of(
        tmp_path,
        """
        tasks = ["Hopper-v4", "Ant-v4"]
        first_seed = 7
        seeds = 2
        steps = 1_000
        steps_on = { "Ant-v4" = 500 }
        conditions = [[], ["friction=2@100", "mass=1.5"]]
        [[methods]]
        label = "SAC, mine"
        algorithm = "sac"
        [[methods]]
        algorithm = "td3"
        """,
    )
    runs = study.runs()
    assert [run.config.seed for run in runs] == [7] * 8 + [8] * 8
    assert [run.method.label for run in runs[:2]] == ["SAC, mine", "td3"]
    assert {(run.config.task, run.config.steps) for run in runs} == {("Hopper-v4", 1_000), ("Ant-v4", 500)}
    assert str(runs[0].folder) == "SAC-mine/Hopper-v4/seed-7"
    assert str(runs[-1].folder) == "td3/Ant-v4/mass=1.5+friction=2@100/seed-8"
    assert runs[-1].name == "td3 on Ant-v4, mass=1.5, friction=2@100, seed 8"
    assert (study.name, study.title) == ("mine", "mine")


def test_what_is_common_counts_where_nothing_else_is_said(tmp_path):
    text = 'tasks = ["Ant-v4"]\nseeds = 1\n[common.sac]\nbatch_size = 64\nwarmup_steps = 5\n'
    study = study_of(tmp_path, text + METHOD + METHOD + 'label = "preset"\npreset = "paper"\n')
    plain, preset = (run.config.hyperparameters for run in study.runs())
    assert (plain["batch_size"], plain["warmup_steps"]) == (64, 5)
    assert (preset["batch_size"], preset["warmup_steps"]) == (256, 10_000)


def test_a_sweep_is_a_method_for_each_combination(tmp_path):
    text = METHOD + "sweep = { discount = [0.9, 0.95], batch_size = [32, 64] }"
    study = study_of(tmp_path, 'tasks = ["Ant-v4"]\n' + text)
    assert [method.label for method in study.methods][:2] == [
        "sac, discount 0.9, batch_size 32",
        "sac, discount 0.9, batch_size 64",
    ]
    assert [run.config.hyperparameters["discount"] for run in study.runs()[:4]] == [0.9, 0.9, 0.95, 0.95]


def test_a_task_has_its_own_events_and_robots_their_preset():
    (run,) = {run.method.label: run for run in find("quadx").runs()}["CSAC (paper)"], *()
    assert "collision" in run.config.events
    assert run.config.hyperparameters["relative_entropy_weight"] == 0.1


def test_scale_shortens_steps_changes_and_warm_up():
    whole, tenth = (replace(find("robustness"), scale=scale).runs()[0] for scale in (1.0, 0.001))
    assert (whole.config.steps, whole.config.perturbations) == (1_000_000, ("friction=1.5@300000",))
    assert (tenth.config.steps, tenth.config.perturbations) == (1_000, ("friction=1.5@300",))
    assert (tenth.config.hyperparameters["warmup_steps"], tenth.config.evaluation_interval) == (100, 50)
    assert whole.config.evaluation_interval == 5_000


def test_a_part_of_a_study():
    study = find("mujoco").narrowed(["Ant-v4"], ["PPO", "csac"], 2)
    assert [method.label for method in study.methods] == ["CSAC (paper)", "CSAC (periodic)", "PPO"]
    assert len(study.runs()) == 6
    wrongs: list[dict[str, Any]] = [{"tasks": ["Ant-v3"]}, {"methods": ["TD4"]}]
    for wrong in wrongs:
        with pytest.raises(InputError, match=r"did you mean (Ant-v4|td3)\?"):
            find("mujoco").narrowed(**wrong)


@pytest.mark.parametrize("name", named())
def test_the_studies_that_csac_brings(name):
    study = find(name)
    assert study.runs()
    assert all(method.algorithm in ALGORITHMS for method in study.methods)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("tasks = [", "TOML"),
        ('tasks = ["Ant-v4"]', "methods"),
        ('tasks = ["Ant-v4"]\nmethods = 5', "'methods' is 5, not a list"),
        (METHOD, "tasks"),
        ("tasks = []\n" + METHOD, "tasks"),
        ('tasks = ["Ant-v4"]\nsteps = "many"\n' + METHOD, "steps"),
        ('tasks = ["Ant-v4"]\nseeds = 0\n' + METHOD, "seeds"),
        ('tasks = ["Ant-v4"]\nsteps = 0\n' + METHOD, "steps"),
        ('tasks = ["Ant-v4"]\nfirst_sed = 3\n' + METHOD, "first_seed"),
        ('tasks = ["Ant-v4"]\nscale = 0.5\n' + METHOD, "scale"),
        ('tasks = ["Ant-v4"]\nevaluation_episodes = 0\n' + METHOD, "evaluation_episodes"),
        ('tasks = ["Ant-v4"]\nsteps_on = { "Ant-v5" = 3 }\n' + METHOD, "Ant-v5"),
        ('tasks = ["Ant-v4"]\nevents = ["a b"]\n' + METHOD, "a b"),
        ('tasks = ["Ant-v4"]\nanalyses = ["pictures"]\n' + METHOD, "pictures"),
        ('tasks = ["Ant-v4"]\nconditions = [["frictoin=2@3"]]\n' + METHOD, "frictoin"),
        ('tasks = ["Ant-v4"]\nsteps = 10\nconditions = [["friction=2@30"]]\n' + METHOD, "friction=2@30"),
        ('tasks = ["Ant-v4"]\n[[methods]]\nalgorithm = "scas"', "scas"),
        ('tasks = ["Ant-v4"]\n[[methods]]\nlabel = "x"', "algorithm"),
        ('tasks = ["Ant-v4"]\n' + METHOD + 'preset = "best"', "best"),
        ('tasks = ["Ant-v4"]\n' + METHOD + 'published = "DQN"', "DQN"),
        ('tasks = ["Ant-v4"]\n' + METHOD + "hyperparameters = { gamma = 0.9 }", "gamma"),
        ('tasks = ["Ant-v4"]\n' + METHOD + "hyperparameters = { discount = 2.0 }", "discount"),
        ('tasks = ["Ant-v4"]\n' + METHOD + "sweep = { discount = 0.9 }", "sweep.discount"),
        ('tasks = ["Ant-v4"]\n' + METHOD + METHOD, "sac/Ant-v4"),
        ('tasks = ["Ant-v4"]\n' + METHOD + METHOD + 'label = "SAC"', "sac/Ant-v4"),
        ('tasks = ["Ant-v4"]\nenvironments = 10\n[[methods]]\nalgorithm = "ppo"', "environments must divide"),
        ('tasks = ["Ant-v4", "Ant-v4"]\n' + METHOD, "sac/Ant-v4"),
    ],
)
def test_a_mistake_is_one_line_that_names_it(tmp_path, text, named):
    with pytest.raises(InputError) as told:
        study_of(tmp_path, text)
    assert named in str(told.value)
    assert "mine.toml" in str(told.value)
    assert "\n" not in str(told.value)


def test_a_strangers_study_moves_no_terminal(tmp_path):
    study = study_of(tmp_path, 'title = "\\u001b[2J\\U0000009bx"\ntasks = ["Ant-v4"]\n' + METHOD)
    assert study.title == "\ufffd[2J\ufffdx"


def test_there_is_no_such_study():
    with pytest.raises(InputError, match="did you mean mujoco"):
        find("mujocco")
    with pytest.raises(InputError, match=r"cannot read .*nowhere\.toml"):
        find("nowhere.toml")


def test_a_study_imports_no_module_of_a_task(tmp_path):
    (tmp_path / "mine.toml").write_text('tasks = ["mine:Task-v0", "PyFlyt/QuadX-Waypoints-v1"]\n' + METHOD)
    (tmp_path / "mine.py").write_text("raise SystemExit(9)")
    code = (
        "import sys; from csac.cli import main; code = main(['study', 'show', 'mine.toml']); "
        "sys.exit(code or any(name in sys.modules for name in ('mine', 'PyFlyt')))"
    )
    answer = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    assert "10 waiting" in answer.stdout
