import csv
import dataclasses
import math
import os
import re
import shlex
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from optuna.storages.journal import JournalFileOpenLock
from tuning import FakeTrain, Told, question

import csac.training.train as training
from csac.algorithms import ALGORITHMS, CSAC, PPO, SAC, SD3, TD3
from csac.arguments import parse
from csac.cli import main
from csac.commands import Chosen
from csac.presets import hyperparameters
from csac.record.rendering import markdown
from csac.record.run import RunDirectory, is_locked
from csac.studies.job import Stopped
from csac.studies.search_space import SPACES, searched, space_table
from csac.studies.shared_study import Question, SharedStudy
from csac.studies.tune import tune
from csac.studies.tune_progress import TuneProgress
from csac.studies.tune_report import FEWEST_FOR_IMPORTANCES, best_command, caveat, trials_table, write_report
from csac.tasks.seeds import EVALUATION_SEED, FRESH_EVALUATION_SEED, TUNING_EVALUATION_SEED
from csac.training.interruptions import caught_signals
from csac.training.train import train
from csac.types import InputError

DOCS = Path(__file__).parents[2] / "docs"
SUPPORT = Path(__file__).parents[1] / "support"
TINY = "--algorithm sac --batch-size 8 --actor-hidden-sizes 8 --critic-hidden-sizes 8 --warmup-steps 20"
LINE = f"tune probes:ActionReward-v0 {TINY} --search actor_learning_rate,discount --steps 90 --seeds 2"
LINE += " --evaluation-interval 30 --evaluation-episodes 2 --groups 1"


def csac(line):
    return main(shlex.split(line))


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(SUPPORT)


class Search:
    """Searches with trials that are not trained, and keeps what was told and the calls of `train`."""

    def __init__(self, monkeypatch, directory):
        self.monkeypatch, self.directory = monkeypatch, directory

    def __call__(self, value, trials, asked=None, directory=None, **how):
        fake, self.told = FakeTrain(value, **how), Told()
        self.calls = fake.calls
        self.monkeypatch.setattr(training, "train", fake)
        study = SharedStudy(directory or self.directory, asked or question())
        tune(study, trials, self.told)
        return study


@pytest.fixture
def search(monkeypatch, tmp_path):
    return Search(monkeypatch, tmp_path / "study")


def constant(algorithm, seed, step):
    return 5.0


# What a trial is, and how it is judged.


def test_the_objective_is_the_mean_over_seeds_of_the_last_three_evaluations(search):
    study = search(lambda algorithm, seed, step: step / 100 + (10.0 if seed == 1_001 else 0.0), trials=1)

    # 8, 9 and 10 of one seed; 18, 19 and 20 of the other.
    (result,) = study.results()
    assert result.state == "complete"
    assert result.returns == {1_000: 9.0, 1_001: 19.0}
    assert result.objective == 14.0
    # What it is pruned by is the same number so far: of 1; of 1 and 2; of 1, 2 and 3; of 2, 3 and 4.
    (trial,) = study.study.trials
    assert [trial.intermediate_values[step] for step in (100, 200, 300, 400)] == [6.0, 6.5, 7.0, 8.0]


def test_the_search_begins_with_what_is_given_and_stays_in_its_ranges(search):
    study = search(constant, trials=12)
    results, space = study.results(), study.question.space
    assert results[0].values == {"actor_learning_rate": 3e-4, "discount": 0.99}
    assert len({tuple(result.values.values()) for result in results}) == 12
    for result in results:
        assert all(space[name].holds(value) for name, value in result.values.items())
    # What is trained has those values, and all others as they were.
    for call, result in zip(search.calls, results, strict=True):
        assert call["algorithm"] == dataclasses.replace(SAC(warmup_steps=50), **result.values)


def test_a_search_finds_what_is_good(search):
    def near_a_thousandth(algorithm, seed, step):
        return -abs(math.log10(algorithm.actor_learning_rate / 1e-3))

    study = search(near_a_thousandth, trials=40, asked=question(("actor_learning_rate",)))
    best = study.best()
    assert best is not None
    assert best.values["actor_learning_rate"] == pytest.approx(1e-3, rel=0.2)
    assert best.objective > study.results()[0].objective


def test_a_search_in_parts_tries_what_a_search_in_one_tries(search, tmp_path):
    def value(algorithm, seed, step):
        return 100 * algorithm.actor_learning_rate

    whole = search(value, trials=13, directory=tmp_path / "whole").results()
    search(value, trials=6, directory=tmp_path / "parts")
    assert search(value, trials=13, directory=tmp_path / "parts").results() == whole


