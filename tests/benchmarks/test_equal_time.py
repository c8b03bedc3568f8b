"""Peers at equal time: steps and seconds, arguments, the settings of authors in the real libraries, and the runs."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equal_time
import models
import numpy as np
import pytest
from evaluation import evaluate

from benchmarks import equal_time as runner
from benchmarks import measuring
from benchmarks.contenders import PEERS_PYTHON
from benchmarks.measuring import ROOT, Process
from benchmarks.tables import read_rows, write_rows
from csac.cli import main as csac
from csac.studies.study import read_study
from csac.types import InputError

STUDY = read_study(runner.STUDY)
needs_peers = pytest.mark.skipif(not Path(PEERS_PYTHON).exists(), reason="the peers are not installed: make peers")


class Model:
    """Learns by a callback as SB3 has it: a rollout of one step, and then an update; each takes `pace` seconds."""

    def __init__(self, pace: float = 0.0, warmup: int = 0) -> None:
        self.pace, self.warmup, self.at = pace, warmup, 100.0
        self.num_timesteps = self._n_updates = 0
        self.weights = np.ones(2)
        self.policy = SimpleNamespace(actor_state=SimpleNamespace(params={"kernel": self.weights}))

    def learn(self, steps: int, callback: Any) -> None:
        while self.num_timesteps < steps:
            callback._on_rollout_start()
            self.num_timesteps += 1
            self.at += self.pace
            if not callback._on_step():
                return
            self.update()

    def update(self) -> None:
        self._n_updates += self.num_timesteps > self.warmup

    def now(self) -> float:
        return self.at


@pytest.fixture
def _callbacks(monkeypatch):
    """What SB3's callbacks are derived from, for the peers' library is not installed here."""
    name = "stable_baselines3.common.callbacks"
    monkeypatch.setitem(sys.modules, name, SimpleNamespace(BaseCallback=object))


@pytest.mark.usefixtures("_callbacks")
def test_steps_are_counted_after_two_thirds_of_the_seconds_and_at_their_end():
    model = Model(pace=2.0, warmup=4)
    # Launched 10 s before, a step each 2 s: 11 steps are over after 32 s, and 19 after 48 s.
    assert equal_time.count_steps(model, 48.0, launched=90.0, now=model.now) == [(32.0, 11, 7), (48.0, 19, 15)]


@pytest.mark.usefixtures("_callbacks")
def test_an_evaluation_comes_after_the_updates_of_its_step(monkeypatch):
    monkeypatch.setattr(equal_time, "evaluate", lambda model, environment, episodes: (environment, episodes))
    model = Model(warmup=3)
    assert equal_time.learn(model, "a task", [2, 5, 9]) == [
        (2, 0, ("a task", 10)),
        (5, 2, ("a task", 10)),
        (9, 6, ("a task", 10)),
    ]


class Diverging(Model):
    """Its actor is NaN after the update of its sixth step. SBX's goes on with that."""

    def update(self) -> None:
        super().update()
        if self.num_timesteps == 6:
            self.weights[1] = np.nan


class Refusing(Diverging):
    """SB3's, whose parameters are PyTorch's, refuses to act by NaN."""

    def __init__(self) -> None:
        super().__init__()
        parameter = SimpleNamespace(detach=lambda: SimpleNamespace(cpu=lambda: SimpleNamespace(numpy=self.numpy)))
        self.policy = SimpleNamespace(actor=SimpleNamespace(parameters=lambda: iter([parameter])))

    def numpy(self) -> np.ndarray:
        return self.weights

    def update(self) -> None:
        if np.isnan(self.weights).any():
            raise ValueError("Expected parameter loc to satisfy the constraint Real(), but found invalid values")
        super().update()


@pytest.mark.usefixtures("_callbacks")
@pytest.mark.parametrize(("model", "updates"), [(Diverging(), 9), (Refusing(), 6)])
def test_what_is_left_of_a_run_that_diverged_is_nan(model, updates, monkeypatch):
    monkeypatch.setattr(equal_time, "evaluate", lambda model, environment, episodes: [(7.0, 3)] * episodes)
    found = equal_time.learn(model, "a task", [2, 5, 9, 30])

    assert found[:2] == [(2, 2, [(7.0, 3)] * 10), (5, 5, [(7.0, 3)] * 10)]
    assert [(step, made, len(episodes)) for step, made, episodes in found[2:]] == [(9, updates, 10), (30, updates, 10)]
    assert all(math.isnan(total) and not length for *_, episodes in found[2:] for total, length in episodes)
    assert model.num_timesteps < 12  # nothing is learnt any more


