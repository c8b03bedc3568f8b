"""`csac tune`: what is searched, what becomes of trials, and what is shared and resumed."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from studying import write_run

from csac.algorithms import ALGORITHMS, CSAC, SAC, TD3
from csac.cli import main
from csac.console.tables import make_console
from csac.record.config import RunConfig
from csac.record.run import is_run
from csac.record.sets import RunSet
from csac.seeds import TUNING_EVALUATION_SEED
from csac.studies import tune as module
from csac.studies.search import SPACES, Search, sample, space_of
from csac.studies.tune import tune
from csac.training.signals import Interrupted
from csac.types import InputError

optuna = pytest.importorskip("optuna")
WORDS = ["--steps", "1000", "--seeds", "1", "--evaluation-interval", "500", "--evaluation-episodes", "1"]
WORDS += ["--warmup-steps", "400", "--batch-size", "16", "--replay-size", "2000"]
WORDS += ["--actor-hidden-sizes", "8", "--critic-hidden-sizes", "8"]


def search(seeds=2, first_seed=1_000, algorithm=None, space=None, **changes):
    options = {"steps": 1_000, "evaluation_interval": 100, "evaluation_seed": TUNING_EVALUATION_SEED, **changes}
    algorithm = algorithm or SAC(warmup_steps=100, entropy_weight=0.2)
    config = RunConfig(task="Pendulum-v1", algorithm=algorithm.name, seed=first_seed, **options)
    space = space or {"discount": SPACES["sac"]["discount"]}
    return Search(config=config, seeds=seeds, algorithm=algorithm, space=space)


class Trained:
    """Stands for `train`: a seed's return at a step is `score(discount)`; it is interrupted once, at a step."""

    def __init__(self):
        self.found = []
        self.interrupted_at = None

    def score(self, discount):
        return 100 * discount

    def __call__(
        self, algorithm, task, *, directory, stop_when, seeds, first_seed, steps, evaluation_interval, **options
    ):
        self.found.append((algorithm, directory, options))
        score = self.score(algorithm.discount)
        for seed in range(first_seed, first_seed + seeds):
            one = RunConfig(task=task, algorithm=algorithm.name, seed=seed, steps=steps)
            if not is_run(directory / f"seed-{seed}"):
                write_run(directory / f"seed-{seed}", one, points=0, state="interrupted").checkpoints.mkdir()
        for step in range(evaluation_interval, steps + 1, evaluation_interval):
            if step == self.interrupted_at:
                self.interrupted_at = None
                signal.raise_signal(signal.SIGINT)
                raise Interrupted(RunSet.open(directory), signal.SIGINT)
            for run in RunSet.open(directory).runs:
                run.append("evaluations", [row(run.seed, step, score)])
                if stop_when(step, {run.seed: score}):
                    return RunSet.open(directory)
        return RunSet.open(directory)


@pytest.fixture
def trained(monkeypatch):
    found = Trained()
    monkeypatch.setattr(module, "train", found)
    return found


def row(seed, step, value):
    return {"seed": seed, "step": step, "episode": 0, "return": value, "length": 1, "success": None}


def trials(directory):
    storage = optuna.storages.journal.JournalFileBackend(str(directory / "journal.log"))
    study = optuna.load_study(study_name="csac", storage=optuna.storages.JournalStorage(storage))
    return study.get_trials()


def states(directory):
    return [trial.state.name for trial in trials(directory)]


@pytest.mark.parametrize("name", ALGORITHMS)
def test_what_is_searched_are_hyperparameters_and_every_value_can_be(name):
    algorithm = ALGORITHMS[name]()
    for hyperparameter, dimension in space_of(algorithm).items():
        for value in dimension[1:]:
            replace(algorithm, **{hyperparameter: value})


def test_a_default_of_ones_own_is_a_choice_too():
    assert 100 in space_of(CSAC(batch_size=100))["batch_size"]


