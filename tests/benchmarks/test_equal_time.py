"""Peers at equal time: the clock, the arguments, the authors' settings in the real libraries, and the list of runs."""

from __future__ import annotations

import csv
import dataclasses
import json
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equal_time
import models
import pytest
from equal_time import Clock, Deadline
from evaluation import evaluate

from benchmarks import equal_time as runner
from benchmarks.contenders import PEERS_PYTHON
from benchmarks.measuring import ROOT
from benchmarks.tables import write_rows
from csac.cli import main as csac
from csac.studies.study import read_study
from csac.types import InputError

STUDY = read_study(runner.STUDY)
needs_peers = pytest.mark.skipif(not Path(PEERS_PYTHON).exists(), reason="the peers are not installed: make peers")


class FakeTime:
    """A clock on the wall that stands at `at`."""

    def __init__(self, at: float) -> None:
        self.at = at

    def __call__(self) -> float:
        return self.at


def at_the_deadline(now: FakeTime, launched: float, step: float, evaluation: float) -> list[float]:
    """What the clock shows at each evaluation of a limit of 10 s, where a step and an evaluation take so long."""
    seen: list[float] = []

    def look(seconds: float) -> None:
        seen.append(seconds)
        now.at += evaluation

    deadline = Deadline(Clock(launched, now), 10.0, look)
    while not deadline.is_over():
        now.at += step
    return seen


def test_evaluations_come_at_nine_tenths_and_at_the_end_and_stop_the_clock():
    now = FakeTime(100.0)
    assert at_the_deadline(now, launched=100.0, step=1.0, evaluation=50.0) == [9.0, 10.0]
    assert now.at == 100.0 + 10.0 + 2 * 50.0


def test_what_passed_since_the_launch_counts():
    now = FakeTime(100.0)
    assert at_the_deadline(now, launched=93.0, step=1.0, evaluation=0.0) == [9.0, 10.0]
    assert now.at == 103.0


def test_a_step_beyond_the_end_is_followed_by_both_evaluations():
    now = FakeTime(100.0)
    assert at_the_deadline(now, launched=100.0, step=64.0, evaluation=7.0) == [64.0, 64.0]
    assert now.at == 100.0 + 64.0 + 2 * 7.0


class Task:
    """Episodes of two steps whose observation is the seed; the reward is the action."""

    def reset(self, seed: int) -> tuple[float, dict]:
        self.seed, self.step_count = float(seed), 0
        return self.seed, {}

    def step(self, action: float) -> tuple[float, float, bool, bool, dict]:
        self.step_count += 1
        return self.seed, action, self.step_count == 2, False, {}


class Policy:
    """Acts as it observes, on a scale where 1,000,000 is 0, and only deterministically."""

    def predict(self, observation: float, deterministic: bool) -> tuple[float, None]:
        assert deterministic
        return observation, None

    def get_vec_normalize_env(self) -> Any:
        return SimpleNamespace(normalize_obs=lambda observation: observation - 1_000_000)


def test_the_episodes_have_csac_s_starts_and_the_scale_of_training():
    assert evaluate(Policy(), Task(), 3) == [(0.0, 2), (2.0, 2), (4.0, 2)]


@pytest.fixture
def arguments(tmp_path, monkeypatch) -> list[str]:
    monkeypatch.setattr("equal_time.find_spec", lambda library: library)
    given = ["--peer", "sbx-tqc", "--task", "Walker2d-v4", "--seed", "3", "--seconds", "5", "--out"]
    return [*given, str(tmp_path / "run.csv")]


def test_the_clock_of_a_run_by_hand_starts_with_the_script(arguments):
    assert equal_time.read_arguments(arguments).launched == equal_time.IMPORTED


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        (["--peer", "sbx-rainbow"], "argument --peer: invalid choice: 'sbx-rainbow'"),
        (["--seconds", "0"], "--seconds must be a number above 0, not 0.0"),
        (["--seconds", "nan"], "--seconds must be a number above 0, not nan"),
        (["--seed", "-1"], "--seed must be from 0 to 4294967295, not -1"),
        (["--launched", "1e12"], "--launched is no reading of time.monotonic() from before this process"),
        (["--out", "/no/such/folder/run.csv"], "--out must be a file in a folder that exists, not /no/such/folder"),
        (["--task", "Walker9d-v4"], "--task Walker9d-v4 cannot be made: "),
        (["--task", "CartPole-v1"], "--task CartPole-v1 has other observations or actions than a row of numbers"),
    ],
)
def test_a_mistake_is_one_clear_line(arguments, changed, complaint, capsys):
    with pytest.raises(SystemExit) as stopped:
        equal_time.read_arguments([*arguments, *changed])

    error = capsys.readouterr().err
    assert (stopped.value.code, error.count("\n")) == (2, 1)
    assert complaint in error