@pytest.mark.usefixtures("_callbacks")
def test_a_run_that_breaks_off_with_a_finite_actor_is_no_result(monkeypatch):
    def broken(*_: Any) -> None:
        raise ValueError("a file is gone")

    monkeypatch.setattr(equal_time, "evaluate", broken)
    with pytest.raises(ValueError, match="a file is gone"):
        equal_time.learn(Model(), "a task", [2, 5])


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
    monkeypatch.chdir(tmp_path)
    return ["--peer", "sbx-tqc", "--task", "Walker2d-v4", "--seed", "3"]


def test_the_clock_of_a_run_by_hand_starts_with_the_script(arguments):
    assert equal_time.read_arguments([*arguments, "--seconds", "5"]).launched == equal_time.IMPORTED


@pytest.mark.usefixtures("_callbacks")
def test_the_file_of_a_run_that_diverged_has_every_evaluation(arguments, monkeypatch, capsys):
    monkeypatch.setattr(equal_time, "make_peer", lambda *_: Diverging())
    monkeypatch.setattr(equal_time, "evaluate", lambda model, environment, episodes: [(7.0, 3)] * episodes)
    equal_time.main([*arguments, "--steps", "5", "9", "--out", "run.csv"])

    rows = read_rows(Path("run.csv"))
    assert [row["step"] for row in rows] == [5] * 10 + [9] * 10
    assert [row["return"] for row in rows[:10]] == [7] * 10
    assert all(math.isnan(row["return"]) for row in rows[10:])
    assert json.loads(capsys.readouterr().out) == {"step": 9, "updates": 9, "failed": True}


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ("--seconds 5 --peer sbx-rainbow", "argument --peer: invalid choice: 'sbx-rainbow'"),
        ("--seconds 0", "--seconds must be a number above 0, not 0.0"),
        ("--seconds nan", "--seconds must be a number above 0, not nan"),
        ("--seconds 5 --out run.csv", "--out is for --steps: with --seconds nothing is evaluated"),
        ("--seconds 5 --steps 9", "argument --steps: not allowed with argument --seconds"),
        ("", "one of the arguments --seconds --steps is required"),
        ("--steps 9 9 --out run.csv", "--steps must be whole numbers from 1 on that rise, not 9 9"),
        ("--steps 0 9 --out run.csv", "--steps must be whole numbers from 1 on that rise, not 0 9"),
        ("--steps 9", "--steps needs --out FILE.csv"),
        ("--steps 9 --out no/folder/run.csv", "--out must be a file in a folder that exists, not no/folder/run.csv"),
        ("--seconds 5 --seed -1", "--seed must be from 0 to 4294967295, not -1"),
        ("--seconds 5 --launched 1e12", "--launched is no reading of time.monotonic() from before this process"),
        ("--seconds 5 --task Walker9d-v4", "--task Walker9d-v4 cannot be made: "),
        ("--seconds 5 --task CartPole-v1", "--task CartPole-v1 has other observations or actions than a row of"),
    ],
)
def test_a_mistake_is_one_clear_line(arguments, changed, complaint, capsys):
    with pytest.raises(SystemExit) as stopped:
        equal_time.read_arguments([*arguments, *changed.split()])

    error = capsys.readouterr().err
    assert (stopped.value.code, error.count("\n")) == (2, 1)
    assert complaint in error


def test_without_the_libraries_it_says_which_python_has_them(arguments, monkeypatch, capsys):
    monkeypatch.setattr("equal_time.find_spec", lambda library: None)
    with pytest.raises(SystemExit):
        equal_time.read_arguments([*arguments, "--seconds", "5"])
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


TINY = """
import json, sys
import equal_time, gymnasium

model = equal_time.make_peer(sys.argv[1], "InvertedPendulum-v4", 5)
model.learning_starts = 30
found = equal_time.learn(model, gymnasium.make("InvertedPendulum-v4"), [36, 40])
print(json.dumps(found))
"""


