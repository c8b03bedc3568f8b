"""What the recorder makes of groups that fail: which steps become checkpoints, and what is told of each seed."""

from __future__ import annotations

import numpy as np
import pytest
from policies import contract, random_policy
from probes import Endless
from resuming import SMALL

from csac.algorithms import SAC
from csac.deploy.choosing import load
from csac.record.manifest import Manifest, Origin, differences
from csac.record.run import RunDirectory
from csac.training.checkpoint import Checkpoint, Checkpoints, steps_in
from csac.training.messages import (
    Ended,
    Evaluated,
    Failed,
    GroupCrashed,
    GroupRestarted,
    Progress,
    Refused,
    Rows,
    Saved,
)
from csac.training.recorder import Recorder
from csac.training.seed_files import SeedFiles
from csac.training.train import train
from csac.types import InputError, Ring, Snapshot


@pytest.fixture
def recorder(tmp_path):
    manifest = Manifest(task="t", algorithm="a", seeds=(0, 1), steps=900)
    run = RunDirectory.create(tmp_path / "run", manifest)
    return Recorder(run, [[0], [1]], None, (), Checkpoints(tmp_path / "run" / "checkpoint", 2))


def saves(recorder: Recorder, group: int, step: int) -> None:
    """Let a group make an episode 10 steps before `step`, reach it and save there."""
    episode = {"seed": group, "step": step - 10, "return": 1.0, "length": 5}
    recorder.handle(group, Rows("episodes", [episode]))
    place, ring = recorder.run.path / "checkpoint", Ring(np.zeros((9, 3), np.float32), step)
    recorder.handle(group, Saved(step, SeedFiles(place, group, {}).write(step, Snapshot({}, {}), ring), {}))


def rows_in(recorder: Recorder, step: int) -> list[int]:
    """The steps of the episodes that a checkpoint counts on."""
    content = Checkpoint.open(recorder.run.path / "checkpoint", step).read(f"step_{step}.episodes.csv")
    lines = content.decode().splitlines()[1:]
    return [int(line.split(",")[1]) for line in lines]


def test_a_checkpoint_counts_on_no_later_row_though_a_group_was_started_again(recorder):
    for group in (0, 1):
        saves(recorder, group, 300)
    saves(recorder, 1, 600)
    recorder.handle(1, Progress(750))
    recorder.handle(1, GroupRestarted("killed", 300))
    saves(recorder, 0, 600)
    assert steps_in(recorder.run.path / "checkpoint") == [300]  # else the one that group 1 begins with could go
    saves(recorder, 0, 900)
    saves(recorder, 1, 600)
    assert rows_in(recorder, 600) == [290, 290, 590, 590]
    saves(recorder, 1, 900)
    assert rows_in(recorder, 900) == [290, 290, 590, 590, 890, 890]


def test_the_last_checkpoint_comes_though_the_slower_group_crashed(recorder):
    for group in (0, 1):
        saves(recorder, group, 300)
    for step in (600, 900):
        saves(recorder, 0, step)
    recorder.handle(0, Ended(900, {}))
    recorder.handle(1, Progress(450))
    recorder.handle(1, GroupCrashed("killed", ""))
    place = recorder.run.path / "checkpoint"
    assert steps_in(place) == [300, 600, 900]  # 300 is pinned: seed 1 was still sound
    assert rows_in(recorder, 600) == [290, 290, 590]
    assert list(Checkpoint.open(place, 900).values["failures"]) == ["1"]


def test_the_last_checkpoint_comes_though_every_seed_of_the_slower_group_failed(recorder):
    for group in (0, 1):
        saves(recorder, group, 300)
    saves(recorder, 0, 600)
    recorder.handle(1, Failed(1, 450, "a reward is NaN", "", None))
    recorder.handle(1, Ended(450, {}))
    assert steps_in(recorder.run.path / "checkpoint") == [300, 600]


def test_a_checkpoint_waits_for_the_rows_of_a_group_whose_failure_is_told_before_them(recorder):
    saves(recorder, 0, 300)
    saves(recorder, 1, 300)
    recorder.handle(1, Failed(1, 450, "a reward is NaN", "", None))
    saves(recorder, 0, 600)
    assert steps_in(recorder.run.path / "checkpoint") == [300]
    recorder.handle(1, Rows("episodes", [{"seed": 1, "step": 440, "return": 1.0, "length": 5}]))
    recorder.handle(1, Ended(450, {}))
    assert steps_in(recorder.run.path / "checkpoint") == [300, 600]
    assert rows_in(recorder, 600) == [290, 290, 440, 590]