def test_without_the_libraries_it_says_which_python_has_them(arguments, monkeypatch, capsys):
    monkeypatch.setattr("equal_time.find_spec", lambda library: None)
    with pytest.raises(SystemExit):
        equal_time.read_arguments(arguments)
    assert "sbx is not installed: `make peers`" in capsys.readouterr().err


def in_the_peers_python(script: str, *arguments: str) -> Any:
    """Run a script beside the peers' own and return the JSON of its last line."""
    command = [PEERS_PYTHON, "-W", "ignore", "-c", script, *arguments]
    folder = ROOT / "benchmarks" / "peers"
    ended = subprocess.run(command, env={"PYTHONPATH": str(folder), "JAX_PLATFORMS": "cpu"}, capture_output=True)
    assert ended.returncode == 0, ended.stderr.decode()
    return json.loads(ended.stdout.decode().splitlines()[-1])


SETTINGS = """
import json
import jax
from models import PEERS, make_peer

def shapes(state):
    return [list(leaf.shape[-2:]) for leaf in jax.tree.leaves(state.params) if leaf.ndim > 1 and leaf.shape[-2] > 99]

found = {}
for peer in PEERS:
    model = make_peer(peer, "Walker2d-v4", 5)
    one = {name: getattr(model, name) for name in ("gamma", "learning_starts", "gradient_steps", "seed", "policy_delay")
           if hasattr(model, name)}
    one |= {"rate": model.lr_schedule(1.0), "entropy": float(model.target_entropy)}
    if peer.startswith("sbx"):
        critic = model.policy.qf1_state if peer == "sbx-tqc" else model.policy.qf_state
        one |= {"actor": shapes(model.policy.actor_state), "critic": shapes(critic)}
        one |= {"optimiser": model.policy.optimizer_class.__name__, "given": model.policy.optimizer_kwargs}
        one["temperature"] = float(model.ent_coef.ent_coef_init)
        one["kept"] = getattr(model.policy, "n_target_quantiles", None)
    normaliser = model.get_vec_normalize_env()
    one["scales"] = normaliser and [normaliser.norm_obs, normaliser.norm_reward, normaliser.clip_obs > 1e9]
    found[peer] = one
print(json.dumps(found))
"""


@pytest.mark.slow
@needs_peers
def test_the_libraries_have_the_settings_of_the_authors():
    """Walker2d-v4 has 17 observations and 6 actions. Matrices are told by their last two sizes, inputs left out."""
    found = in_the_peers_python(SETTINGS)

    defaults = {"gamma": 0.99, "learning_starts": 100, "gradient_steps": 1, "seed": 5, "rate": 3e-4, "entropy": -6.0}
    assert found["sb3-sac"].items() >= defaults.items()
    assert found["sbx-sac"].items() >= {**defaults, "policy_delay": 1, "temperature": 1.0}.items()
    heads = [[256, 6], [256, 6]]
    assert sorted(found["sbx-sac"]["critic"]) == [[256, 1], [256, 256]]
    tqc = found["sbx-tqc"]
    assert tqc.items() >= {**defaults, "learning_starts": 256, "policy_delay": 1, "kept": 2 * 25 - 2 * 2}.items()
    assert sorted(tqc["critic"]) == [[512, 25], [512, 512], [512, 512]]
    assert sorted(tqc["actor"]) == [*heads, [256, 256]]
    crossq = found["sbx-crossq"]
    assert crossq.items() >= {**defaults, "rate": 1e-3, "learning_starts": 5_000, "policy_delay": 3}.items()
    assert (crossq["optimiser"], crossq["given"]) == ("adam", {"b1": 0.5})
    assert sorted(crossq["critic"]) == [[2048, 1], [2048, 2048]]
    assert sorted(crossq["actor"]) == [*heads, [256, 256]]
    simba = found["sbx-simba"]
    assert simba.items() >= {"gamma": 0.995, "rate": 1e-4, "entropy": -3.0, "learning_starts": 5_000}.items()
    assert (simba["optimiser"], simba["given"]) == ("adamw", {"weight_decay": 1e-2})
    assert simba["temperature"] == pytest.approx(0.01)
    assert sorted(simba["critic"]) == sorted([[512, 2048], [2048, 512]] * 2 + [[512, 1]])
    assert sorted(simba["actor"]) == sorted([[128, 512], [512, 128], [128, 6], [128, 6]])
    assert simba["scales"] == [True, False, True]
    assert [found[peer]["scales"] for peer in models.PEERS[:4]] == [None] * 4