def test_trials_are_evaluated_on_episodes_that_no_report_uses(search):
    search(constant, trials=1)
    (call,) = search.calls
    assert call["evaluation_seed"] == TUNING_EVALUATION_SEED
    episodes = 1_000_000
    sets = [
        range(first, first + episodes) for first in (EVALUATION_SEED, FRESH_EVALUATION_SEED, call["evaluation_seed"])
    ]
    assert len(set().union(*sets)) == 3 * episodes


class Reset(gymnasium.Env):
    """One step, whose reward is what the episode was reset with."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seed = seed or 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), float(self.seed), True, False, {}


def test_evaluation_episodes_are_reset_with_what_is_asked_for(tmp_path):
    learner = SAC(actor_hidden_sizes=(4,), critic_hidden_sizes=(4,), warmup_steps=100)
    options: dict[str, Any] = {
        "directory": tmp_path / "run",
        "evaluation_episodes": 2,
        "evaluation_seed": 77,
        "tensorboard": False,
    }
    run = train(learner, Reset, steps=4, evaluation_interval=2, **options)
    assert run.evaluations["return"].tolist() == [77.0, 78.0] * 2
    assert run.manifest.evaluation.first_seed == 77
    another: dict[str, Any] = {"evaluation_seed": 1_000_000}
    with pytest.raises(InputError, match="first_seed is 77, not 1000000"):
        train(learner, Reset, resume=True, steps=6, evaluation_interval=2, **options | another)
    elsewhere: dict[str, Any] = {"directory": tmp_path / "other", "evaluation_seed": 2**30}
    with pytest.raises(InputError, match="evaluation_seed must be at most 1,073,741,822"):
        train(learner, Reset, steps=4, **options | elsewhere)


# Trials that do not reach their end.


def test_a_hopeless_trial_is_pruned_and_counts(search):
    def value(algorithm, seed, step):
        return -50.0 if algorithm.discount < 0.98 else 5.0

    study = search(value, trials=25)
    results = study.results()
    assert len(results) == 25
    complete = [result for result in results if result.state == "complete"]
    pruned = [result for result in results if result.state == "pruned"]
    assert pruned
    assert {result.step for result in pruned} == {300}  # after a quarter of the steps, at the next evaluation
    assert all(result.objective == -50.0 and result.values["discount"] < 0.98 for result in pruned)
    assert all(result.label < 15 or result.values["discount"] >= 0.98 for result in complete)
    best = study.best()
    assert best is not None
    assert best.objective == 5.0


def test_a_trial_that_was_pruned_stays_so_whatever_it_is_still_told(search):
    """A run that was cut off would be the best, with the evaluation that comes after its end."""

    def value(algorithm, seed, step):
        return 5.0 if algorithm.discount >= 0.98 else -50.0 if step <= 300 else 3_300.0

    study = search(value, trials=25, lead=1)
    pruned = [result for result in study.results() if result.state == "pruned"]
    assert {result.step for result in pruned} == {400}
    best = study.best()
    assert best is not None
    assert all(result.step == 1_000 for result in study.results() if result.state == "complete")


def test_nothing_is_pruned_before_there_is_something_to_compare_with(search):
    values = iter(range(100, 0, -10))
    table = {}

    def falling(algorithm, seed, step):
        return table.setdefault(algorithm, next(values) if algorithm not in table else 0)

    assert [result.state for result in search(falling, trials=5).results()] == ["complete"] * 5


def test_a_trial_of_which_a_seed_fails_is_over_and_counts_and_says_why(search, tmp_path):
    study = search(constant, trials=12, failing=lambda algorithm: algorithm.discount < 0.98)
    failed = [result for result in study.results() if result.state == "failed"]
    assert failed
    assert all(result.reason == "seed 1000: step 7: learning has diverged" for result in failed)
    assert len(study.results()) == 12
    # It was stopped at its first evaluation.
    assert {result.step for result in failed} == {100}
    table = trials_table(study.question, study.results())
    assert [row.cells[1].text for row in table.rows[-len(failed) :]] == ["failed"] * len(failed)


def test_a_signal_leaves_a_trial_to_be_gone_on_with(search):
    with pytest.raises(Stopped) as stopped:
        search(lambda algorithm, seed, step: step / 100, trials=3, stop_at=400)
    assert stopped.value.signal_number == signal.SIGINT
    assert search.told.begun == [(0, 0)]
    (waiting,) = SharedStudy(search.directory, question()).results()
    assert (waiting.state, waiting.step, waiting.objective) == ("waiting", 400, 3.0)  # 2, 3 and 4

    study = search(lambda algorithm, seed, step: step / 100, trials=3)
    assert search.told.begun == [(0, 400), (1, 0), (2, 0)]
    assert len({call["directory"] for call in search.calls}) == 3
    first = study.results()[0]
    assert (first.state, first.objective) == ("complete", 9.0)  # 8, 9 and 10
    assert first.values == {"actor_learning_rate": 3e-4, "discount": 0.99}
    # Optuna knows of every evaluation, those before the signal included.
    again = next(trial for trial in study.study.trials if trial.value == 9.0)
    assert sorted(again.intermediate_values) == list(range(100, 1_001, 100))
    assert [result.label for result in study.results()] == [0, 1, 2]


def test_a_signal_that_a_trial_outlives_leaves_the_rest(monkeypatch, tmp_path):
    def outlive(*what, **options):
        with caught_signals():
            signal.raise_signal(signal.SIGINT)
            return FakeTrain(constant)(*what, **options)

    monkeypatch.setattr(training, "train", outlive)
    study = SharedStudy(tmp_path / "study", question())
    with pytest.raises(Stopped):
        tune(study, 3, Told())
    assert [result.state for result in study.results()] == ["complete"]


def test_a_trial_whose_process_died_is_taken_up_and_one_that_is_run_is_not(tmp_path):
    mine, theirs = (SharedStudy(tmp_path / "study", question()) for _ in range(2))
    lost, run = mine.next(10), theirs.next(10)
    assert lost is not None
    assert run is not None
    assert (lost.label, run.label) == (0, 1)
    lost.lock.close()  # as the system does where a process dies

    again = theirs.next(10)
    assert again is not None
    assert (again.label, again.values, again.path) == (0, lost.values, lost.path)
    another = mine.next(10)
    assert another is not None
    assert another.label == 2
    assert [result.state for result in mine.results()] == ["running"] * 3
    assert {result.step for result in mine.results()} == {0}
    # Lost once more, it is still one trial of the three that there are to be.
    again.lock.close()
    third = mine.next(3)
    assert third is not None
    assert third.label == 0
    assert theirs.next(3) is None
    for attempt in (run, another, third):
        attempt.lock.close()


@pytest.mark.parametrize("ending", ["complete", "prune", "give_back", "drop"])
def test_a_trial_is_ended_and_let_go_of_at_one_stroke(tmp_path, ending):
    """A process that looked in between took it for a lost one, and met Optuna's refusal to end it twice."""
    study = SharedStudy(tmp_path / "study", question())
    attempt = study.next(1)
    assert attempt
    is_alone = []

    class Lock:
        def close(self) -> None:
            is_alone.append(is_locked(tmp_path / "study" / ".lock"))
            attempt.lock.close()

    given = ({0: 1.0},) if ending == "complete" else ()
    getattr(study, ending)(attempt._replace(lock=Lock()), *given)
    assert is_alone == [True]
    assert not is_locked(tmp_path / "study" / ".lock")


