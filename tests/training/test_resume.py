"""A run that was stopped goes on as if it had not been; what would be another run is refused."""

from __future__ import annotations

import re
import shutil
import signal
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gymnasium.envs.mujoco.hopper_v4 import HopperEnv
from gymnasium.spaces import Box
from probes import Probe
from resuming import ADAPTIVE, LEARNERS, SMALL, Crash, contents, crash_at, run

import csac
from csac import InputError
from csac.algorithms import PPO, SAC
from csac.record.config import EVALUATION_SEED
from csac.record.run import RunDirectory
from csac.record.sets import find_sets
from csac.training import evaluations
from csac.training.checkpoint import steps_in
from csac.training.signals import Interrupted

CHANGES = ("friction=1.5@150", "action_noise=0.05@210", "observation_noise=0.01@330")


def resumed_after(directory: Any, step: int, **settings: Any) -> Any:
    """Crash after the evaluation at `step`, then resume to the end."""
    with pytest.raises(Crash):
        run(directory, on_evaluation=crash_at(step), **settings)
    return run(directory, resume=True, **settings)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What a run that never stopped has, by name."""
    return contents(run(tmp_path_factory.mktemp("whole") / "run").runs[0])


@pytest.mark.parametrize("algorithm", [*LEARNERS, ADAPTIVE], ids=lambda a: f"{a.name}-{a.cadence.update_interval}")
def test_a_resumed_run_equals_one_that_was_never_stopped(tmp_path, algorithm):
    whole = run(tmp_path / "whole", algorithm)
    again = resumed_after(tmp_path / "again", 300, algorithm=algorithm)
    assert contents(again.runs[0]) == contents(whole.runs[0])
    assert again.runs[0].manifest.history[-1].step == 240
    assert again.runs[0].manifest.history[-1].exact


def test_changes_of_the_task_and_seeds_that_share_a_program_are_resumed_too(tmp_path):
    settings: dict[str, Any] = {"perturbations": CHANGES, "seeds": 2, "seeds_per_process": 2}
    whole = run(tmp_path / "whole", **settings)
    again = resumed_after(tmp_path / "again", 300, **settings)
    assert [contents(one) for one in again.runs] == [contents(one) for one in whole.runs]


def test_a_run_that_crashed_before_its_first_checkpoint_begins_anew(tmp_path):
    whole = run(tmp_path / "whole", steps=200)
    again = resumed_after(tmp_path / "again", 100, steps=200)
    assert contents(again.runs[0]) == contents(whole.runs[0])


def test_a_finished_run_is_extended_and_equals_a_longer_one(tmp_path):
    run(tmp_path / "run", steps=300)
    longer = csac.resume(tmp_path / "run", steps=500)
    assert longer.runs[0].manifest.steps_done == 500
    whole = run(tmp_path / "whole", steps=500)
    for table in ("evaluations.csv", "episodes.csv"):
        assert contents(longer.runs[0])[table] == contents(whole.runs[0])[table]
    before, manifest = contents(whole.runs[0]), (whole.runs[0].path / "manifest.json").read_bytes()
    shutil.rmtree(whole.runs[0].checkpoints)
    with pytest.raises(InputError, match="no checkpoint to go on from"):
        csac.resume(tmp_path / "whole", steps=600)
    assert contents(whole.runs[0]) == before
    assert (whole.runs[0].path / "manifest.json").read_bytes() == manifest


def test_a_table_that_was_cut_is_read_from_the_checkpoint(tmp_path):
    one = run(tmp_path / "run", steps=300).runs[0]
    path, before = one.table("evaluations"), repr(one.evaluations.tolist())
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.warns(UserWarning, match=r"evaluations\.csv has changed"):
        assert repr(one.evaluations.tolist()) == before
    path.write_bytes(whole + whole.splitlines(keepends=True)[-1])  # nothing comes after the end
    with pytest.warns(UserWarning, match=r"evaluations\.csv has changed"):
        assert repr(one.evaluations.tolist()) == before
    copy = one.checkpoints / "step_300" / path.name
    copy.write_bytes(whole[:30])  # is damaged itself, and not believed
    path.write_bytes(whole)
    assert repr(one.evaluations.tolist()) == before


def test_a_run_or_a_copy_of_it_is_resumed_alone(tmp_path):
    whole = run(tmp_path / "set", steps=300, seeds=2, seeds_per_process=1)
    before = contents(whole.run(0))
    shutil.copytree(tmp_path / "set" / "seed-1", tmp_path / "elsewhere")
    alone = csac.resume(tmp_path / "elsewhere", steps=400)
    assert alone.seeds == [1]
    assert alone.runs[0].manifest.steps_done == 400
    assert contents(RunDirectory.open(tmp_path / "set" / "seed-0")) == before


def test_a_run_of_before_there_was_a_hyperparameter_goes_on_with_its_default(tmp_path):
    one = run(tmp_path / "run", steps=100).runs[0]
    config = one.config
    older = {name: value for name, value in config.hyperparameters.items() if name != "normalise_rewards"}
    with one.locked():
        one.update_manifest(config=replace(config, hyperparameters=older))
    assert run(tmp_path / "run", steps=200, resume=True).steps_done == 200


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"algorithm": SAC(**SMALL)}, "algorithm"),
        ({"algorithm": LEARNERS[0].__class__(**{**SMALL, "batch_size": 9})}, "batch_size"),
        ({"evaluation_episodes": 3}, "evaluation_episodes"),
        ({"perturbations": ("friction=2@100",)}, "perturbations"),
        ({"steps": 100}, "steps"),
    ],
)
def test_what_would_be_another_run_is_refused(tmp_path, changes, name):
    made = run(tmp_path / "run", steps=200)
    before = contents(made.runs[0])
    with pytest.raises(InputError, match=name):
        run(tmp_path / "run", resume=True, **{"steps": 200, **changes})
    assert contents(made.runs[0]) == before


@pytest.mark.parametrize("at", [2, 5], ids=["between", "last"])
def test_a_stop_breaks_off_a_long_evaluation_which_the_resume_makes(tmp_path, monkeypatch, whole, at):
    reset, begun = HopperEnv.reset, []

    def interrupting(self, *, seed=None, options=None):
        begun.extend([seed] * (seed == EVALUATION_SEED))
        if seed == EVALUATION_SEED and len(begun) == at:
            signal.raise_signal(signal.SIGINT)
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(evaluations, "SECONDS_TO_FINISH", 0.0)
    monkeypatch.setattr(HopperEnv, "reset", interrupting)
    with pytest.raises(Interrupted):
        run(tmp_path / "run")
    stopped = RunDirectory.open(tmp_path / "run" / "seed-0")
    assert (stopped.manifest.steps_done, stopped.evaluations["step"].max()) == (100 * at, 100 * (at - 1))
    resumed = run(tmp_path / "run", resume=True)
    assert contents(resumed.runs[0]) == whole


def sized(observations: int, actions: int) -> type[Probe]:
    class Growing(Probe):
        observation_space = Box(-1.0, 1.0, (observations,), np.float32)
        action_space = Box(-1.0, 1.0, (actions,), np.float32)

        def first_observation(self):
            return np.zeros(observations, np.float32)

    return Growing


@pytest.mark.parametrize("sizes", [(2, 1), (1, 2)], ids=["observations", "actions"])
def test_a_resume_of_a_task_whose_sizes_have_changed_names_them(tmp_path, sizes):
    run(tmp_path / "run", steps=100, task=sized(1, 1))
    with pytest.raises(InputError, match=re.escape(f"were (1, 1) and are {sizes} now")):
        run(tmp_path / "run", steps=200, task=sized(*sizes), resume=True)


@pytest.mark.parametrize(
    "scheduled",
    [
        PPO(rollout_steps=64, minibatches=4, epochs=1, hidden_sizes=(8, 8)),
        SAC(**SMALL, learning_rate_schedule="cosine"),
    ],
)
def test_a_run_with_a_learning_rate_schedule_is_neither_extended_nor_forked_without(tmp_path, scheduled):
    run(tmp_path / "run", scheduled, steps=128)
    with pytest.raises(InputError, match="schedule that ends there"):
        csac.resume(tmp_path / "run", steps=256)
    constant = replace(scheduled, learning_rate_schedule="constant")
    with pytest.raises(InputError, match=f"learnt with learning_rate_schedule {scheduled.learning_rate_schedule}"):
        run(tmp_path / "fork", constant, steps=256, start_from=tmp_path / "run")
    otherwise = replace(scheduled, normalise_rewards=not scheduled.normalise_rewards)
    with pytest.raises(InputError, match="learnt with normalise_rewards"):
        run(tmp_path / "fork", otherwise, steps=256, start_from=tmp_path / "run")


@pytest.fixture(scope="module")
def crashed(tmp_path_factory):
    """A run that crashed at step 400, with checkpoints at 240 and 360."""
    directory = tmp_path_factory.mktemp("crashed") / "run"
    with pytest.raises(Crash):
        run(directory, on_evaluation=crash_at(400))
    assert steps_in(RunDirectory.open(directory / "seed-0").checkpoints) == [240, 360]
    return directory


@pytest.fixture
def stopped(tmp_path, crashed):
    """A copy of it."""
    shutil.copytree(crashed, tmp_path / "run")
    return RunDirectory.open(tmp_path / "run" / "seed-0")


def damage(path, kind: str) -> None:
    content = path.read_bytes()
    if kind == "missing":
        path.unlink()
    else:
        path.write_bytes(content[: len(content) // 2] if kind == "cut" else content[:-9] + b"x" + content[-8:])


@pytest.mark.parametrize("kind", ["missing", "cut", "changed"])
@pytest.mark.parametrize(
    "name", ["checkpoint/step_360/state.safetensors", "checkpoint/step_360/checkpoint.json", "evaluations.csv"]
)
def test_a_damaged_file_costs_at_most_the_work_since_the_checkpoint_before(tmp_path, stopped, whole, name, kind):
    damage(stopped.path / name, kind)
    again = run(tmp_path / "run", resume=True)
    assert contents(again.runs[0]) == whole


@pytest.mark.parametrize("kind", ["missing", "cut"])
def test_a_lost_manifest_is_taken_from_the_newest_checkpoint(tmp_path, stopped, whole, kind):
    damage(stopped.path / "manifest.json", kind)
    with pytest.warns(UserWarning, match=r"manifest\.json is lost or damaged"):
        found = find_sets(tmp_path)
    assert [runs.path for runs in found] == [tmp_path / "run"]
    with pytest.warns(UserWarning, match=r"manifest\.json is lost or damaged"):
        again = csac.resume(tmp_path / "run")
    assert contents(again.runs[0])["evaluations.csv"] == whole["evaluations.csv"]


def test_lost_transitions_are_replaced_by_others_with_a_warning(tmp_path, stopped):
    shard = sorted((stopped.checkpoints / "replay").glob("*.safetensors"))[-1]
    damage(shard, "cut")
    again = run(tmp_path / "run", resume=True).runs[0]
    assert again.manifest.state == "finished"
    assert "transitions are lost" in (again.path / "log.txt").read_text()
    entry = again.manifest.history[-1]
    assert (entry.exact, "transitions are lost" in entry.notes[-1]) == (False, True)


def test_where_no_checkpoint_is_sound_nothing_is_touched(tmp_path, stopped):
    for step in (240, 360):
        damage(stopped.checkpoints / f"step_{step}" / "state.safetensors", "cut")
    before = contents(stopped)
    with pytest.raises(InputError, match="sound"):
        run(tmp_path / "run", resume=True)
    assert contents(stopped) == before


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A run with all its checkpoints."""
    return run(tmp_path_factory.mktemp("source") / "run", keep_checkpoints=0)