def test_what_does_nothing_is_not_searched():
    every_update = CSAC(reference_policy="periodic", reference_period=1)
    assert {"reference_period", "reference_rate"} & set(space_of(every_update)) == set()
    assert "reference_rate" in space_of(CSAC(reference_policy="average"))
    assert "target_rate" not in space_of(SAC(critic_normalisation="batch"))
    assert "entropy_weight" not in space_of(CSAC(entropy_weight="auto"))
    assert "weight_learning_rate" in space_of(CSAC(entropy_weight="auto"))
    assert "weight_learning_rate" not in space_of(CSAC())


def test_a_part_of_the_space_can_be_wanted():
    assert list(space_of(TD3(), ["discount", "target_noise"])) == ["target_noise", "discount"]
    assert "discount" not in space_of(TD3(), given=["discount"])
    for wanted, given, named in (
        (["gamma"], [], "gamma"),
        (["discount"], ["discount"], "discount"),
        (None, list(SPACES["td3"]), "nothing"),
    ):
        with pytest.raises(InputError, match=named):
            space_of(TD3(), wanted, given)


def test_values_are_short_and_within_their_ends():
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(20):
        trial = study.ask()
        for name, dimension in SPACES["ppo"].items():
            value = sample(trial, name, dimension)
            assert min(dimension[1:]) <= value <= max(dimension[1:])
        digits = sample(trial, "clip_range", SPACES["ppo"]["clip_range"])
        assert float(f"{digits:.3g}") == digits


def test_a_search_that_never_learns_or_evaluates_is_refused():
    with pytest.raises(InputError, match="no updates"):
        search(steps=100, algorithm=SAC(warmup_steps=5_000))
    with pytest.raises(InputError, match="evaluation_interval"):
        search(evaluation_interval=0)


def test_trials_begin_with_what_is_given_and_the_best_is_told(tmp_path, trained, capsys):
    assert tune(search(), tmp_path / "tune", 4, "csac tune", make_console()) == 0
    assert states(tmp_path / "tune") == ["COMPLETE"] * 4
    (first, directory, options), *others = trained.found
    assert (first.discount, directory.name) == (0.99, "trial-0")
    assert (options["evaluation_seed"], options["resume"], options["device"]) == (TUNING_EVALUATION_SEED, True, "cpu")
    discounts = [algorithm.discount for algorithm, _, _ in trained.found]
    assert len(set(discounts)) == 4
    best = max(discounts)
    assert trials(tmp_path / "tune")[int(np.argmax(discounts))].value == pytest.approx(100 * best)
    told = capsys.readouterr().out
    assert "csac train Pendulum-v1 --algorithm sac --steps 1000 --seeds 5 --evaluation-interval 100" in told
    assert "--evaluation-seed" not in told  # there is no such option
    assert (tmp_path / "tune" / "history.png").exists()
    assert not list((tmp_path / "tune").glob("trial-*/seed-*/checkpoint"))
    assert len(others) == 3


def test_trials_may_have_several_environments(tmp_path, trained, capsys):
    words = ["--algorithm", "sac", "--environments", "2", "--trials", "1", "--directory", str(tmp_path / "tune")]
    assert main(["tune", "Pendulum-v1", *WORDS, *words]) == 0
    assert [options["environments"] for _, _, options in trained.found] == [2]
    assert "--environments 2" in capsys.readouterr().out.splitlines()[-1]


def test_the_same_search_suggests_the_same_and_goes_on(tmp_path, trained):
    tune(search(), tmp_path / "whole", 4, None, make_console())
    whole = [algorithm.discount for algorithm, _, _ in trained.found]
    trained.found.clear()
    for count in (1, 2, 4, 4):
        assert tune(search(), tmp_path / "parts", count, None, make_console()) == 0
        with open(tmp_path / "parts" / "journal.log", "a") as journal:
            journal.write('{"op_code"')  # as a full disk leaves it
    assert [algorithm.discount for algorithm, _, _ in trained.found] == whole