@pytest.mark.filterwarnings("ignore:The value of `grace_period`:UserWarning")
def test_a_study_that_another_process_begins_at_this_moment_is_no_stranger_s(tmp_path, monkeypatch):
    """Its lock of the journal is there before the journal."""
    impatient = partial(JournalFileOpenLock, grace_period=1)  # which waits for half a minute
    monkeypatch.setattr("optuna.storages.journal.JournalFileOpenLock", impatient)
    begun = tmp_path / "study"
    (begun / "trials").mkdir(parents=True)
    (begun / ".lock").touch()
    (begun / "journal.log.lock").touch()
    attempt = SharedStudy(begun, question()).next(1)
    assert attempt is not None
    attempt.lock.close()


def test_a_trial_that_could_not_begin_leaves_the_configuration_that_the_search_begins_with(tmp_path):
    study = SharedStudy(tmp_path / "study", question())
    for _ in range(2):
        first = study.next(10)
        assert first is not None
        assert (first.label, first.values) == (0, {"actor_learning_rate": 3e-4, "discount": 0.99})
        study.drop(first)
    first, second = study.next(10), study.next(10)
    assert first is not None
    assert second is not None
    drawn = dict(second.values)
    study.drop(second)
    assert drawn != first.values
    assert [result.label for result in study.results()] == [0]
    first.lock.close()


