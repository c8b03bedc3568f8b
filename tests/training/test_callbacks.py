"""Callbacks hear of steps, episodes and evaluations, log scalars and end runs; one that raises loses nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from manifests import manifest
from resuming import SMALL, contents, run
from scalars import scalars

import csac
from csac import InputError
from csac.algorithms import SAC
from csac.evaluation.episode import EvaluationEpisode
from csac.record.run import RunDirectory
from csac.record.tables import continues
from csac.training.callbacks import Callback, CallbackFailure, Moment, SaveEvery, StopAfterNoImprovement, StopOnReturn

LEARNER = SAC(**SMALL)
ENDLESS: dict[str, Any] = {"task": "probes:Endless-v0", "evaluation_episodes": 1}  # episodes of ten steps, return 10


class Diary(Callback):
    """Remembers all that it hears, by seed, and logs the number of episodes so far."""

    interval = 70

    def __init__(self) -> None:
        self.heard: dict[int, list[tuple[Any, ...]]] = {}

    def on_step(self, moment):
        self.add(moment, "step")
        moment.log("episodes", sum(what == "episode" for _, what, *_ in self.heard[moment.seed]))

    def on_episode(self, moment, episode):
        self.add(moment, "episode", episode.episode_return, episode.length)

    def on_evaluation(self, moment, episodes):
        self.add(moment, "evaluation", episodes[0].episode_return)
        moment.log("own/evaluations", moment.step / 100)

    def add(self, moment, *what):
        self.heard.setdefault(moment.seed, []).append((moment.step, *what))


EXPECTED = sorted(
    [(step, "episode", 10.0, 10) for step in range(10, 201, 10)]
    + [(step, "step") for step in (70, 140)]
    + [(step, "evaluation", 10.0) for step in (100, 200)]
)


@pytest.mark.parametrize(("seeds", "together"), [(2, 1), (2, 2)])
def test_a_callback_hears_everything_of_every_seed_in_its_own_process(tmp_path, seeds, together):
    diary = Diary()
    runs = run(tmp_path / "set", LEARNER, 200, **ENDLESS, seeds=seeds, seeds_per_process=together, callbacks=[diary])
    assert {seed: sorted(heard) for seed, heard in diary.heard.items()} == dict.fromkeys(range(seeds), EXPECTED)
    for one in runs.runs:
        rows = one.rows("metrics")
        logged = rows[np.isfinite(rows["episodes"])]
        np.testing.assert_array_equal(logged[["step", "episodes"]].tolist(), [(70, 7), (140, 14)])
        logged = rows[np.isfinite(rows["own/evaluations"])]
        np.testing.assert_array_equal(logged[["step", "own/evaluations"]].tolist(), [(100, 1), (200, 2)])
        last = rows[rows["step"] == 200]
        assert len(last) == 1
        assert np.isfinite(last["critic_loss"])


def test_what_callbacks_log_changes_nothing_that_is_learnt_and_is_in_tensorboard(tmp_path, whole):
    logged = run(tmp_path / "logged", LEARNER, 300, **ENDLESS, callbacks=[Diary()], tensorboard=True)
    before, after = dict(whole), contents(logged.runs[0])
    assert before.pop("metrics.csv") != after.pop("metrics.csv")
    assert before == after
    curves = scalars(logged.runs[0].path / "tensorboard")
    assert curves["train/episodes"] == [(70, 7.0), (140, 14.0), (210, 21.0), (280, 28.0)]
    assert curves["own/evaluations"] == [(100, 1.0), (200, 2.0), (300, 3.0)]


class StopAt(Callback):
    """Returns False at an event of a kind once a step has come."""

    interval = 10

    def __init__(self, method: str, step: int) -> None:
        self.method, self.step = method, step

    def answer(self, method: str, moment: Moment) -> bool | None:
        return False if method == self.method and moment.step >= self.step else None

    def on_step(self, moment):
        return self.answer("on_step", moment)

    def on_episode(self, moment, episode):
        return self.answer("on_episode", moment)

    def on_evaluation(self, moment, episodes):
        return self.answer("on_evaluation", moment)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What a run leaves that nothing stopped."""
    return contents(run(tmp_path_factory.mktemp("whole") / "set", LEARNER, 300, **ENDLESS).runs[0])


def test_false_ends_a_run_as_finished_and_it_goes_on_without_the_callback(tmp_path, whole):
    stops = [("on_evaluation", 60, 100), ("on_step", 125, 130), ("on_episode", 141, 150)]
    for method, step, expected in stops:  # each goes on from where the one before has ended it
        runs = run(tmp_path / "set", LEARNER, 300, **ENDLESS, callbacks=[StopAt(method, step)], resume=True)
        manifest = runs.runs[0].manifest
        assert (manifest.state, manifest.steps_done) == ("finished", expected)
        assert f"stopped early at step {expected} (StopAt)" in (runs.runs[0].path / "log.txt").read_text()
        again = run(tmp_path / "set", LEARNER, 300, **ENDLESS, callbacks=[StopAt("on_evaluation", 60)], resume=True)
        assert again.runs[0].manifest.steps_done == expected  # the last evaluation would end it as well
    resumed = run(tmp_path / "set", LEARNER, 300, **ENDLESS, resume=True)
    assert contents(resumed.runs[0]) == whole