@pytest.mark.slow
@needs_peers
@pytest.mark.parametrize("peer", ["sb3-sac", "sbx-crossq"])
def test_a_peer_is_evaluated_after_the_updates_of_its_steps_and_ends_by_itself(peer):
    found = in_the_peers_python(TINY, peer)

    assert [(step, updates, len(episodes)) for step, updates, episodes in found] == [(36, 6, 10), (40, 10, 10)]
    assert all(total == length for *_, episodes in found for total, length in episodes)  # its reward is 1 for each step


# How fast each is.

# Steps per second, and the seconds before the first step: T is 10 s + 100,000 steps / 100.
PACES = {peer: (10.0 * (i + 1), 5.0) for i, peer in enumerate(runner.PEERS)}
PACES |= {runner.CANDIDATE: (100.0, 10.0), "SAC, candidate": (110.0, 10.0)}
T = 1010.0
MACHINE = ["processor: one, 2 cores; one core multiplies at 50 operations/s", "csac 0.1.0 at commit abc, Python 3.11.7"]
PEERS_VERSIONS = "the peers: Python 3.11.7, flax 0.12.8"


@pytest.fixture
def measured(monkeypatch) -> list[tuple[str, str]]:
    """What is measured, at PACES; the second of three repetitions is right, the others are too fast and too slow."""
    made: list[tuple[str, str]] = []

    def measure(contender: str, study: Any, task: str) -> runner.Speed:
        made.append((contender, task))
        pace, start = PACES[contender]
        pace *= (1.5, 1.0, 0.5)[(made.count((contender, task)) - 1) % 3]
        return runner.Speed((40.0, 60.0), (pace * (40 - start), pace * (60 - start)))

    monkeypatch.setattr(runner, "measure", measure)
    monkeypatch.setattr(runner, "time_training", lambda words: made.append(("prepared", words[1])) or 1.0)
    monkeypatch.setattr(runner, "machine", lambda seconds: MACHINE)
    monkeypatch.setattr(runner, "peers_versions", lambda: PEERS_VERSIONS)
    monkeypatch.setattr(runner, "watch_load", lambda: lambda: 0.1)
    monkeypatch.setattr(runner, "PEERS_PYTHON", __file__)
    return made


@pytest.fixture
def folder(tmp_path, measured) -> Path:
    """Where everything has its speed."""
    assert runner.main(["speeds", "--folder", str(tmp_path)]) == 0
    prepared = [("prepared", STUDY.tasks[0])] * 2  # both lengths have programs of their own
    own = [[*prepared, (label, STUDY.tasks[0])] for label in (runner.CANDIDATE, "SAC, candidate")]
    assert measured[:6] == [*own[0], *own[1]]
    assert len(measured) == 3 * 2 * 7 + 2 * 2 * 2
    measured.clear()
    return tmp_path


def test_a_speed_is_a_line_through_two_moments():
    speed = runner.Speed((40.0, 60.0), (700.0, 1_100.0))
    assert (speed.rate, speed.steps_at(100.0), speed.seconds_at(1_900.0)) == (20.0, 1_900.0, 100.0)


def test_the_plan_has_the_steps_of_each_in_the_time_of_the_candidate(folder):
    limits, steps = runner.read_plan(folder, STUDY)
    assert limits == dict.fromkeys(STUDY.tasks, T)
    assert steps[runner.CANDIDATE, "Ant-v4"][-1] == 100_000
    assert steps["SAC, candidate", "Ant-v4"][-1] == 110_000
    for i, peer in enumerate(runner.PEERS):
        pace = 10 * (i + 1)
        assert steps[peer, "Ant-v4"] == [round(pace * (share * T - 5)) for share in runner.SHARES]
    assert (folder / "machine.txt").read_text().splitlines() == [*MACHINE, PEERS_VERSIONS]


def test_a_share_of_the_time_without_a_step_is_left_out():
    slow = runner.Speed((800.0, 900.0), (100.0, 300.0))
    speeds = {(contender, "Ant-v4"): [slow] * 3 for contender in runner.CONTENDERS}
    speeds[runner.CANDIDATE, "Ant-v4"] = [runner.Speed((10.0, 510.0), (0.0, 50_000.0))] * 3
    told = [row for row in runner.plan(speeds, ["Ant-v4"]) if row["contender"] == "sb3-sac"]
    assert [row["share"] for row in told] == [0.8, 0.85, 0.9, 0.95, 1.0]  # its first step is over after 750 s
    assert told[-1]["steps"] == 520