def test_a_trial_that_died_before_its_first_checkpoint_begins_anew(search, tmp_path):
    study = SharedStudy(tmp_path / "study", question())
    lost = study.next(1)
    assert lost is not None
    (lost.path / "policy").mkdir(parents=True)
    (lost.path / "manifest.json").write_text("{")  # the machine lost power
    lost.lock.close()
    study = search(constant, trials=1)
    assert [(result.label, result.state) for result in study.results()] == [(0, "complete")]


def interrupted(search):
    """Return the run of a trial that was stopped at step 400, with a checkpoint of that."""
    with pytest.raises(Stopped):
        search(constant, trials=1, stop_at=400)
    run = RunDirectory.open(search.directory / "trials" / "0000")
    run.checkpoints.mkdir()
    (run.checkpoints / "step_400.json").touch()
    return run


def test_a_trial_whose_table_is_damaged_keeps_its_checkpoint_for_train_to_restore_it(search, monkeypatch):
    run = interrupted(search)
    table = run.path / "evaluations.csv"
    content = table.read_bytes()
    table.write_bytes(content[:60] + b"\0x" + content[62:])

    def restoring(*what: Any, directory: Path, **how: Any) -> RunDirectory:
        assert [path.name for path in run.checkpoints.iterdir()] == ["step_400.json"]
        table.write_bytes(content)
        return FakeTrain(lambda algorithm, seed, step: step / 100)(*what, directory=directory, **how)

    monkeypatch.setattr(training, "train", restoring)
    study = SharedStudy(search.directory, question())
    tune(study, 1, Told())
    assert [(result.label, result.state, result.objective) for result in study.results()] == [(0, "complete", 9.0)]
    assert len(run.evaluations) == 10 * 2 * 2  # none was lost, none was made twice


@pytest.mark.parametrize("damage", ["newer", "broken", "unreadable"])
def test_a_trial_whose_manifest_cannot_be_used_is_told_and_kept(search, damage):
    run = interrupted(search)
    manifest = run.path / "manifest.json"
    content, before = manifest.read_text(), (run.path / "evaluations.csv").read_bytes()
    if damage == "unreadable":
        manifest.unlink()
        manifest.mkdir()  # which fails for root as well
    else:
        manifest.write_text("{" if damage == "broken" else re.sub(r'("schema_version": )\d+', r"\g<1>9999", content))
    with pytest.raises(InputError, match="newer csac" if damage == "newer" else "broken|cannot read"):
        search(constant, trials=1)
    assert (run.checkpoints / "step_400.json").exists()
    assert (run.path / "evaluations.csv").read_bytes() == before

    if damage == "unreadable":
        manifest.rmdir()
    manifest.write_text(content)
    study = search(constant, trials=1)
    assert search.told.begun == [(0, 400)]
    assert [(result.label, result.state) for result in study.results()] == [(0, "complete")]


@pytest.mark.parametrize("damage", ["newer", "unreadable"])
def test_a_trial_without_a_checkpoint_is_kept_where_nobody_knows_what_it_is(search, damage):
    study = SharedStudy(search.directory, question())
    lost = study.next(1)
    assert lost is not None
    lost.path.mkdir(parents=True)
    if damage == "newer":
        (lost.path / "manifest.json").write_text('{"schema_version": 9999}')
    else:
        (lost.path / "manifest.json").mkdir()
    (lost.path / "kept").touch()
    lost.lock.close()
    with pytest.raises(InputError):
        search(constant, trials=1)
    assert (lost.path / "kept").exists()


def test_a_trial_that_died_before_its_manifest_knew_of_a_checkpoint_goes_on_from_it(search):
    run = interrupted(search)
    run.update_manifest(last_checkpoint=0)
    (run.checkpoints / "step_400.json").rename(run.checkpoints / "step_300.json")
    with pytest.raises(Stopped):
        search(constant, trials=1, stop_at=100)  # of what train does, only the beginning
    assert search.told.begun == [(0, 300)]


def test_trials_of_a_study_are_counted_whoever_ran_them(search):
    search(constant, trials=4)
    assert len(search.calls) == 4
    search(constant, trials=4)
    assert search.calls == []
    search(constant, trials=6)
    assert len(search.calls) == 2


