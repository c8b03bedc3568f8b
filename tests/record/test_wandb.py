import json
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from logs import log_lines
from resuming import LEARNERS, SHORT, Crash, crash_at

from csac.cli import main
from csac.record import wandb as ours
from csac.record.manifest import Manifest
from csac.record.run import RunDirectory
from csac.record.statistics import evaluation_matrix
from csac.record.wandb import WandbLog, group_of, run_id
from csac.training.train import resume, train
from csac.types import InputError

wandb_files = pytest.importorskip("wandb_files")
SAC = LEARNERS[1]


@pytest.fixture(autouse=True)
def _offline(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.delenv("WANDB_PROJECT", raising=False)


def run_directory(path, **changes):
    manifest = Manifest(task="Hopper-v4", algorithm="sac", seeds=(0, 7), steps=900, created="then", **changes)
    return RunDirectory.create(path, manifest)


class FakeRun:
    """Stands in for a run of W&B."""

    def __init__(self, options):
        self.options, self.rows, self.is_finished = options, [], False

    def log(self, values, step, commit):
        self.rows.append((step, values))

    def finish(self):
        self.is_finished = True


@pytest.fixture
def fake(monkeypatch):
    """Stands in for the module, and keeps the runs that are begun."""
    runs = []

    def init(**options):
        runs.append(FakeRun(options))
        return runs[-1]

    module = SimpleNamespace(
        init=init,
        runs=runs,
        mode="online",
        Settings=lambda **options: SimpleNamespace(**options),
        login=lambda **_: True,
        setup=lambda **_: SimpleNamespace(settings=SimpleNamespace(mode=module.mode)),
    )
    monkeypatch.setattr(ours, "import_wandb", lambda: module)
    return module


# What it holds.


def test_the_numbers_are_those_of_the_tables_also_of_a_run_that_went_on(tmp_path):
    options = {**SHORT, "seeds": 2, "first_seed": 3, "checkpoint_interval": 120}
    with pytest.raises(Crash):
        train(SAC, "Hopper-v4", steps=500, directory="run", wandb="mine", on_evaluation=crash_at(400), **options)
    for part in Path("run/wandb").glob("offline-run-*"):  # W&B calls it by its second, which the other part may share
        part.rename(part.with_name(f"{part.name}-first"))
    run = resume("run")

    parts = wandb_files.offline_runs(run.wandb)
    assert [part.id for part in parts] == [run_id(run, 3), run_id(run, 4)] * 2
    assert {part.project for part in parts} == {"mine"}
    assert {part.group for part in parts} == {group_of(run)}
    for seed in (3, 4):
        first, second = (part for part in parts if part.id == run_id(run, seed))
        history = [*first.history, *second.history]
        steps = [row["_step"] for row in history]
        assert steps == sorted(set(steps))  # nothing twice, and nothing backward
        # It went on from step 360, and had been evaluated at 400 already.
        assert first.history[-1]["_step"] >= 400
        assert [step for step, _ in second.curve("eval/mean_reward")] == [500]

        points, seeds, returns = evaluation_matrix(run.evaluations)
        (line,) = returns[seeds == seed]
        curve = [*first.curve("eval/mean_reward"), *second.curve("eval/mean_reward")]
        assert curve == [(int(step), pytest.approx(value, rel=1e-6)) for step, value in zip(points, line, strict=True)]
        metrics = run.rows("metrics")
        metrics = metrics[metrics["seed"] == seed]
        assert second.curve("train/critic_loss") == [(500, pytest.approx(metrics["critic_loss"][-1], rel=1e-6))]
        assert first.config["batch_size"] == SAC.batch_size
        assert first.config["actor_hidden_sizes"] == list(SAC.actor_hidden_sizes)
        assert (first.config["seed"], first.config["task"]) == (seed, "Hopper-v4")
    (line,) = [line for line in log_lines(run.path) if line.startswith("W&B") and "run/wandb" in line][:1]
    assert line == f"W&B: project mine, group {group_of(run)}, files in run/wandb"
    episodes = run.rows("episodes")
    assert len(episodes)


def test_rows_of_all_tables_are_handed_over_in_the_order_of_their_steps(fake, tmp_path):
    log = WandbLog(run_directory(tmp_path / "run"), [0, 7], clock=iter(range(9)).__next__)
    evaluation = {"seed": 0, "step": 50, "episode": 0, "return": 3.0, "length": 4, "success": None}
    log.write(
        {
            "episodes": [{"seed": 0, "step": step, "return": 1.0, "length": 2} for step in (90, 100)],
            "metrics": [{"seed": 0, "step": 100, "critic_loss": 0.5}, {"seed": 7, "step": 100, "critic_loss": 0.25}],
            "evaluations": [evaluation],
        }
    )
    log.close()
    first, second = fake.runs
    assert [step for step, _ in first.rows] == [50, 100]
    assert first.rows[0][1] == {"eval/mean_reward": 3.0, "eval/mean_ep_length": 4.0}
    assert first.rows[1][1].keys() == {"rollout/ep_rew_mean", "rollout/ep_len_mean", "train/critic_loss", "time/fps"}
    assert second.rows == [(100, {"train/critic_loss": 0.25, "time/fps": 100.0})]
    assert first.is_finished
    assert second.is_finished


def test_what_was_handed_over_is_not_handed_over_again(fake, tmp_path):
    run = run_directory(tmp_path / "run")

    def metrics(*steps):
        return {"metrics": [{"seed": 0, "step": step, "critic_loss": 0.5} for step in steps]}

    log = WandbLog(run, [0], project="mine")
    log.write(metrics(1_000, 2_000))
    log.close()
    log = WandbLog(run, [0], begin=1_000)
    log.write(metrics(2_000, 3_000))
    log.close()
    first, second = fake.runs
    assert [step for step, _ in second.rows] == [3_000]
    assert first.options["id"] == second.options["id"]
    assert first.options["project"] == second.options["project"] == "mine"
    assert second.options["resume"] == "allow"


def test_each_seed_and_each_run_has_an_id_of_its_own(tmp_path):
    one = run_directory(tmp_path / "one" / "run")
    other = run_directory(tmp_path / "other" / "run", hyperparameters={"discount": 0.9})
    assert len({run_id(one, 0), run_id(one, 7), run_id(other, 0)}) == 3
    id_before = run_id(one, 0)
    one.update_manifest(steps=1_800, steps_done=900, state="finished")
    assert run_id(RunDirectory.open(one.path), 0) == id_before


def test_runs_that_begin_in_the_same_second_have_ids_of_their_own(tmp_path):
    plain = run_directory(tmp_path / "sac" / "seed-0")
    elsewhere = run_directory(tmp_path / "sac-friction=2" / "seed-0")
    changes = {"perturbations": ("friction=2@100",)}, {"environment_arguments": {"frame_skip": 2}}
    others = [run_directory(tmp_path / str(index) / "sac" / "seed-0", **each) for index, each in enumerate(changes)]
    assert len({run_id(run, 0) for run in (plain, elsewhere, *others)}) == 4


def test_an_id_does_not_depend_on_how_the_path_is_typed(tmp_path, monkeypatch):
    run = run_directory(tmp_path / "sac" / "run")
    monkeypatch.chdir(run.path)
    assert run_id(RunDirectory.open("."), 0) == run_id(run, 0)


def test_seeds_of_a_study_are_one_group(tmp_path):
    assert group_of(run_directory(tmp_path / "Hopper-v4" / "sac" / "today")) == "Hopper-v4/sac/today"
    cells = [run_directory(tmp_path / "Hopper-v4" / "sac-1a2b" / f"seed-{seed}") for seed in (0, 1)]
    assert {group_of(cell) for cell in cells} == {"Hopper-v4/sac-1a2b"}


# Where W&B does not do as it should.


def test_training_does_not_fail_with_wandb(fake, tmp_path):
    def init(**_):
        raise OSError("no space left")

    fake.init = init
    run = train(SAC, "Hopper-v4", steps=200, directory="run", wandb=True, **SHORT)
    assert run.manifest.state == "finished"
    told = [line for line in log_lines(run.path) if line.startswith("W&B")]
    assert told[-1] == "W&B gets no more of this run: OSError: no space left; its own files hold everything"


@pytest.mark.parametrize("failing", ["there is no key; wandb login asks for one", "ConnectionError: nobody answers"])
def test_what_cannot_be_sent_goes_to_files(fake, tmp_path, failing):
    def login(**_):
        if failing.startswith("there"):
            return False
        raise ConnectionError("nobody answers")

    fake.login = login
    run = run_directory(tmp_path / "run")
    log = WandbLog(run, [0, 7])
    told = [*log.write({"metrics": [{"seed": 7, "step": 1_000, "critic_loss": 0.5}]}), *log.close()]
    assert [len(one.rows) for one in fake.runs] == [0, 1]
    assert {one.options["mode"] for one in fake.runs} == {"offline"}
    (line,) = [line for line in told if "later" in line]
    assert line == f"W&B is sent nothing: {failing}. To send it later: wandb sync {run.wandb}/offline-*"


def test_nobody_waits_for_wandb(fake, tmp_path, monkeypatch):
    begin, gate = fake.init, threading.Event()

    def init(**options):
        gate.wait()
        return begin(**options)

    fake.init = init
    monkeypatch.setattr(ours, "SECONDS_TO_FINISH", 0.01)
    log = WandbLog(run_directory(tmp_path / "run"), [0])
    log.write({"metrics": [{"seed": 0, "step": 1_000, "critic_loss": 0.5}]})
    (line,) = log.close()
    assert line.startswith("W&B did not take everything")
    gate.set()


def test_without_wandb_one_line_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "wandb", None)
    for line in ("train Hopper-v4 --wandb --directory run", "study run smoke --wandb"):
        assert main(line.split()) == 2
        assert capsys.readouterr().err == "csac: W&B is not installed: pip install '.[wandb]' in a clone of csac\n"
    # W&B's own folder can be imported, and is not it.
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace())
    with pytest.raises(InputError, match="not installed"):
        train(SAC, "Hopper-v4", steps=200, directory="run", wandb=True)
    assert list(tmp_path.iterdir()) == []


def test_a_run_goes_on_where_wandb_is_no_more(fake, tmp_path, monkeypatch):
    with pytest.raises(Crash):
        train(SAC, "Hopper-v4", steps=300, directory="run", wandb=True, on_evaluation=crash_at(200), **SHORT)
    assert json.loads((tmp_path / "run" / "wandb" / "logged.json").read_text())["project"] == "csac"
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert resume(tmp_path / "run").manifest.state == "finished"


def test_a_study_logs_each_cell(monkeypatch, tmp_path):
    from csac.studies import commands

    given = []
    monkeypatch.setattr(commands, "run_in_processes", lambda jobs, tell, **_: given.extend(jobs))
    monkeypatch.setattr(commands, "run_here", lambda jobs, tell, **_: given.extend(jobs))
    assert main(["study", "run", "panda", "--seeds", "1", "--algorithms", "sac", "--wandb"]) == 0
    assert [job.wandb for job in given] == [True]
    assert np.all([job.cell.algorithm == "sac" for job in given])