def test_only_what_was_not_measured_is_measured(folder, measured):
    path = folder / "speeds.csv"
    rows = read_rows(path)
    assert len(rows) == 3 * 2 * 7
    write_rows(path, rows[:-1])
    (folder / "plan.csv").unlink()

    assert runner.main(["speeds", "--folder", str(folder)]) == 0

    assert measured == [("sbx-simba", "Ant-v4")]
    assert len(read_rows(path)) == len(rows)
    assert (folder / "plan.csv").exists()


def test_a_speed_beside_other_programs_is_refused_and_measured_again(tmp_path, measured, monkeypatch, capsys):
    loads = iter([0.1, 0.2, 0.31, *[0.1] * 50])
    monkeypatch.setattr(runner, "watch_load", lambda: lambda: next(loads))
    assert runner.main(["speeds", "--folder", str(tmp_path)]) == 2

    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "sb3-sac on Walker2d-v4: 15.0 steps/s; other programs kept 0.31 cores busy, more than 0.2: it does" in error
    assert "does not count, and the same command measures it again" in error
    assert [row["contender"] for row in read_rows(tmp_path / "speeds.csv")] == [runner.CANDIDATE, "SAC, candidate"]

    measured.clear()
    assert runner.main(["speeds", "--folder", str(tmp_path)]) == 0
    assert measured[0] == ("sb3-sac", "Walker2d-v4")


def test_on_another_machine_or_with_other_versions_nothing_is_measured(folder, measured, monkeypatch, capsys):
    path = folder / "speeds.csv"
    write_rows(path, read_rows(path)[:-1])
    other = MACHINE[0].replace("2 cores", "4 cores")
    monkeypatch.setattr(runner, "machine", lambda seconds: [other, MACHINE[1]])
    assert runner.main(["speeds", "--folder", str(folder)]) == 2
    error = capsys.readouterr().err
    assert "of another machine or other versions, as machine.txt has not got 'processor: one, 4 cores': go on" in error
    assert error.count("\n") == 1

    monkeypatch.setattr(runner, "machine", lambda seconds: MACHINE)
    monkeypatch.setattr(runner, "peers_versions", lambda: PEERS_VERSIONS.replace("0.12.8", "0.12.9"))
    assert runner.main(["speeds", "--folder", str(folder)]) == 2
    assert "machine.txt has not got 'the peers: Python 3.11.7, flax 0.12.9'" in capsys.readouterr().err

    (folder / "machine.txt").unlink()
    assert runner.main(["speeds", "--folder", str(folder)]) == 2
    assert not measured


def test_a_machine_stays_the_same_at_another_pace_and_commit(folder, measured, monkeypatch):
    path = folder / "speeds.csv"
    write_rows(path, read_rows(path)[:-1])
    later = [line.replace(" 50 ", " 61 ").replace("commit abc", "commit def with changes") for line in MACHINE]
    monkeypatch.setattr(runner, "machine", lambda seconds: later)
    assert runner.main(["speeds", "--folder", str(folder)]) == 0
    assert measured == [("sbx-simba", "Ant-v4")]


def test_what_lasts_of_a_machine_are_its_processors_and_versions(monkeypatch):
    def lines(rate: float, commit: str) -> list[str]:
        monkeypatch.setattr(measuring, "one_core_rate", lambda seconds: rate)
        monkeypatch.setattr(measuring, "_commit", lambda: commit)
        return measuring.machine(1.0)

    first, second = lines(50.0, "abc"), lines(61.0, "def with changes")
    assert first != second
    assert measuring.lasting(first) == measuring.lasting(second)
    assert " cores, " in measuring.lasting(first)[0]
    assert f"numpy {np.__version__}" in measuring.lasting(first)[1]


def test_the_peers_versions_are_those_of_their_own_python(monkeypatch):
    monkeypatch.setattr(runner, "PEERS_PYTHON", sys.executable)
    monkeypatch.setattr(runner, "PACKAGES", ("numpy", "pytest"))
    python = ".".join(map(str, sys.version_info[:3]))
    assert runner.peers_versions() == f"the peers: Python {python}, numpy {np.__version__}, pytest {pytest.__version__}"

    monkeypatch.setattr(runner, "PACKAGES", ("numpy", "no-such-library"))
    with pytest.raises(InputError, match=r"lacks a library: run `make peers` \(.*no-such-library\)$"):
        runner.peers_versions()