# What is searched.


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_search_can_begin_with_the_defaults_and_an_algorithm_takes_every_end(name):
    algorithm = ALGORITHMS[name]()
    space = searched(name, vars(algorithm), None, ())
    assert all(dimension.holds(getattr(algorithm, field)) for field, dimension in space.items())
    Question(task="Hopper-v4", algorithm=algorithm, space=space, steps=100_000)
    assert set(SPACES[name]) <= {field.name for field in dataclasses.fields(algorithm)}


def test_what_means_nothing_or_is_given_is_not_searched():
    def names(algorithm, wanted=None, given=()):
        return list(searched(algorithm.name, vars(algorithm), wanted, given))

    assert "reference_period" in names(CSAC(reference_policy="periodic"))
    assert "reference_period" not in names(CSAC())
    assert "reference_rate" in names(CSAC())
    assert "reference_rate" not in names(CSAC(reference_policy="periodic"))
    assert "entropy_weight" not in names(SAC())
    assert "entropy_weight" in names(SAC(entropy_weight=0.2))
    assert "discount" not in names(CSAC(), given=("discount", "steps"))
    assert names(CSAC(), wanted=("discount", "batch_size")) == ["discount", "batch_size"]
    strong = CSAC(**hyperparameters("strong", "csac", "Hopper-v4"))
    assert set(names(CSAC(reference_policy="periodic"))) - set(names(strong)) == {"entropy_weight", "target_rate"}
    with pytest.raises(InputError, match="entropy_weight is auto, and so learnt and not searched"):
        names(strong, wanted=("entropy_weight",))


def test_what_is_given_stays_as_given_and_a_preset_is_where_the_search_begins(monkeypatch):
    fake = FakeTrain(constant)
    monkeypatch.setattr(training, "train", fake)
    line = "tune probes:ActionReward-v0 --algorithm sd3 --preset paper --discount 0.9 --trials 3 --steps 20_000"
    assert csac(f"{line} --evaluation-interval 5000 --directory out") == 0
    assert {call["algorithm"].discount for call in fake.calls} == {0.9}
    assert fake.calls[0]["algorithm"].actor_learning_rate == 1e-3
    assert len({call["algorithm"].actor_learning_rate for call in fake.calls}) == 3


def test_a_search_begins_with_the_preset_that_learns_its_entropy_weight(monkeypatch):
    fake = FakeTrain(constant)
    monkeypatch.setattr(training, "train", fake)
    line = "tune probes:ActionReward-v0 --preset strong --trials 2 --steps 20_000 --evaluation-interval 5000"
    assert csac(f"{line} --directory out") == 0
    first, second = (call["algorithm"] for call in fake.calls)
    assert first == CSAC(**hyperparameters("strong", "csac", "probes:ActionReward-v0"))
    assert (second.entropy_weight, second.critic_normalisation) == ("auto", "batch")
    assert second.actor_learning_rate != first.actor_learning_rate


def test_a_trial_is_trained_as_the_command_says(monkeypatch):
    fake, devices = FakeTrain(constant), []
    monkeypatch.setattr(training, "train", fake)
    monkeypatch.setattr("csac.training.devices.choose_device", devices.append)
    line = f"tune probes:Endless-v0 {TINY} --search discount --trials 1 --steps 90 --seeds 3 --first-seed 7 --groups 2 "
    line += "--device gpu --evaluation-interval 30 --evaluation-episodes 4 --checkpoint-interval 40 "
    line += "--keep-checkpoints 1 --directory out --env-kwargs '{\"length\": 5}'"
    assert csac(line) == 0
    assert fake.calls == [
        {
            "algorithm": SAC(batch_size=8, actor_hidden_sizes=(8,), critic_hidden_sizes=(8,), warmup_steps=20),
            "task": "probes:Endless-v0",
            "environment_arguments": {"length": 5},
            "directory": Path("out/trials/0000"),
            "resume": True,
            "tensorboard": False,
            "steps": 90,
            "seeds": 3,
            "first_seed": 7,
            "groups": 2,
            "device": "gpu",
            "evaluation_interval": 30,
            "evaluation_episodes": 4,
            "evaluation_seed": TUNING_EVALUATION_SEED,
            "checkpoint_interval": 40,
            "keep_checkpoints": 1,
            "command": f"csac {line}",
        }
    ]
    assert devices == ["gpu"]


# What it leaves.