def test_ready_made_callbacks(tmp_path):
    runs = run(tmp_path / "set", LEARNER, 300, **ENDLESS, callbacks=[StopOnReturn(10.0), SaveEvery(50)])
    assert runs.runs[0].manifest.steps_done == 100
    saved = csac.load(runs.runs[0].path / "policies" / "step_100")
    assert saved.step == 100
    observation = np.ones(1, np.float32)
    np.testing.assert_array_equal(saved.predict(observation)[0], csac.load(runs).predict(observation)[0])
    assert csac.load(runs.runs[0].path / "policies" / "step_50").step == 50


def test_no_improvement_counts_evaluations_since_the_best(tmp_path):
    means = [1.0, 3.0, 2.0, 3.0, 4.0, 3.5, 3.9]  # the best is new at steps 2 and 5; as good is not better
    one = RunDirectory.create(tmp_path / "run", manifest())
    rows = [
        {"seed": 0, "step": step, "episode": j, "return": mean + sign, "length": 1, "success": None}
        for step, mean in enumerate(means, start=1)
        for j, sign in enumerate((-1.0, 1.0))
    ]
    one.append("evaluations", rows)
    for patience, after, expected in ((2, 0, [4, 7]), (2, 5, [7]), (3, 0, [])):
        callback = StopAfterNoImprovement(patience, after)
        stops = [step for step in range(1, 8) if not callback.on_evaluation(Moment(0, step, one.path), [])]
        assert stops == expected


class Broken(Callback):
    interval = 130

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def on_step(self, moment):
        raise self.error


class Forgetful(Callback):
    interval = 10

    def on_step(self, moment):
        self.last = moment.step

    def on_evaluation(self, moment, episodes):
        return self.last > 0


def test_a_callback_that_cannot_judge_the_last_evaluation_ends_nothing(tmp_path):
    run(tmp_path / "set", LEARNER, 100, **ENDLESS, callbacks=[Forgetful()])
    assert run(tmp_path / "set", LEARNER, 150, **ENDLESS, callbacks=[Forgetful()], resume=True).steps_done == 150


@pytest.mark.parametrize(("seeds", "broken"), [(1, SystemExit("by\nzero")), (2, ZeroDivisionError("by\nzero"))])
def test_a_broken_callback_is_one_line_and_loses_nothing(tmp_path, whole, seeds, broken):
    with pytest.raises(CallbackFailure, match=rf"Broken.on_step raised {type(broken).__name__}: by zero") as error:
        run(tmp_path / "set", LEARNER, 300 * seeds, **ENDLESS, seeds=seeds, callbacks=[Broken(broken)])
    assert "\n" not in str(error.value)
    assert error.value.__cause__ is broken
    for seed in range(seeds):
        manifest = RunDirectory.open(tmp_path / "set" / f"seed-{seed}").manifest
        assert manifest.state == "interrupted"
        assert manifest.last_checkpoint == manifest.steps_done > 0
    if seeds == 1:
        resumed = run(tmp_path / "set", LEARNER, 300, **ENDLESS, resume=True)
        assert contents(resumed.runs[0]) == whole


def test_a_run_that_is_resumed_and_logged_later_has_new_columns(tmp_path):
    run(tmp_path / "set", LEARNER, 150, **ENDLESS)
    runs = run(tmp_path / "set", LEARNER, 250, **ENDLESS, callbacks=[Diary()], resume=True)
    rows = runs.runs[0].rows("metrics")
    assert rows["own/evaluations"][rows["step"] == 200] == [2.0]
    assert np.isnan(rows["own/evaluations"][rows["step"] == 150])
    again = run(tmp_path / "set", LEARNER, 300, **ENDLESS, resume=True)  # from a checkpoint before which they began
    assert "restored" not in (again.runs[0].path / "log.txt").read_text()


def test_a_table_goes_on_with_more_columns_but_not_with_others():
    before = b"seed,step,a\n0,1,2\n0,2,3\n"
    assert continues(before + b"0,3,4\n", before)
    assert continues(b"seed,step,a,b,c\n0,1,2,,\n0,2,3,,\n0,3,4,5,6\n", before)
    assert not continues(b"seed,step,a,b,c\n0,1,2,,\n0,2,4,,\n0,3,4,5,6\n", before)
    assert not continues(b"seed,step,ab,b\n0,1,2,\n0,2,3,\n", before)
    assert not continues(before[:-6], before)
    assert not continues(b"", before)


@pytest.mark.parametrize(
    ("callbacks", "name"),
    [
        (StopOnReturn(3.0), "list"),
        ([StopOnReturn], "StopOnReturn"),
        ([lambda moment: True], "no callback"),
        ([SaveEvery(0)], "interval"),
    ],
)
def test_what_is_no_callback_is_refused(tmp_path, callbacks, name):
    with pytest.raises(InputError, match=name):
        run(tmp_path / "set", LEARNER, 200, **ENDLESS, callbacks=callbacks)
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize("name", ["critic_loss", "step", "two words", "", 3])
def test_a_scalar_needs_a_name_of_its_own(tmp_path, name):
    with pytest.raises(InputError):
        Moment(0, 1, tmp_path, metrics=("critic_loss",)).log(name, 1.0)


def test_a_mean_is_over_episodes():
    episodes = [EvaluationEpisode(i, value, 1, None) for i, value in enumerate((2.0, 4.0))]
    assert StopOnReturn(3.0).on_evaluation(Moment(0, 1, None), episodes) is False  # pyright: ignore[reportArgumentType]
    assert StopOnReturn(3.1).on_evaluation(Moment(0, 1, None), episodes) is True  # pyright: ignore[reportArgumentType]