def test_the_checkpoint_before_a_failure_stays_though_it_became_whole_after_it(recorder):
    saves(recorder, 0, 300)
    recorder.handle(0, Failed(0, 350, "a reward is NaN", "", None))
    recorder.handle(0, Ended(350, {}))
    for step in (300, 600, 700, 800):
        saves(recorder, 1, step)
    place = recorder.run.path / "checkpoint"
    assert steps_in(place) == [300, 700, 800]
    assert "step_300.seed_0.safetensors" in Checkpoint.open(place, 300).files


def test_a_step_by_which_every_seed_had_failed_is_no_checkpoint(recorder):
    for group in (0, 1):
        saves(recorder, group, 300)
    saves(recorder, 0, 600)
    recorder.handle(0, GroupCrashed("killed", ""))
    recorder.handle(1, Progress(450))
    recorder.handle(1, GroupCrashed("killed", ""))
    assert steps_in(recorder.run.path / "checkpoint") == [300]


def test_a_crash_leaves_a_seed_that_had_failed_before_its_reason(recorder):
    recorder.handle(0, Failed(0, 130, "a reward is NaN", "", None))
    recorder.handle(0, Progress(450))
    recorder.handle(0, GroupCrashed("killed", ""))
    assert recorder.failures == {0: "step 130: a reward is NaN"}


def test_a_user_s_mistake_in_a_group_is_no_failure_of_its_seeds(recorder):
    with pytest.raises(InputError, match="made for another csac"):
        recorder.handle(0, Refused(InputError("made for another csac")))
    assert not recorder.failures


def test_a_group_that_merely_stopped_makes_no_checkpoint_whole(recorder):
    saves(recorder, 0, 300)
    recorder.handle(1, Ended(0, {}))
    assert not steps_in(recorder.run.path / "checkpoint")


def test_a_task_that_cannot_be_made_again_for_an_evaluation_costs_no_run(tmp_path):
    """As a simulator that runs once on a machine: what was learnt went with the run directory."""
    made = []

    def only_one() -> Endless:
        made.append(1)
        if len(made) > 2:  # one that is asked for its spaces, and one to learn in
            raise ConnectionError("port 5555 is taken")
        return Endless()

    with pytest.warns(RuntimeWarning, match="seed 0 of .* failed at step 50: its evaluation failed"):
        run = train(SAC(**SMALL), only_one, steps=50, evaluation_interval=50, directory=tmp_path / "run")
    assert run.manifest.state == "failed"
    assert "port 5555 is taken" in run.manifest.failures[0]
    assert (load(run.path, 0).step, len(run.rows("episodes"))) == (50, 5)


@pytest.mark.parametrize(
    ("changes", "is_other"),
    [
        ((), False),
        (("discount is 0.9, not 0.99",), False),
        (("task is 'A-v4', not 'B-v4'",), True),
        (("environment_arguments.g is 20.0, not 0.5",), True),  # returns that are none of this one's
    ],
)
def test_the_best_policy_of_another_task_gives_way_to_the_first_of_this(tmp_path, changes, is_other):
    evaluations = [{"seed": 0, "step": step, "episode": 0, "return": 900.0, "length": 9} for step in (50, 100)]
    origin = Origin("runs/one", 100, changes)
    manifest = Manifest(task="B-v4", algorithm="sac", seeds=(0,), steps=300, forked_from=origin)
    forked = RunDirectory.create(tmp_path / "run", manifest)
    forked.append("evaluations", evaluations)
    policy = random_policy(contract())
    policy.write(forked.policy(0, "best"))
    before = forked.policy(0, "best").read_bytes()
    recorder = Recorder(forked, [[0]], None, (), begin=100)
    row = {"seed": 0, "step": 150, "episode": 0, "return": 3.0, "length": 9}
    recorder.handle(0, Evaluated(150, [row], {0: random_policy(contract(), seed=5)}))
    assert (forked.policy(0, "best").read_bytes() != before) == is_other


def test_an_environment_argument_called_task_is_no_other_task():
    now, before = ({"task": "Reach-v1", "environment_arguments": {"task": word}} for word in ("push", "reach"))
    origin = Origin("runs/one", 100, tuple(differences(before, now)))
    assert (origin.changes, origin.has_other_task) == (("environment_arguments.task is 'reach', not 'push'",), False)