@pytest.mark.parametrize(
    "algorithm",
    [
        CSAC(reference_policy="periodic", actor_hidden_sizes=(64, 32)),
        CSAC(**hyperparameters("strong", "csac", "Hopper-v4")),
        SAC(entropy_weight=0.2, target_entropy=-2.5),
        TD3(),
        SD3(importance_sampling=True),
        PPO(normalise_rewards=False, learning_rate_schedule="constant"),
    ],
    ids=lambda algorithm: algorithm.name,
)
def test_the_best_command_is_read_as_what_the_trial_was(algorithm):
    space = searched(algorithm.name, vars(algorithm), None, ())
    asked = Question(
        task="Hopper-v4",
        algorithm=algorithm,
        space=space,
        steps=100_000,
        evaluation_interval=2_000,
        environment_arguments={"name": "it's"},
    )
    for end in (0, -1):
        values = {name: dimension.ends[end] for name, dimension in space.items()}
        words = shlex.split(best_command(asked, values))
        assert words[:2] == ["csac", "train"]
        options = parse(Chosen.among(words[2:]).command(""), words[2:], "csac train")
        assert getattr(options, algorithm.name) == asked.algorithm_with(values)
        assert (options.task, options.steps, options.seeds) == ("Hopper-v4", 100_000, 5)
        assert options.evaluation_interval == 2_000
        assert options.plan_options().get("environment_arguments") == {"name": "it's"}


def test_seeds_of_the_best_command_are_fresh():
    values = {"actor_learning_rate": 1e-3, "discount": 0.98}
    assert "--first-seed" not in best_command(question(), values)
    assert "--seeds 5 --first-seed 5 " in best_command(question(first_seed=2, seeds=3), values)


def test_the_report_holds_every_trial_and_says_how_little_few_tell(search, tmp_path):
    def value(algorithm, seed, step):
        return 100 * algorithm.actor_learning_rate

    study = search(value, trials=14, failing=lambda algorithm: algorithm.discount < 0.96)
    paths = write_report(study, "csac tune X")
    assert {path.name for path in paths} == {"report.md", "trials.csv", "best.sh", "history.png", "importances.png"}
    results, best = study.results(), study.best()
    assert best is not None
    with open(tmp_path / "study" / "trials.csv") as file:
        rows = list(csv.DictReader(file))
    assert [(int(row["trial"]), row["state"]) for row in rows] == [(result.label, result.state) for result in results]
    row = rows[best.label]
    assert float(row["objective"]) == best.objective == np.mean([float(row["seed_1000"]), float(row["seed_1001"])])
    assert float(row["actor_learning_rate"]) == best.values["actor_learning_rate"]

    text = (tmp_path / "study" / "report.md").read_text()
    assert best_command(study.question, best.values) in text
    complete = sum(result.state == "complete" for result in results)
    assert f"Importances are not reliable: {complete} complete trials" in text
    assert "not reliable" not in caveat(FEWEST_FOR_IMPORTANCES)
    assert text.count("\n| ") == 1 + 14 + 1  # headings, trials; the line below the headings begins so as well
    assert "learning has diverged" in text
    shares = study.importances()
    assert sum(shares.values()) == pytest.approx(1)
    assert shares["actor_learning_rate"] > shares["discount"]


def test_a_report_without_a_complete_trial_says_so(search, tmp_path):
    study = search(constant, trials=2, failing=lambda _: True)
    paths = write_report(study, "csac tune X")
    assert {path.name for path in paths} == {"report.md", "trials.csv"}
    assert "No trial is complete" in (tmp_path / "study" / "report.md").read_text()


def test_what_happens_is_told_in_lines(search, capsys, monkeypatch, tmp_path):
    fake = FakeTrain(lambda algorithm, seed, step: 100 * algorithm.actor_learning_rate)
    monkeypatch.setattr(training, "train", fake)
    study = SharedStudy(tmp_path / "study", question(("actor_learning_rate",)))
    progress = TuneProgress(2, 1_000, clock=iter(range(100)).__next__)
    progress.start(study)
    tune(study, 2, progress)
    lines = capsys.readouterr().out.splitlines()
    first, second = (result.objective for result in study.results())
    assert lines[0] == "tuning sac on probes:ActionReward-v0, 2 trials of 1k steps, 2 seeds each, 0 over"
    assert lines[2] == "trial 0 begins: actor_learning_rate 0.0003"
    assert lines[3] == f"trial 0: {first:.2f}, the best so far (1 of 2 trials, 1 s left)"
    assert lines[5].startswith(f"trial 1: {second:.2f}")
    assert ("best so far" in lines[5]) == (second > first)