def test_hopeless_trials_are_pruned_and_failed_ones_too(tmp_path, trained):
    trained.score = lambda discount: 100.0 if discount == 0.99 else 50.0
    tune(search(), tmp_path, 7, None, make_console())
    assert states(tmp_path)[:5] == ["COMPLETE"] * 5
    trained.score = lambda _: -1.0
    tune(search(), tmp_path, 8, None, make_console())
    assert states(tmp_path)[7] == "PRUNED"
    assert len(np.unique(RunSet.open(tmp_path / "trial-7").evaluations["step"])) < 10


@pytest.mark.parametrize(("checkpoint_interval", "evaluations"), [(50_000, 14), (0, 10)])
def test_an_interrupted_trial_goes_on_where_it_was_or_begins_anew(
    tmp_path, trained, capsys, checkpoint_interval, evaluations
):
    trained.interrupted_at = 500
    again = search(checkpoint_interval=checkpoint_interval)
    assert tune(again, tmp_path, 2, "csac tune", make_console()) == 130
    assert "go on" in capsys.readouterr().err
    assert states(tmp_path) == ["FAIL", "WAITING"]
    tune(again, tmp_path, 1, None, make_console())
    assert states(tmp_path) == ["FAIL", "COMPLETE"]
    assert [directory.name for _, directory, _ in trained.found] == ["trial-0", "trial-0"]
    assert len(RunSet.open(tmp_path / "trial-0").evaluations) == 2 * evaluations  # the stand-in repeats its own


def test_a_trial_whose_process_died_is_taken_up_again(tmp_path, trained):
    tune(search(), tmp_path, 1, None, make_console())
    study = module._open(search(), tmp_path)
    found = module._next(study, search(), tmp_path, 2)
    assert found
    lost, lock = found
    assert module._next(study, search(), tmp_path, 2) is None  # another process has it
    lock.close()
    tune(search(), tmp_path, 2, None, make_console())
    assert states(tmp_path) == ["COMPLETE", "FAIL", "COMPLETE"]
    assert trained.found[-1][1].name == "trial-1"
    assert trained.found[-1][0].discount == lost.user_attrs["values"]["discount"]


def test_a_directory_of_another_search_or_of_something_else_is_refused(tmp_path, trained):
    tune(search(), tmp_path / "tune", 1, None, make_console())
    for changes, named in (
        ({"seeds": 3}, "seeds"),
        ({"algorithm": TD3(warmup_steps=100), "space": space_of(TD3())}, "td3"),
    ):
        with pytest.raises(InputError, match=named):
            tune(search(**changes), tmp_path / "tune", 2, None, make_console())
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    with pytest.raises(InputError, match="is not empty"):
        tune(search(), tmp_path / "other", 1, None, make_console())


def test_optuna_is_optional(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(InputError, match=r"pip install '\.\[tune\]'"):
        tune(search(), tmp_path, 1, None, make_console())


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--search", "gamma"], "gamma"),
        (["--trials", "0"], "trials"),
        (["--steps", "100"], "no updates"),
        (["--search", "discount", "--discount", "0.9"], "discount"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, capsys, words, named):
    assert main(["tune", "Pendulum-v1", *WORDS[2:], "--directory", str(tmp_path / "tune"), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert named in line
    assert not (tmp_path / "tune").exists()


@pytest.mark.slow
def test_a_killed_search_goes_on(tmp_path):
    """The first process is killed in its first trial, which the second ends before it makes another."""
    line = [sys.executable, "-m", "csac", "tune", "Pendulum-v1", *WORDS, "--search", "discount"]
    line += ["--algorithm", "sac", "--trials", "2", "--directory", str(tmp_path / "tune")]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as process:
        while not (tmp_path / "tune" / "trial-0" / "seed-1000" / "evaluations.csv").exists():
            time.sleep(0.1)
        os.kill(process.pid, signal.SIGKILL)
    assert subprocess.run(line, check=False).returncode == 0
    assert states(tmp_path / "tune") == ["FAIL", "COMPLETE", "COMPLETE"]
    assert sorted(path.name for path in (tmp_path / "tune").glob("trial-*")) == ["trial-0", "trial-1"]
