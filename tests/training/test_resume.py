"""A resumed run equals one that was never stopped; a resume with other settings is refused."""

from __future__ import annotations

import errno
import re
import shutil
import signal
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gymnasium.envs.mujoco.hopper_v4 import HopperEnv
from gymnasium.spaces import Box
from probes import Endless, Probe
from resuming import ADAPTIVE, LEARNERS, SMALL, Crash, contents, crash_at, run, run_with_copies

import csac
from csac import InputError
from csac.algorithms import SAC
from csac.record.config import EVALUATION_SEED
from csac.record.files import temporary_path
from csac.record.run import RunDirectory
from csac.record.sets import find_sets
from csac.training import checkpoint, evaluations
from csac.training.checkpoint import Writer, newest_sound, steps_in, write_folder
from csac.training.resume import roll_back
from csac.training.signals import Interrupted

CHANGES = ("friction=1.5@150", "action_noise=0.05@210", "observation_noise=0.01@330")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run that was never stopped, with all its checkpoints, and copies of what a kill would have left."""
    return run_with_copies(tmp_path_factory.mktemp("made") / "run", 100, 400, keep_checkpoints=0)


@pytest.fixture(scope="module")
def whole(made):
    """What that run has, by name."""
    return contents(made.runs[0])


@pytest.fixture
def finished(tmp_path, made):
    """A copy of that run."""
    return RunDirectory.open(shutil.copytree(made.path, tmp_path / "finished") / "seed-0")


@pytest.fixture
def stopped(tmp_path, made):
    """A copy of what it had at step 400, with checkpoints at 120, 240 and 360."""
    return RunDirectory.open(shutil.copytree(f"{made.path}-400", tmp_path / "run") / "seed-0")


# PPO: test_environments.py; the CSAC and SAC of every default: below, and test_environments.py.
@pytest.mark.parametrize("algorithm", [LEARNERS[2], LEARNERS[3], LEARNERS[5], ADAPTIVE], ids=lambda a: a.name)
def test_a_resumed_run_equals_one_that_was_never_stopped(tmp_path, algorithm):
    whole = run_with_copies(tmp_path / "run", 300, algorithm=algorithm, steps=400)
    again = csac.resume(tmp_path / "run-300").runs[0]
    assert contents(again) == contents(whole.runs[0])
    assert again.manifest.history[-1].step == 240
    assert again.manifest.history[-1].exact


def test_seeds_that_share_a_program_are_resumed_together_and_a_copy_of_one_alone(tmp_path):
    settings: dict[str, Any] = {"perturbations": CHANGES, "seeds": 2, "seeds_per_process": 2, "steps": 400}
    with pytest.raises(Crash):
        run(tmp_path / "again", on_evaluation=crash_at(300), **settings)
    again = run(tmp_path / "again", resume=True, **settings)
    whole = run(tmp_path / "whole", **settings)
    before = [contents(one) for one in whole.runs]
    assert [contents(one) for one in again.runs] == before
    shutil.copytree(tmp_path / "whole" / "seed-1", tmp_path / "elsewhere")
    alone = csac.resume(tmp_path / "elsewhere", steps=420)
    assert alone.seeds == [1]
    assert alone.runs[0].manifest.steps_done == 420
    assert [contents(one) for one in whole.runs] == before


def test_a_run_killed_before_its_first_checkpoint_starts_over(tmp_path, made, whole):
    shutil.copytree(f"{made.path}-100", tmp_path / "run")
    assert steps_in(RunDirectory.open(tmp_path / "run" / "seed-0").checkpoints) == []
    assert contents(csac.resume(tmp_path / "run").runs[0]) == whole


def test_a_finished_run_is_extended_and_equals_a_longer_one(tmp_path, whole):
    run(tmp_path / "run", steps=300)
    longer = csac.resume(tmp_path / "run", steps=500)
    assert longer.runs[0].manifest.steps_done == 500
    for table in ("evaluations.csv", "episodes.csv"):
        assert contents(longer.runs[0])[table] == whole[table]


def test_a_run_that_lacks_a_new_hyperparameter_resumes_with_its_default(finished):
    config = finished.config
    older = {name: value for name, value in config.hyperparameters.items() if name != "normalise_rewards"}
    with finished.locked():
        finished.update_manifest(config=replace(config, hyperparameters=older))
    assert run(finished.path.parent, steps=510, resume=True, keep_checkpoints=0).steps_done == 510


def test_a_resume_with_other_action_bounds_is_refused(tmp_path, monkeypatch):
    given = {"task": "probes:Endless-v0"}
    run(tmp_path / "run", steps=100, **given)
    monkeypatch.setattr(Endless, "action_space", Box(-5.0, 5.0, (1,), np.float32))
    with pytest.raises(InputError, match="action bounds"):
        run(tmp_path / "run", steps=200, resume=True, **given)


def test_lost_evaluations_of_a_finished_run_are_restored(finished, whole):
    finished.table("evaluations").unlink()
    assert contents(run(finished.path.parent, resume=True).runs[0]) == whole


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
def test_a_resume_with_other_settings_is_refused(finished, whole, changes, name):
    with pytest.raises(InputError, match=name):
        run(finished.path.parent, resume=True, **changes)
    assert contents(finished) == whole


def test_a_refused_resume_does_not_lengthen_the_run(finished):
    with pytest.raises(InputError, match="environment_processes"):
        csac.resume(finished.path, steps=600, environment_processes=3)
    assert RunDirectory.open(finished.path).config.steps == 500


def test_a_resume_removes_half_written_files_and_no_others(stopped):
    half_written, own = temporary_path(stopped.path / "metrics.csv"), stopped.path / ".log.txt.swp"
    half_written.touch()
    own.touch()
    roll_back([stopped])
    assert (half_written.exists(), own.exists()) == (False, True)


def test_a_checkpoint_that_cannot_be_written_again_stays(stopped, monkeypatch):
    def full(path, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint, "write_atomically", full)
    with pytest.raises(OSError, match="No space"):
        write_folder(stopped.checkpoints / "step_360", {"state.safetensors": b""})
    sound, complaints = newest_sound(stopped.checkpoints)
    assert sound
    assert (sound.step, complaints) == (360, [])


def test_an_interrupt_breaks_off_a_long_evaluation_and_the_resume_repeats_it(tmp_path, monkeypatch, whole):
    reset, begun = HopperEnv.reset, []

    def interrupting(self, *, seed=None, options=None):
        begun.extend([seed] * (seed == EVALUATION_SEED))
        if seed == EVALUATION_SEED and len(begun) in (2, 6):  # at step 200, and the last, after 200 again, 300 and 400
            signal.raise_signal(signal.SIGINT)
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(evaluations, "SECONDS_TO_FINISH", 0.0)
    monkeypatch.setattr(HopperEnv, "reset", interrupting)
    for step in (200, 500):
        with pytest.raises(Interrupted):
            run(tmp_path / "run", resume=True)
        stopped = RunDirectory.open(tmp_path / "run" / "seed-0")
        assert (stopped.manifest.steps_done, stopped.evaluations["step"].max()) == (step, step - 100)
    assert contents(run(tmp_path / "run", resume=True).runs[0]) == whole


def test_an_evaluation_that_cannot_be_repeated_makes_a_resume_inexact(tmp_path, monkeypatch):
    """In the training environment an evaluation comes after its step, once the episode has ended."""
    reset, begun = HopperEnv.reset, []

    def interrupting(self, *, seed=None, options=None):
        begun.extend([seed] * (seed == EVALUATION_SEED))
        if seed == EVALUATION_SEED and len(begun) == 1:
            signal.raise_signal(signal.SIGINT)
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(evaluations, "SECONDS_TO_FINISH", 0.0)
    monkeypatch.setattr(HopperEnv, "reset", interrupting)
    with pytest.raises(Interrupted):
        run(tmp_path / "run", evaluation_environments=0, steps=300)
    entry = run(tmp_path / "run", evaluation_environments=0, steps=300, resume=True).runs[0].manifest.history[-1]
    assert (entry.exact, "step 100 was broken off" in entry.notes[-1]) == (False, True)


def test_the_best_policy_of_a_fork_that_is_not_better_can_be_loaded(tmp_path, stopped):
    run(tmp_path / "fork", start_from=f"{stopped.path}@240", steps=245, evaluation_interval=0)
    assert csac.load(tmp_path / "fork", which="best").step in (100, 200)


def test_a_kill_between_the_checkpoints_of_two_seeds_leaves_them_a_common_one(tmp_path, monkeypatch):
    together: dict[str, Any] = {"steps": 150, "seeds": 2, "seeds_per_process": 2, "keep_checkpoints": 1}
    write = Writer.write

    def dying(self, step, *rest):
        if step == 100 and "seed-1" in str(self.folder):
            raise Crash
        write(self, step, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(Writer, "write", dying)
        with pytest.raises(Crash):
            run(tmp_path / "set", checkpoint_interval=50, **together)
    resumed = run(tmp_path / "set", checkpoint_interval=50, resume=True, **together)
    assert [one.manifest.history[-1].step for one in resumed.runs] == [50, 50]


def sized(observations: int, actions: int) -> type[Probe]:
    class Growing(Probe):
        observation_space = Box(-1.0, 1.0, (observations,), np.float32)
        action_space = Box(-1.0, 1.0, (actions,), np.float32)

        def first_observation(self):
            return np.zeros(observations, np.float32)

    return Growing


def test_a_resume_of_a_task_whose_sizes_have_changed_names_them(tmp_path):
    run(tmp_path / "run", steps=30, task=sized(1, 1))
    for sizes in ((2, 1), (1, 2)):
        with pytest.raises(InputError, match=re.escape(f"were (1, 1) and are {sizes} now")):
            run(tmp_path / "run", steps=60, task=sized(*sizes), resume=True)


def test_a_run_with_a_learning_rate_schedule_is_neither_extended_nor_forked_without(tmp_path):
    scheduled = SAC(**{**SMALL, "warmup_steps": 10}, learning_rate_schedule="cosine")
    run(tmp_path / "run", scheduled, steps=30, checkpoint_interval=20)
    with pytest.raises(InputError, match="schedule that ends there"):
        csac.resume(tmp_path / "run", steps=60)
    with pytest.raises(InputError, match="its schedule is of"):
        run(tmp_path / "fork", replace(scheduled, updates_per_step=2.0), steps=30, start_from=f"{tmp_path}/run@20")
    for changes in (
        {"learning_rate_schedule": "constant"},
        {"normalise_rewards": True},
        {"critic_normalisation": "batch"},
    ):
        learnt_with = next(f"{name} {getattr(scheduled, name)}" for name in changes)
        with pytest.raises(InputError, match=f"learnt with {learnt_with}"):
            run(tmp_path / "fork", replace(scheduled, **changes), steps=60, start_from=tmp_path / "run")


def damage(path, kind: str) -> None:
    content = path.read_bytes()
    if kind == "missing":
        path.unlink()
    else:
        path.write_bytes(content[: len(content) // 2] if kind == "cut" else content[:-9] + b"x" + content[-8:])


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("checkpoint/step_360/state.safetensors", "missing"),
        ("checkpoint/step_360/state.safetensors", "changed"),
        ("checkpoint/step_360/checkpoint.json", "cut"),
    ],
)
def test_a_damaged_file_costs_at_most_the_work_since_the_checkpoint_before(tmp_path, stopped, whole, name, kind):
    damage(stopped.path / name, kind)
    again = csac.resume(tmp_path / "run").runs[0]
    assert again.manifest.history[-1].step == 240
    assert contents(again) == whole


def test_a_damaged_table_is_shown_and_restored_from_the_checkpoint(tmp_path, stopped, whole):
    damage(stopped.table("evaluations"), "changed")
    with pytest.warns(UserWarning, match=r"evaluations\.csv is damaged"):
        again = csac.resume(tmp_path / "run").runs[0]
    assert again.manifest.history[-1].step == 360
    assert contents(again) == whole


def test_a_table_that_lost_rows_is_restored_from_the_checkpoint(tmp_path, stopped, whole):
    for table, kind in (("evaluations", "missing"), ("episodes", "cut")):
        damage(stopped.table(table), kind)
    assert contents(csac.resume(tmp_path / "run").runs[0]) == whole


def test_a_lost_manifest_is_taken_from_the_newest_checkpoint(tmp_path, stopped, whole):
    shutil.copytree(stopped.checkpoints / "step_360", stopped.checkpoints / "step_360.bak")
    for kind in ("cut", "missing"):
        damage(stopped.path / "manifest.json", kind)
        with pytest.warns(UserWarning, match=r"manifest\.json is lost or damaged"):
            assert [runs.path for runs in find_sets(tmp_path)] == [tmp_path / "run"]
    with pytest.warns(UserWarning, match=r"manifest\.json is lost or damaged"):
        again = csac.resume(tmp_path / "run")
    assert contents(again.runs[0])["evaluations.csv"] == whole["evaluations.csv"]
    assert (stopped.checkpoints / "step_360.bak").exists()


def test_lost_transitions_are_replaced_by_others_with_a_warning(tmp_path, stopped):
    shard = sorted((stopped.checkpoints / "replay").glob("*.safetensors"))[-1]
    damage(shard, "cut")
    stopped.update_manifest(command="csac train it")
    again = csac.resume(tmp_path / "run").runs[0]
    assert again.manifest.state == "finished"
    assert "transitions are lost" in (again.path / "log.txt").read_text()
    entry = again.manifest.history[-1]
    assert (entry.exact, "transitions are lost" in entry.notes[-1]) == (False, True)
    assert (again.manifest.command, entry.command) == ("csac train it", None)


def test_a_smaller_memory_misses_no_older_transitions(stopped):
    """A fork may have one; those that it would have overwritten may be lost."""
    checkpoint, _ = newest_sound(stopped.checkpoints)
    assert checkpoint is not None
    (_, last), width = checkpoint.transitions, checkpoint.state().arrays["learner.waiting"].shape[-1]
    whole, small = np.zeros((last, width), np.float32), np.zeros((20, width), np.float32)
    assert checkpoint.fill(whole) == []
    damage(min(stopped.checkpoints.glob("replay/120-*.safetensors")), "missing")
    assert checkpoint.fill(small) == []
    np.testing.assert_array_equal(small[np.arange(last - 20, last) % 20], whole[-20:])


def test_a_run_without_a_sound_checkpoint_is_refused_and_unchanged(stopped, finished, whole):
    before = contents(stopped)
    for state in stopped.checkpoints.glob("step_*/state.safetensors"):
        damage(state, "cut")
    with pytest.raises(InputError, match="sound"):
        csac.resume(stopped.path)
    assert contents(stopped) == before
    manifest = (finished.path / "manifest.json").read_bytes()
    shutil.rmtree(finished.checkpoints)
    with pytest.raises(InputError, match="no checkpoint to go on from"):
        csac.resume(finished.path, steps=600)
    assert contents(finished) == whole
    assert (finished.path / "manifest.json").read_bytes() == manifest


def test_a_fork_starts_with_the_checkpoint_and_leaves_its_source_unchanged(tmp_path, made, whole):
    fork = run(tmp_path / "fork", start_from=f"{made.path}@360")
    assert contents(fork.runs[0]) == whole == contents(made.runs[0])
    origin = fork.runs[0].manifest.forked_from
    assert origin
    assert (origin.step, origin.changes) == (360, ())


def test_returns_on_the_task_before_are_in_no_number_of_a_fork(tmp_path, made):
    fork = run(tmp_path / "fork", task="Hopper-v5", start_from=f"{made.path}@360").runs[0]
    assert 0 < fork.rows("evaluations")["step"].min() < 360 < fork.evaluations["step"].min()
    other: dict[str, Any] = {"task": "Hopper-v5", "steps": 600, "start_from": fork.path}
    again = run(tmp_path / "again", replace(LEARNERS[0], discount=0.9), **other).runs[0]
    assert again.evaluations["step"].min() == fork.evaluations["step"].min()


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"algorithm": SAC(**SMALL)}, "algorithm"),
        ({"algorithm": replace(LEARNERS[0], policy_delay=2)}, "policy_delay is 1, not 2"),
        ({"steps": 300}, "steps"),
        ({"first_seed": 7}, "seed 7"),
        ({"start_from": "@17"}, "step 17"),
        ({"environments": 4}, "environments is 1, not 4"),
        ({"perturbations": "friction=2@359"}, "friction=2@359 lies before step 360"),
    ],
)
def test_a_fork_that_does_not_fit_is_refused_and_leaves_nothing(tmp_path, made, changes, name):
    given = {"start_from": "@360", **changes}
    with pytest.raises(InputError, match=name):
        run(tmp_path / "fork", **{**given, "start_from": f"{made.path}{given['start_from']}"})
    assert not (tmp_path / "fork").exists()
