"""W&B gets the curves of a run, and never ends it."""

import pytest
from manifests import manifest
from resuming import run as train

from csac import resume
from csac.record import wandb as module
from csac.record.recorder import Recorder
from csac.record.run import RunDirectory


@pytest.mark.slow
def test_each_run_is_one_in_wandb_and_goes_on_in_its_project(tmp_path, monkeypatch):
    pytest.importorskip("wandb").teardown()
    monkeypatch.setenv("WANDB_MODE", "offline")
    runs = train(tmp_path / "runs", steps=120, wandb="arms")
    resume(runs.path, steps=240)
    pytest.importorskip("wandb").teardown()
    folder = runs.runs[0].path / "wandb"
    first, second = (path.read_bytes() for path in sorted(folder.glob("offline-run-*/*.wandb")))
    for content in (first, second):
        assert b"eval/mean_reward" in content
        assert b"rollout/ep_rew_mean" in content
        assert b"arms" in content
    assert "W&B" not in (runs.runs[0].path / "log.txt").read_text()


class Broken:
    """A W&B run whose second call fails."""

    calls = 0

    def __init__(self, run, project):
        """Begin."""

    def write(self, points):
        Broken.calls += 1
        if Broken.calls == 2:
            raise OSError("no more room")

    def close(self):
        """End."""


def test_what_fails_in_wandb_ends_no_run(tmp_path, monkeypatch):
    monkeypatch.setattr("csac.record.recorder.WandbLog", Broken)
    run = RunDirectory.create(tmp_path / "run", manifest())
    recorder = Recorder(run, 0, tensorboard=False, wandb=True)
    for step in (10, 20, 30):
        recorder.add("episodes", [{"seed": 0, "step": step, "return": 1.0, "length": 5}])
        recorder.flush()
    recorder.close()
    assert len(run.rows("episodes")) == 3
    assert Broken.calls == 2
    assert "W&B gets no more of seed 0: OSError: no more room" in (run.path / "log.txt").read_text()


def test_a_wandb_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "wandb", None)
    with pytest.raises(module.InputError, match="W&B"):
        module.import_wandb()
