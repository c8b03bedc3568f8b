"""What becomes of one cell, where nothing is trained and no policy is tested."""

from __future__ import annotations

import signal
import sys
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from shown import Clock
from studying import cell, jobs, make_run

from csac.evaluation.evaluator import EvaluationEpisode
from csac.record.tables import COLUMNS, write_rows
from csac.record.run import RunDirectory
from csac.studies import job as module
from csac.studies.cells import Store, is_in_use, read_history, write_history
from csac.studies.collected import ROLLOUTS
from csac.studies.engines import run_here
from csac.studies.job import Ended, Job, Stopped, execute, is_over
from csac.studies.results import Results, collect
from csac.training.interruptions import signals_noted

if TYPE_CHECKING:
    from collections.abc import Callable


class Stand:
    """Stands in for training, which takes 100 seconds, and for tests of a policy, of 20 each."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock, self.tests, self.interrupting = Clock(), list[dict[str, Any]](), False
        self.during_batch: Callable[[int], Any] = lambda done: None
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=self.clock))
        monkeypatch.setattr(module, "_train", self.train)
        monkeypatch.setattr("csac.evaluation.play.evaluate_run", self.evaluate)

    def train(self, job: Job, _: Any) -> RunDirectory:
        self.clock.now += 100
        run = make_run(Store(job.path.parents[2]), job.cell, state="finished", steps_done=300)
        run.append("evaluations", [EvaluationEpisode(0, 1.0, 9, None).row(0, 300)])
        return run

    def evaluate(self, _: Any, **options: Any) -> Any:
        self.clock.now += 20
        if self.interrupting:
            raise KeyboardInterrupt
        self.tests.append(options)
        for done in (*range(10, options["episodes"], 10), options["episodes"]):
            self.during_batch(done)
            options["on_progress"](done, options["episodes"])
        yield 0, [EvaluationEpisode(number, 1.0, 9, None) for number in range(options["episodes"])]


@pytest.fixture
def stand(monkeypatch):
    return Stand(monkeypatch)


def test_the_seconds_of_training_outlive_a_stop_while_the_policy_is_tested(tmp_path, stand):
    (job,) = jobs(tmp_path, cell(), rollouts=3)
    stand.interrupting = True
    with pytest.raises(KeyboardInterrupt):
        execute(job, print)
    assert read_history(job.path) == {"seconds": 100.0}
    stand.interrupting = False
    assert execute(job, print) == Ended(job.cell.key, "complete")
    assert read_history(job.path) == {"seconds": 120.0}


@pytest.mark.parametrize("engine", [execute, lambda job, tell: run_here([job], tell)], ids=["alone", "here"])
def test_a_signal_stops_a_test_between_its_batches(tmp_path, stand, engine):
    (job,) = jobs(tmp_path, cell(), rollouts=25)
    stand.during_batch = lambda done: signal.raise_signal(signal.SIGINT) if done == 10 else None
    with pytest.raises(Stopped) as stopped:
        engine(job, lambda _: None)
    assert stopped.value.signal_number == signal.SIGINT
    assert read_history(job.path) == {"seconds": 120.0}
    assert not is_in_use(job.path)
    assert not is_over(job)
    stand.during_batch = lambda done: None
    engine(job, lambda _: None)
    assert is_over(job)


def test_a_signal_that_came_before_a_test_begins_none_and_one_in_its_last_batch_is_too_late(tmp_path, stand):
    first, second = jobs(tmp_path, cell(0), cell(1), rollouts=25)
    with signals_noted() as received:
        received.append(signal.SIGTERM)
        with pytest.raises(Stopped):
            execute(first, print)
    assert not stand.tests
    stand.during_batch = lambda done: signal.raise_signal(signal.SIGINT) if done == 25 else None
    assert execute(second, print).outcome == "complete"
    assert is_over(second)


def test_a_cell_that_is_tested_is_left_to_the_process_that_does(tmp_path, stand):
    (job,), others = jobs(tmp_path, cell(), rollouts=3), []
    stand.during_batch = lambda _: others.append(execute(job, print))
    assert execute(job, print).outcome == "complete"
    assert others == [Ended(job.cell.key, "elsewhere")]
    assert len(stand.tests) == 1


def test_what_another_process_has_tested_meanwhile_is_not_tested_again(tmp_path, stand, monkeypatch):
    (job,) = jobs(tmp_path, cell(), rollouts=1)

    @contextmanager
    def locked(run):
        write_rows(run.path / ROLLOUTS, COLUMNS["evaluations"], [EvaluationEpisode(0, 1.0, 9, None).row(0, 300)])
        yield

    monkeypatch.setattr(RunDirectory, "locked", locked)
    assert execute(job, print).outcome == "complete"
    assert is_over(job)
    assert not stand.tests


def test_a_policy_is_tested_again_where_more_episodes_are_wanted(tmp_path, stand):
    (job,) = jobs(tmp_path, cell(), rollouts=3)
    more, fewer = (replace(job, rollouts=count) for count in (5, 2))
    execute(job, print)
    assert [is_over(one) for one in (fewer, job, more)] == [True, True, False]
    for one in (fewer, more):
        assert execute(one, print).outcome == "complete"
    assert [test["episodes"] for test in stand.tests] == [3, 5]
    assert is_over(more)
    RunDirectory.open(job.path).append(
        "evaluations", [{"seed": 0, "step": 300, "episode": 0, "return": 1, "length": 9}]
    )
    collect(Store(tmp_path), job.cell, tmp_path / "out")
    results = Results(tmp_path / "out")
    assert results.status(job.cell, rollouts=5) == ("complete", 300, "", 140.0)
    assert results.status(job.cell, rollouts=6) is None


def test_a_table_of_tests_that_cannot_be_read_is_made_again(tmp_path, stand):
    (job,) = jobs(tmp_path, cell(), rollouts=3)
    execute(job, print)
    (job.path / ROLLOUTS).write_text("seed,step\n0\n")
    assert not is_over(job)
    execute(job, print)
    assert is_over(job)


def test_a_policy_is_tested_on_the_task_as_it_was_last(tmp_path, stand):
    (job,) = jobs(tmp_path, cell(perturbations=("friction=3@200", "gravity=0.5@50", "friction=2@100")), rollouts=1)
    execute(job, print)
    (test,) = stand.tests
    assert [str(one) for one in test["perturbations"]] == ["gravity=0.5", "friction=3"]


def test_the_time_of_a_run_that_was_removed_is_forgotten(tmp_path, stand):
    (job,) = jobs(tmp_path, cell())
    write_history(job.path, {"seconds": 500.0})
    execute(job, print)
    assert read_history(job.path) == {"seconds": 100.0}


def test_the_task_of_a_study_is_trusted_where_its_policies_are_tested(tmp_path, stand):
    (job,) = jobs(tmp_path, cell(), rollouts=1)
    execute(job, print)
    (test,) = stand.tests
    assert test["trust_task"] is True


def test_what_died_after_its_training_is_looked_at_again(tmp_path, stand):
    (job,) = jobs(tmp_path, cell(), keep_checkpoints=False)
    run = make_run(Store(tmp_path), job.cell, state="finished", steps_done=300)
    run.checkpoints.mkdir()
    write_history(job.path, {"seconds": 7.0, "failure": "its process was killed by SIGKILL"})
    assert Store(tmp_path).status(job.cell).state == "failed"
    assert not is_over(job)
    assert execute(job, print) == Ended(job.cell.key, "complete")
    assert Store(tmp_path).status(job.cell) == ("complete", 300, "", 7.0)
    assert is_over(job)
    assert not run.checkpoints.exists()


def test_what_learning_failed_at_is_not_tried_again_whatever_stands_beside_it(tmp_path):
    (job,) = jobs(tmp_path, cell())
    make_run(Store(tmp_path), job.cell, state="failed", failures={0: "step 40: NaN"})
    write_history(job.path, {"failure": "no task is called Hopper-v4"})
    assert is_over(job)


@pytest.mark.parametrize(
    ("manifest", "outcome"),
    [
        ({"state": "finished"}, ("complete", "")),
        ({"state": "failed", "failures": {0: "step 40: NaN"}}, ("failed", "step 40: NaN")),
    ],
)
def test_a_cell_that_is_over_by_now_is_left_as_it_is_and_needs_no_training(tmp_path, monkeypatch, manifest, outcome):
    (job,) = jobs(tmp_path, cell())
    make_run(Store(tmp_path), job.cell, **manifest)
    monkeypatch.setitem(sys.modules, "csac.training.train", None)
    assert execute(job, print) == Ended(job.cell.key, *outcome)
    assert not read_history(job.path)