@pytest.mark.parametrize("name", SPACES)
def test_the_page_shows_the_search_space_as_it_is(name):
    assert markdown(space_table(name)) in (DOCS / "tuning.md").read_text()


# The command.


@pytest.mark.slow
def test_a_search_whose_best_line_trains(capsys):
    assert csac(f"{LINE} --trials 2 --directory out") == 0
    shown = capsys.readouterr().out
    assert re.search(r"^trial 0: \S+, the best so far \(1 of 2 trials", shown, re.MULTILINE)
    line = Path("out/best.sh").read_text().strip()
    assert line in shown
    run = RunDirectory.open("out/trials/0000")
    assert run.manifest.seeds == (1_000, 1_001)
    assert run.manifest.evaluation.first_seed == TUNING_EVALUATION_SEED
    assert not run.checkpoints.exists()
    with open("out/trials.csv") as file:
        rows = list(csv.DictReader(file))
    assert {row["state"] for row in rows} == {"complete"}
    best = max(rows, key=lambda row: float(row["objective"]))

    assert csac(f"{line.removeprefix('csac ')} --directory run --seeds 1") == 0
    trained = RunDirectory.open("run").manifest
    assert trained.hyperparameters["actor_learning_rate"] == float(best["actor_learning_rate"])
    assert (trained.hyperparameters["batch_size"], trained.steps, trained.seeds) == (8, 90, (0,))
    assert trained.evaluation.first_seed == EVALUATION_SEED

    capsys.readouterr()
    assert csac(f"{LINE} --trials 2 --directory out") == 0  # nothing is left to do
    assert "2 over" in capsys.readouterr().out


def test_a_search_of_which_nothing_is_complete_is_an_exit_code(monkeypatch, capsys):
    monkeypatch.setattr(training, "train", FakeTrain(constant, failing=lambda _: True))
    assert csac(f"{LINE} --trials 2 --directory out") == 3
    assert "no trial is complete" in capsys.readouterr().out


def test_a_signal_is_an_exit_code_and_the_line_to_type(monkeypatch, capsys):
    monkeypatch.setattr(training, "train", FakeTrain(constant, stop_at=60))
    assert csac(f"{LINE} --trials 2") == 130
    (complaint,) = capsys.readouterr().err.splitlines()
    assert complaint.startswith("csac: stopped by SIGINT; the trial is saved. To go on, type the same line again: ")
    assert complaint.endswith(f"{LINE} --trials 2")
    monkeypatch.setattr(training, "train", FakeTrain(constant))
    assert csac(f"{LINE} --trials 2") == 0
    assert "trial 0 goes on from step 60" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("seeds", "told"), [((1_000, 1_001), "seeds 1000, 1001 restart"), ((1_001,), "seed 1001 restarts")]
)
def test_a_trial_that_goes_on_inexactly_says_so(monkeypatch, capsys, seeds, told):
    monkeypatch.setattr(training, "train", FakeTrain(constant, stop_at=60))
    assert csac(f"{LINE} --trials 1 --directory out") == 130
    RunDirectory.open("out/trials/0000").update_manifest(inexact_seeds=seeds)
    assert "note" not in capsys.readouterr().out
    monkeypatch.setattr(training, "train", FakeTrain(constant))
    assert csac(f"{LINE} --trials 1 --directory out") == 0
    line = f"note: trial 0: {told} the episode in progress, which the checkpoint could not hold"
    assert capsys.readouterr().out.splitlines().count(line) == 1


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (f"{LINE} --groups 0", "groups must be a whole number of at least 1, not 0"),
        (f"{LINE} --groups 5", "groups must be at most as many as seeds, 2, not 5: each needs one"),
        (f"{LINE} --trials 0", "trials must be a whole number of at least 1, not 0"),
        (LINE.replace("ActionReward", "ActionRewrad"), "no task is called probes:ActionRewrad-v0"),
        (LINE.replace("actor_learning_rate", "actor_learning_rat"), "did you mean actor_learning_rate?"),
        (f"{LINE} --discount 0.9", "discount is given, and so not searched: leave it out here or there"),
        (LINE.replace("discount", "entropy_weight"), "entropy_weight is auto, and so learnt"),
        (f"{LINE} --warmup-steps 90", "all 90 steps of a trial are warm-up (warmup_steps=90)"),
        (f"{LINE} --directory full", "full is not empty and holds no study"),
        (f"{LINE} --directory full/file", "full/file is a file; choose another directory"),
        (f"{LINE} --sedes 2", "there is no option --sedes"),
        ("""tune Pendulum-v1 --steps 20000 --env-kwargs '{"g": "a"}'""", "does not work with the arguments {'g': 'a'}"),
        ("tune X --algorithm ppo --rollout-steps 1000", "minibatches must divide rollout_steps"),
    ],
)
def test_mistakes_are_told_in_one_line(capsys, tmp_path, line, message):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    assert csac(line) == 2
    (complaint,) = capsys.readouterr().err.splitlines()
    assert message in complaint
    assert [path.name for path in tmp_path.iterdir()] == ["full"]
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["file"]