# A clock that ticks whenever it is asked, once before each step, instead of one that knows how fast the machine is.
TINY = """
import itertools, json, sys
from argparse import Namespace
import equal_time

def with_less_warmup(*given):
    model = made(*given)
    model.learning_starts = 30
    return model

made, equal_time.make_peer = equal_time.make_peer, with_less_warmup
ticks = itertools.count(1)
arguments = Namespace(peer=sys.argv[1], task="InvertedPendulum-v4", seed=5, seconds=40.0)
print(json.dumps(equal_time.train(arguments, equal_time.Clock(0, lambda: next(ticks)))))
"""


@pytest.mark.slow
@needs_peers
@pytest.mark.parametrize("peer", ["sb3-sac", "sbx-crossq"])
def test_a_peer_is_evaluated_after_the_updates_of_its_steps_and_ends_by_itself(peer):
    rows = in_the_peers_python(TINY, peer)

    told = [dict(zip(equal_time.COLUMNS, row, strict=True)) for row in rows]
    assert [row["episode"] for row in told] == [*range(10), *range(10)]
    assert {(row["peer"], row["task"], row["seed"], row["limit"]) for row in told} == {
        (peer, "InvertedPendulum-v4", 5, 40.0)
    }
    first, last = told[0], told[-1]
    assert (first["seconds"], last["seconds"]) == (36, 40)
    for row in (first, last):
        assert row["updates"] == row["step"] - 30 > 0
    assert first["step"] < last["step"]
    assert all(row["return"] == row["length"] for row in told)  # its reward is 1 for each step


# The list of runs.


def timed_rows(task: str, *seconds: float) -> list[dict[str, Any]]:
    words = [runner.training(STUDY, task, repetition) for repetition in range(len(seconds))]
    return [
        {"task": task, "repetition": i, "seconds": one, "load": 0.0, "command": " ".join(["csac", *words[i]])}
        for i, one in enumerate(seconds)
    ]


@pytest.fixture
def folder(tmp_path) -> Path:
    """Where both tasks are timed: 20 s and 30.1 s."""
    rows = [*timed_rows("Walker2d-v4", 19.0, 20.04, 99.0), *timed_rows("Ant-v4", 30.06, 1.0, 40.0)]
    write_rows(tmp_path / "seconds.csv", rows)
    return tmp_path


@pytest.fixture
def started(monkeypatch) -> list[list[str]]:
    """The commands of the peers, which fail for SBX's TQC on Ant and else write a file."""
    commands: list[list[str]] = []

    def run_one(command: list[str], cores: int) -> dict[str, Any]:
        commands.append(command)
        given = dict(zip(command[2::2], command[3::2], strict=True))
        if (given["--peer"], given["--task"]) == ("sbx-tqc", "Ant-v4"):
            raise RuntimeError("it broke")
        write_rows(Path(given["--out"]), [{"limit": float(given["--seconds"])}])
        return {"step": 1_000, "updates": 900, "seconds": float(given["--seconds"])}

    monkeypatch.setattr(runner, "run_one", run_one)
    monkeypatch.setattr(runner, "PEERS_PYTHON", __file__)
    return commands


def test_t_is_the_median_of_three_runs(folder):
    rows = runner.timed(folder, STUDY)
    assert runner.limits(rows, STUDY.tasks) == {"Walker2d-v4": 20.0, "Ant-v4": 30.1}
    with pytest.raises(InputError, match="Ant-v4 was timed 2 times, not 3: python -m"):
        runner.limits(rows[:-1], STUDY.tasks)


