"""What becomes of one cell, where nothing is trained and no policy is tested."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from shown import Clock
from studying import cell, jobs, make_run

from csac.evaluation.evaluator import EvaluationEpisode
from csac.record.run import RunDirectory, is_run
from csac.studies import job as module
from csac.studies.cells import Store, read_history
from csac.studies.job import Ended, Job, execute


class Stand:
    """Stands in for training, which takes 100 seconds where there is no finished run yet, and for tests of 20 each."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock, self.tests, self.interrupting = Clock(), list[dict[str, Any]](), False
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=self.clock))
        monkeypatch.setattr(module, "_train", self.train)
        monkeypatch.setattr("csac.evaluation.play.evaluate_run", self.evaluate)

    def train(self, job: Job, _: Any) -> RunDirectory:
        if is_run(job.path):
            return RunDirectory.open(job.path)
        self.clock.now += 100
        return make_run(Store(job.path.parents[2]), job.cell, state="finished", steps_done=300)

    def evaluate(self, _: Any, **options: Any) -> Any:
        self.clock.now += 20
        if self.interrupting:
            raise KeyboardInterrupt
        self.tests.append(options)
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