def test_a_device_that_there_is_not_leaves_nothing_behind(monkeypatch, capsys, tmp_path):
    def refuse(device):
        raise InputError(f"no {device}")

    monkeypatch.setattr("csac.training.devices.choose_device", refuse)
    assert csac(f"{LINE} --device gpu") == 2
    assert capsys.readouterr().err == "csac: no gpu\n"
    assert list(tmp_path.iterdir()) == []


def test_a_directory_of_another_question_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(training, "train", FakeTrain(constant))
    assert csac(f"{LINE} --trials 1 --directory out") == 0
    before = Path("out/journal.log").read_bytes()
    for change, told in [
        ("--steps 120", "steps is 90, not 120"),
        ("--target-rate 0.1", "target_rate is 0.005, not 0.1"),
        ("--search discount", "actor_learning_rate is 'searched: 3e-05 to 0.003, logarithmic', not 0.0003"),
        ("--first-seed 5", "seeds is [1000, 1001], not [5, 6]"),
    ]:
        capsys.readouterr()
        assert csac(f"{LINE} --directory out {change}") == 2
        (complaint,) = capsys.readouterr().err.splitlines()
        assert complaint.startswith("csac: out tunes another question: ")
        assert told in complaint
    assert Path("out/journal.log").read_bytes() == before


def test_a_directory_whose_trials_could_not_begin_takes_another_question(search, tmp_path):
    study = SharedStudy(tmp_path / "study", question())
    first = study.next(10)
    assert first is not None
    with pytest.raises(InputError, match="tunes another question: discount is"):
        SharedStudy(tmp_path / "study", question(("actor_learning_rate",)))  # while it is being run
    study.drop(first)

    other = search(constant, trials=2, asked=question(("actor_learning_rate",), steps=500))
    assert [result.label for result in other.results()] == [0, 1]
    assert other.results()[0].values == {"actor_learning_rate": 3e-4}
    with pytest.raises(InputError, match="tunes another question"):
        SharedStudy(tmp_path / "study", question())


def test_a_damaged_journal_is_told(monkeypatch, capsys):
    monkeypatch.setattr(training, "train", FakeTrain(constant))
    assert csac(f"{LINE} --trials 1 --directory out") == 0
    capsys.readouterr()
    lines = Path("out/journal.log").read_bytes().splitlines(keepends=True)
    Path("out/journal.log").write_bytes(b"".join([lines[0], b"{\n", *lines[1:]]))
    assert csac(f"{LINE} --trials 1 --directory out") == 2
    (complaint,) = capsys.readouterr().err.splitlines()
    assert complaint.startswith("csac: out/journal.log is damaged: ")


def test_without_optuna_one_line_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert csac(LINE) == 2
    assert capsys.readouterr().err == "csac: Optuna is not installed: pip install '.[tune]' in a clone of csac\n"
    assert list(tmp_path.iterdir()) == []


def test_the_help_says_what_a_trial_is_judged_by(capsys):
    assert csac("tune --help") == 0
    text = " ".join(re.sub(r"[│╭╮╰╯─]", " ", capsys.readouterr().out).split())
    assert "score is the mean over its seeds of their last three evaluations" in text


@pytest.mark.slow
def test_two_processes_share_the_trials_of_a_study(tmp_path):
    command = [sys.executable, "-m", "csac", *shlex.split(LINE), "--trials", "6", "--directory", "out"]
    environment = {**os.environ, "PYTHONPATH": str(SUPPORT)}
    processes = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    outputs = [process.communicate()[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    begun = [[int(label) for label in re.findall(r"^trial (\d+) begins", text, re.MULTILINE)] for text in outputs]
    assert sorted(begun[0] + begun[1]) == list(range(6))
    assert all(begun)
    with open("out/trials.csv") as file:
        assert len(list(csv.DictReader(file))) == 6