def test_the_time_of_another_candidate_is_refused(folder):
    other = dataclasses.replace(STUDY.methods[2], hyperparameters={"policy_delay": 1})
    study = dataclasses.replace(STUDY, methods=(*STUDY.methods[:2], other))
    with pytest.raises(InputError, match=r"seconds.csv was measured with another candidate than confirm.toml has"):
        runner.timed(folder, study)


def test_the_candidate_is_timed_with_every_hyperparameter_of_stage_1(monkeypatch):
    trained: dict[str, Any] = {}

    def train(algorithm: Any, task: str, **options: Any) -> Any:
        trained.update(options, algorithm=algorithm, task=task)
        return SimpleNamespace(manifest=SimpleNamespace(state="finished", failures={}))

    monkeypatch.setattr("csac.training.train.train", train)
    csac(runner.training(STUDY, "Ant-v4", 2))

    (candidate,) = [method for method in STUDY.methods if method.label == runner.CANDIDATE]
    assert dataclasses.asdict(trained["algorithm"]) == candidate.hyperparameters_on("Ant-v4")
    assert (trained["task"], trained["steps"], trained["first_seed"]) == ("Ant-v4", 100_000, 102)
    assert (trained["evaluation_interval"], trained["evaluation_episodes"]) == (100_000, 1)


def test_only_what_was_not_timed_is_timed(folder, monkeypatch):
    rows = runner.timed(folder, STUDY)
    write_rows(folder / "seconds.csv", [row for row in rows if (row["task"], row["repetition"]) != ("Ant-v4", 1)])
    monkeypatch.setattr(runner, "time_training", lambda words: 31.5)
    monkeypatch.setattr(runner, "machine", lambda seconds: ["a processor"])

    assert runner.main(["seconds", "--folder", str(folder)]) == 0

    assert runner.timed(folder, STUDY)[:-1] == [*rows[:4], rows[5]]
    assert runner.limits(runner.timed(folder, STUDY), ["Ant-v4"]) == {"Ant-v4": 31.5}
    assert (folder / "machine.txt").read_text() == "a processor\n"


def test_peers_run_seed_by_seed_and_what_is_there_is_not_run_again(folder, started, capsys):
    assert runner.main(["run", "--folder", str(folder)]) == 3

    given = [dict(zip(command[2::2], command[3::2], strict=True)) for command in started]
    assert [one["--peer"] for one in given[:6]] == [*models.PEERS, "sb3-sac"]
    assert [one["--task"] for one in given[:10]] == ["Walker2d-v4"] * 5 + ["Ant-v4"] * 5
    assert [one["--seed"] for one in given[::10]] == ["100", "101", "102", "103", "104"]
    assert {(one["--task"], one["--seconds"]) for one in given} == {("Walker2d-v4", "20.0"), ("Ant-v4", "30.1")}
    assert "failed: sbx-tqc on Ant-v4, seed 100: it broke" in capsys.readouterr().err
    with (folder / "load.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 45

    started.clear()
    assert runner.main(["run", "--folder", str(folder)]) == 3
    assert [command[command.index("--peer") + 1] for command in started] == ["sbx-tqc"] * 5
    assert "45 of 50 runs are there; the others take 0.0 hours" in capsys.readouterr().out


def test_a_run_of_another_t_is_refused(folder, started, capsys):
    path = folder / "Ant-v4" / "sbx-sac" / "seed-103.csv"
    path.parent.mkdir(parents=True)
    write_rows(path, [{"limit": 29.0}])

    assert runner.main(["run", "--folder", str(folder)]) == 2
    assert f"{path} is of 29 seconds, not of 30.1: remove it" in capsys.readouterr().err
    assert not started


def test_the_script_understands_what_it_is_given(folder, monkeypatch):
    monkeypatch.setattr("equal_time.unusable", lambda peer, task: "")
    for run in runner.runs(folder, STUDY)[:10]:
        run.path.parent.mkdir(parents=True, exist_ok=True)
        python, script, *given = runner.command(run, 20.0)
        read = equal_time.read_arguments(given)
        assert (read.peer, read.task, read.seed, read.seconds, read.out) == (*run[:3], 20.0, run.path)
        assert (python, Path(script)) == (PEERS_PYTHON, Path(equal_time.__file__))


def test_the_peers_are_the_same_everywhere():
    assert runner.PEERS == models.PEERS