def test_without_every_speed_there_is_no_plan(folder):
    speeds = runner.measured(folder, STUDY)
    speeds["sbx-tqc", "Ant-v4"].pop()
    with pytest.raises(InputError, match="sbx-tqc on Ant-v4 was measured 2 times, not 3: go on with speeds"):
        runner.plan(speeds, STUDY.tasks)


@pytest.mark.parametrize("label", runner.OWN)
def test_the_speed_of_another_candidate_is_refused(folder, label):
    (index,) = [i for i, method in enumerate(STUDY.methods) if method.label == label]
    other = dataclasses.replace(STUDY.methods[index], hyperparameters={"policy_delay": 1})
    methods = (*STUDY.methods[:index], other, *STUDY.methods[index + 1 :])
    with pytest.raises(InputError, match=rf"speeds.csv was measured with another {label} than confirm.toml has"):
        runner.measured(folder, dataclasses.replace(STUDY, methods=methods))


@pytest.mark.parametrize("label", runner.OWN)
def test_the_candidate_is_timed_with_every_hyperparameter_of_stage_1(monkeypatch, label):
    trained: dict[str, Any] = {}

    def train(algorithm: Any, task: str, **options: Any) -> Any:
        trained.update(options, algorithm=algorithm, task=task)
        return SimpleNamespace(manifest=SimpleNamespace(state="finished", failures={}))

    monkeypatch.setattr("csac.training.train.train", train)
    csac(runner.training(STUDY, label, "Ant-v4", 20_000))

    (candidate,) = [method for method in STUDY.methods if method.label == label]
    assert dataclasses.asdict(trained["algorithm"]) == candidate.hyperparameters_on("Ant-v4")
    assert (trained["task"], trained["steps"], trained["first_seed"]) == ("Ant-v4", 20_000, 100)
    assert (trained["evaluation_interval"], trained["evaluation_episodes"]) == (20_000, 1)


def test_the_candidate_s_speed_is_that_of_two_commands_and_a_peer_s_that_of_its_marks(monkeypatch):
    monkeypatch.setattr(runner, "time_training", lambda words: float(words[words.index("--steps") + 1]) / 100 + 10)
    monkeypatch.setattr("equal_time.unusable", lambda peer, task: "")
    given: list[Any] = []
    answer = {"marks": [[41.0, 820, 720], [61.0, 1220, 1120]]}

    def run_one(command: list[str], cores: int) -> dict[str, Any]:
        given.append(equal_time.read_arguments(command[2:]))
        return answer

    monkeypatch.setattr(runner, "run_one", run_one)
    for label in runner.OWN:
        assert runner.measure(label, STUDY, "Ant-v4") == runner.Speed((150.0, 210.0), (14_000, 20_000))
    assert runner.measure("sbx-sac", STUDY, "Ant-v4") == runner.Speed((41.0, 61.0), (820, 1220))
    assert [(one.peer, one.task, one.seed, one.seconds) for one in given] == [("sbx-sac", "Ant-v4", 100, 60.0)]
    # CrossQ compiles at its first three updates: these may not be within the window.
    for marks in ([[41.0, 20, 9], [61.0, 40, 29]], [[64.0, 820, 720], [64.0, 820, 720]]):
        answer["marks"] = marks
        with pytest.raises(InputError, match=r"sbx-sac on Ant-v4 still warmed up after \d+ s: this machine is too"):
            runner.measure("sbx-sac", STUDY, "Ant-v4")


# The runs that learn.


@pytest.fixture
def started(monkeypatch) -> list[tuple[dict[str, str], list[int], list[int]]]:
    """Arguments, steps and cores of the runs, which break off for SBX's TQC on Ant and else write a file."""
    commands: list[tuple[dict[str, str], list[int], list[int]]] = []

    def run(processes: list[Process], environment: Any) -> list[dict[str, Any]]:
        ((command, cores),) = processes
        at = command.index("--steps")
        given, steps = dict(zip(command[2:at:2], command[3:at:2], strict=True)), [int(one) for one in command[at + 1 :]]
        commands.append((given, steps, list(cores)))
        if (given["--peer"], given["--task"]) == ("sbx-tqc", "Ant-v4"):
            raise RuntimeError("it broke")
        write_rows(Path(given["--out"]), [{"step": one} for one in steps for _ in range(10)])
        return [{"step": steps[-1], "updates": 900, "failed": given["--peer"] == "sbx-simba"}]

    monkeypatch.setattr(runner, "run", run)
    monkeypatch.setattr(runner, "usable_cores", lambda: [4, 7])
    return commands