def test_a_fork_begins_with_the_checkpoint_and_leaves_its_source_alone(tmp_path, source):
    before = contents(source.runs[0])
    fork = run(tmp_path / "fork", start_from=f"{source.path}@360", steps=500, keep_checkpoints=0)
    assert contents(fork.runs[0]) == before == contents(source.runs[0])
    origin = fork.runs[0].manifest.forked_from
    assert origin
    assert (origin.step, origin.changes) == (360, ())


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"algorithm": SAC(**SMALL)}, "algorithm"),
        ({"algorithm": replace(LEARNERS[0], policy_delay=2)}, "policy_delay is 1, not 2"),
        ({"steps": 300}, "steps"),
        ({"first_seed": 7}, "seed 7"),
        ({"start_from": "@17"}, "step 17"),
    ],
)
def test_a_fork_that_does_not_fit_is_refused_and_leaves_nothing(tmp_path, source, changes, name):
    given = {"start_from": "@360", **changes}
    with pytest.raises(InputError, match=name):
        run(tmp_path / "fork", **{**given, "start_from": f"{source.path}{given['start_from']}"})
    assert not (tmp_path / "fork").exists()


@pytest.mark.parametrize("name", ["log.txt", "checkpoint", "tensorboard", ".lock"])
def test_a_link_in_a_strangers_run_is_not_followed(tmp_path, stopped, name):
    target = tmp_path / "mine"
    target.write_text("mine")
    place = stopped.path / name
    shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)
    place.symlink_to(target)
    with pytest.raises(InputError):
        csac.resume(stopped.path)
    assert target.read_text() == "mine"