def test_peers_run_seed_by_seed_and_what_is_there_is_not_run_again(folder, started, capsys):
    assert runner.main(["run", "--folder", str(folder)]) == 3

    assert [given["--peer"] for given, *_ in started[:6]] == [*models.PEERS, "sb3-sac"]
    assert [given["--task"] for given, *_ in started[:10]] == ["Walker2d-v4"] * 5 + ["Ant-v4"] * 5
    assert [given["--seed"] for given, *_ in started[::10]] == ["100", "101", "102", "103", "104"]
    _, steps = runner.read_plan(folder, STUDY)
    assert all(wanted == steps[given["--peer"], given["--task"]] for given, wanted, _ in started)
    assert {tuple(cores) for *_, cores in started} == {(4,)}
    told = capsys.readouterr()
    assert "failed: sbx-tqc on Ant-v4, seed 100: it broke" in told.err
    assert (
        "sbx-simba on Ant-v4, seed 104: 50,250 steps, 900 updates; training failed with NaN, which counts" in told.out
    )
    assert "sbx-crossq on Ant-v4, seed 104: 40,200 steps, 900 updates\n" in told.out

    started.clear()
    assert runner.main(["run", "--folder", str(folder)]) == 3
    assert [given["--peer"] for given, *_ in started] == ["sbx-tqc"] * 5
    assert "45 of 50 runs are there; the others take 1.4 hours or more" in capsys.readouterr().out


def test_parts_are_disjoint_are_everything_and_have_their_own_cores(folder, started):
    for part in ("1/2", "2/2"):
        runner.main(["run", "--folder", str(folder), "--part", part])

    files = [given["--out"] for given, *_ in started]
    assert sorted(files) == sorted(str(one.path) for one in runner.runs(folder, STUDY))
    assert [cores for *_, cores in started] == [[4]] * 25 + [[7]] * 25


@pytest.mark.parametrize("part", ["0/2", "3/2", "half", "1/2/3", "-1/2"])
def test_what_is_no_part_is_refused(part, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        runner.main(["run", f"--part={part}", "--folder", str(tmp_path)])
    assert stopped.value.code == 2
    assert f"{part!r} is no part such as 1/2" in capsys.readouterr().err


def test_a_run_of_another_plan_is_refused(folder, started, capsys):
    path = folder / "Ant-v4" / "sbx-sac" / "seed-103.csv"
    path.parent.mkdir(parents=True)
    write_rows(path, [{"step": 29}])

    assert runner.main(["run", "--folder", str(folder)]) == 2
    assert f"{path} is not of 1,920 to 20,100 steps, as plan.csv has it: remove it" in capsys.readouterr().err
    assert not started


def test_a_plan_that_is_not_of_the_speeds_is_refused(folder, started, capsys):
    rows = read_rows(folder / "speeds.csv")
    write_rows(folder / "speeds.csv", [{**row, "last_steps": row["last_steps"] + 7} for row in rows])
    assert runner.main(["run", "--folder", str(folder)]) == 2
    assert (
        "plan.csv is not what speeds.csv says: python -m benchmarks.equal_time speeds writes" in capsys.readouterr().err
    )
    assert not started


def test_before_the_speeds_nothing_is_run(tmp_path, started, monkeypatch, capsys):
    monkeypatch.setattr(runner, "PEERS_PYTHON", __file__)
    assert runner.main(["run", "--folder", str(tmp_path)]) == 2
    assert "plan.csv does not exist: python -m benchmarks.equal_time speeds writes it" in capsys.readouterr().err
    assert not started


def test_the_script_understands_what_it_is_given(folder, monkeypatch):
    monkeypatch.setattr("equal_time.unusable", lambda peer, task: "")
    for run in runner.runs(folder, STUDY)[:10]:
        run.path.parent.mkdir(parents=True, exist_ok=True)
        python, script, *given = runner.command(run, [20, 30])
        read = equal_time.read_arguments(given)
        assert (read.peer, read.task, read.seed, read.steps, read.out) == (*run[:3], [20, 30], run.path)
        assert (python, Path(script)) == (runner.PEERS_PYTHON, Path(equal_time.__file__))


def test_the_peers_are_the_same_everywhere():
    assert runner.PEERS == models.PEERS
