"""A run that was stopped and taken up again is the run that was not, bit for bit; what cannot go on is refused."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import probes
import pytest
import trainer  # noqa: F401  (its cache of compiled programs)
from plans import settings
from resuming import ADAPTIVE, LEARNERS, ROLLOUT, Crash, contents, crash_at, run

from csac.algorithms import CSAC, PPO
from csac.console.progress import Reporter
from csac.deploy.contract import Contract
from csac.record.manifest import Machine, Manifest, Origin
from csac.record.run import RunDirectory, StorageFailure
from csac.training import messages
from csac.training.checkpoint import Checkpoint, Checkpoints, steps_in
from csac.training.group import Group
from csac.training.interruptions import Interrupted, StoppedAtOnce, signals_noted
from csac.training.learner import Learner
from csac.training.resume import Restart, Source
from csac.training.scheduler import run_groups
from csac.training.train import resume
from csac.types import InputError


def group(folder: Path, algorithm, seeds, steps: int, begin: int = 0, task: Any = "Hopper-v4") -> Group:
    return Group(settings(algorithm, task, steps, folder, begin, evaluation_interval=1000), seeds)


def advance(group: Group, until: int) -> list[messages.GroupMessage]:
    return [event for event in group.run(lambda: group.step == until) if not isinstance(event, messages.Ended)]


def everything(group: Group) -> list[np.ndarray]:
    """What a group has learnt, remembers and does next."""
    learner, seeds = group.learner, range(len(group.seeds))
    leaves = jax.tree.leaves([(learner.carry(index), learner.waiting(index)) for index in seeds])
    return [*leaves, group._actions, group._observations]


@pytest.mark.parametrize(
    "algorithm", [*LEARNERS, ADAPTIVE], ids=lambda learner: f"{learner.name}-{learner.cadence.update_interval}"
)
def test_a_group_goes_on_bit_for_bit(tmp_path, algorithm):
    check_that_a_group_goes_on(tmp_path, algorithm, (3,))


@pytest.mark.parametrize("algorithm", [LEARNERS[0], ADAPTIVE, ROLLOUT], ids=lambda algorithm: algorithm.name)
def test_a_group_of_two_goes_on_bit_for_bit(tmp_path, algorithm):
    check_that_a_group_goes_on(tmp_path, algorithm, (0, 4))


def check_that_a_group_goes_on(tmp_path: Path, algorithm, seeds: tuple[int, ...]) -> None:
    whole = group(tmp_path, algorithm, seeds, 400)
    advance(whole, 90)
    whole.save()  # transitions are written in two parts, and some of the first are overwritten in the ring of 150
    advance(whole, 230)
    checkpoints = Checkpoints(tmp_path, 2)
    checkpoints.commit(230, whole.save().files, {})
    after = advance(whole, 330)

    again = group(tmp_path, algorithm, seeds, 400, begin=230)
    assert advance(again, 330) == after
    for ours, theirs in zip(everything(again), everything(whole), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_weights_that_are_learnt_have_moved_when_they_are_saved(tmp_path):
    one = group(tmp_path, ADAPTIVE, (3,), 400)
    advance(one, 150)
    learnt = one.learner.carry(0).state.learnt_weights
    for weight, first in ((learnt.entropy, 1.0), (learnt.relative_entropy, 0.5)):
        assert abs(float(weight.log_weight) - np.log(first)) > 0.01


def test_a_grown_run_equals_one_that_was_long_from_the_start(tmp_path):
    """The replay of a short run is shorter; what was drawn from it does not depend on that."""
    algorithm = replace(LEARNERS[0], replay_size=1000)
    short = group(tmp_path, algorithm, (1,), 200)
    advance(short, 200)
    Checkpoints(tmp_path, 2).commit(200, short.save().files, {})
    grown, long = group(tmp_path, algorithm, (1,), 300, begin=200), group(tmp_path / "long", algorithm, (1,), 300)
    advance(grown, 299)
    advance(long, 299)
    for ours, theirs in zip(everything(grown), everything(long), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_seeds_may_be_grouped_otherwise(tmp_path):
    together = group(tmp_path, LEARNERS[0], (0, 4), 300)
    advance(together, 150)
    Checkpoints(tmp_path, 2).commit(150, together.save().files, {})
    alone = group(tmp_path, LEARNERS[0], (4,), 300, begin=150)
    advance(together, 170)
    advance(alone, 170)
    ours = jax.tree.leaves(alone.learner.carry(0).state)
    theirs = jax.tree.leaves(together.learner.carry(1).state)
    for our, their in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(our, their, rtol=1e-3, atol=1e-5)


# Whole runs.


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "run"
    run(path)
    return contents(path)


@pytest.fixture(scope="module")
def short_run(tmp_path_factory):
    """A finished run of 130 steps, to be copied."""
    return run(tmp_path_factory.mktemp("short") / "run", steps=130).path


@pytest.fixture
def finished(short_run, tmp_path):
    return Path(shutil.copytree(short_run, tmp_path / "run"))


def test_a_crashed_run_goes_on_and_leaves_the_same_files(tmp_path, uninterrupted):
    with pytest.raises(Crash):
        run(tmp_path / "run", on_evaluation=crash_at(300))
    assert len(contents(tmp_path / "run")["evaluations.csv"]) > 0
    for torn in (".manifest.json.4711", "policy/.seed_0.best.safetensors.4711"):  # without their names yet
        (tmp_path / "run" / torn).write_bytes(b"{")
    finished = resume(tmp_path / "run")
    assert contents(tmp_path / "run") == uninterrupted
    assert finished.manifest.state == "finished"
    (entry,) = finished.manifest.history
    assert (entry.step, entry.exact, entry.complaints) == (240, True, ())


def test_the_same_call_again_with_resume_goes_on(tmp_path, uninterrupted):
    for _ in range(2):
        with pytest.raises(Crash):
            run(tmp_path / "run", on_evaluation=crash_at(200), resume=True)
    run(tmp_path / "run", resume=True)
    assert contents(tmp_path / "run") == uninterrupted


def test_a_run_that_crashed_after_its_last_checkpoint_is_finished(tmp_path, uninterrupted, monkeypatch):
    def crash(*_: Any) -> None:
        raise Crash

    with monkeypatch.context() as patched:
        patched.setattr("csac.training.train._finish", crash)
        with pytest.raises(Crash):
            run(tmp_path / "run")
    assert steps_in(tmp_path / "run" / "checkpoint") == [480, 500]
    assert resume(tmp_path / "run").manifest.state == "finished"
    assert contents(tmp_path / "run") == uninterrupted
    assert (tmp_path / "run" / "curve.png").exists()


def test_a_signal_that_comes_too_late_stops_nothing(tmp_path, uninterrupted):
    def send(step: int, _: Any) -> None:
        if step == 500:
            os.kill(os.getpid(), signal.SIGTERM)

    assert run(tmp_path / "run", on_evaluation=send).manifest.state == "finished"
    assert contents(tmp_path / "run") == uninterrupted


def test_a_run_that_is_stopped_before_its_first_step_begins_anew_and_says_so(tmp_path, uninterrupted):
    with signals_noted() as received:
        received.append(signal.SIGINT)
        with pytest.raises(Interrupted, match=r"run has no checkpoint yet and will begin anew$") as stopped:
            run(tmp_path / "run")
    assert stopped.value.can_go_on
    assert resume(tmp_path / "run").manifest.history[0].step == 0
    assert contents(tmp_path / "run") == uninterrupted


@pytest.mark.parametrize(("interval", "can_go_on"), [(120, True), (0, False)])
def test_a_second_signal_leaves_a_run_as_sound_as_a_kill(tmp_path, uninterrupted, interval, can_go_on):
    def send_two(step: int, _: Any) -> None:
        if step == 300:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(StoppedAtOnce) as stopped:
        run(tmp_path / "run", on_evaluation=send_two, checkpoint_interval=interval)
    assert (stopped.value.args, stopped.value.run.path) == ((signal.SIGTERM,), tmp_path / "run")
    assert stopped.value.can_go_on == can_go_on
    if can_go_on:
        assert resume(tmp_path / "run").manifest.history[0].step == 240
        assert contents(tmp_path / "run") == uninterrupted


def test_a_second_signal_while_the_picture_is_drawn_loses_nothing(tmp_path, monkeypatch):
    def interrupt(_: RunDirectory) -> None:
        raise KeyboardInterrupt(signal.SIGINT)

    monkeypatch.setattr("csac.training.train._draw", interrupt)
    finished = run(tmp_path / "run", steps=130)
    assert (finished.manifest.state, finished.manifest.steps_done) == ("finished", 130)


def test_a_disk_that_is_full_before_the_first_step_leaves_the_terminal_as_it_was(tmp_path, monkeypatch):
    def make_logs(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    reporter, closed = Reporter(), []
    monkeypatch.setattr("csac.training.train._logs", make_logs)
    monkeypatch.setattr(reporter, "close", lambda: closed.append(True))
    with pytest.raises(StorageFailure, match="No space left"):
        run(tmp_path / "run", steps=130, reporter=reporter)
    assert closed == [True]


def test_a_run_that_crashed_before_its_first_checkpoint_begins_anew(tmp_path, uninterrupted):
    with pytest.raises(Crash):
        run(tmp_path / "run", on_evaluation=crash_at(100))
    assert resume(tmp_path / "run").manifest.history[0].step == 0
    assert contents(tmp_path / "run") == uninterrupted


def test_results_without_a_checkpoint_are_not_thrown_away(tmp_path, finished):
    """Neither where the checkpoints were removed nor where there were to be none."""
    shutil.rmtree(finished / "checkpoint")
    run(tmp_path / "none", steps=130, checkpoint_interval=0)
    for path in (finished, tmp_path / "none"):
        before = contents(path)
        with pytest.raises(InputError, match="has results and no checkpoint to go on from"):
            resume(path, steps=200)
        assert contents(path) == before
        assert len(RunDirectory.open(path).rows("metrics"))


def test_more_steps_go_on_where_the_run_ended(tmp_path):
    run(tmp_path / "run", steps=300)
    before = (tmp_path / "run" / "evaluations.csv").read_bytes()
    resume(tmp_path / "run", steps=500)
    after = (tmp_path / "run" / "evaluations.csv").read_bytes()
    assert after.startswith(before)
    run(tmp_path / "long", steps=500)
    assert after == (tmp_path / "long" / "evaluations.csv").read_bytes()


def test_a_run_from_before_there_were_update_intervals_goes_on(tmp_path):
    older = run(tmp_path / "run", steps=120)
    hyperparameters = dict(older.manifest.hyperparameters)
    assert hyperparameters.pop("update_interval") == 1
    older.update_manifest(hyperparameters=hyperparameters)
    assert resume(tmp_path / "run", steps=130).manifest.steps_done == 130
    with pytest.raises(InputError, match="update_interval is 1, not 5"):
        run(tmp_path / "run", replace(LEARNERS[0], update_interval=5), steps=130, resume=True)


def test_a_finished_run_stays_as_it_is(tmp_path, finished):
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    resume(finished)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_an_episode_that_cannot_be_saved_is_said(tmp_path):
    with pytest.raises(Crash):
        run(tmp_path / "run", task="Pendulum-v1", on_evaluation=crash_at(300))
    finished = resume(tmp_path / "run")
    assert finished.manifest.inexact_seeds == (0,)
    assert not finished.manifest.history[0].exact


def test_an_episode_that_is_not_taken_back_is_said_and_the_run_goes_on(tmp_path):
    """It has a `get_snapshot` and no `set_snapshot`: every seed failed at once when the run went on."""
    task, arguments = "probes:Unsavable-v0", {"gives": "one way"}
    with pytest.raises(Crash):
        run(tmp_path / "run", LEARNERS[1], 300, task, environment_arguments=arguments, on_evaluation=crash_at(200))
    assert RunDirectory.open(tmp_path / "run").manifest.inexact_seeds == ()
    seen: list[Any] = []
    finished = resume(
        tmp_path / "run", on_evaluation=lambda *_: seen.append(RunDirectory.open(tmp_path / "run").manifest)
    )
    assert (finished.manifest.state, finished.manifest.failures) == ("finished", {})
    assert "restoring its snapshot raised" in (finished.path / "log.txt").read_text()
    assert seen[0].inexact_seeds == (0,)  # as long as that checkpoint is the newest
    assert finished.manifest.inexact_seeds == ()
    assert [entry.exact for entry in finished.manifest.history] == [False]


def test_a_rollout_ends_where_its_episode_was_broken_off(tmp_path):
    """Pendulum's state cannot be saved, so the second seed's next episode follows the checkpoint at once."""
    first = group(tmp_path, ROLLOUT, (0, 1), 400, task="Pendulum-v1")
    step = 2 * ROLLOUT.rollout_steps + 3
    advance(first, step)
    before = [first.learner.waiting(index).copy() for index in (0, 1)]
    assert not any(rows[:3, -1].any() for rows in before)
    Checkpoints(tmp_path, 2).commit(step, first.save().files, {})
    again = group(tmp_path, ROLLOUT, (0, 1), 400, begin=step, task="Pendulum-v1")
    for index, rows in enumerate(before):
        rows[2, -1] = 1.0  # truncated: no advantage is carried back from what follows
        np.testing.assert_array_equal(again.learner.waiting(index), rows)


def test_a_schedule_is_of_the_run_s_own_length(tmp_path):
    """A run that grew without a schedule was planned for fewer updates: one that falls to 0 would go on below it."""
    constant = replace(ROLLOUT, learning_rate_schedule="constant")
    run(tmp_path / "run", constant, steps=130)
    resume(tmp_path / "run", steps=260)
    scheduled = replace(ROLLOUT, learning_rate_schedule="linear")
    updates = 260 // ROLLOUT.rollout_steps
    with pytest.raises(InputError, match=f"its schedule is of {updates} updates and the checkpoint's of"):
        run(tmp_path / "fork", scheduled, steps=260, start_from=f"{tmp_path / 'run'}@240")


def test_a_failed_seed_stays_failed_and_the_others_go_on(tmp_path):
    task = "probes:Failing-v0"
    arguments = {"where": "step", "at": 130, "seeds": [probes_seed(0, episode) for episode in range(200)]}
    with pytest.raises(Crash):
        run(
            tmp_path / "run",
            task=task,
            seeds=2,
            environment_arguments=arguments,
            on_evaluation=crash_at(300),
        )
    with pytest.warns(RuntimeWarning, match=r"seed 0 of .*run failed at step 130: step raised"):
        finished = resume(tmp_path / "run")
    assert list(finished.manifest.failures) == [0]
    assert finished.manifest.failures[0].startswith("step 130: step raised")
    evaluations = finished.evaluations
    assert evaluations["step"][evaluations["seed"] == 1].max() == 500
    assert evaluations["step"][evaluations["seed"] == 0].max() == 100
    # The last checkpoint before the failure is kept, with the seed in it, beside the newest two.
    assert steps_in(finished.path / "checkpoint") == [120, 480, 500]
    assert Checkpoint.open(finished.path / "checkpoint", 120).seed(0).values["environment"]["alive"]


@pytest.mark.filterwarnings("ignore:seed . of .* failed:RuntimeWarning")
@pytest.mark.parametrize("has_files", [False, True])
def test_a_seed_that_had_failed_alone_is_left_out_of_another_grouping(tmp_path, has_files):
    """Its process had died for good: before the checkpoint, or at its very step, so that its files look alive."""
    run(tmp_path / "run", LEARNERS[1], 60, probes.Endless, seeds=2)
    fail(tmp_path / "run", 60, {"1": "step 50: killed"}, has_files)
    forked = run(tmp_path / "fork", LEARNERS[1], 90, probes.Endless, seeds=2, start_from=tmp_path / "run")
    finished = run(tmp_path / "run", LEARNERS[1], 90, probes.Endless, seeds=2, resume=True)
    for known in (finished, forked):
        assert (known.manifest.state, known.manifest.failures) == ("failed", {1: "step 50: killed"})
        last = known.evaluations[known.evaluations["step"] == 90]
        assert set(last["seed"]) == {0}


@pytest.mark.filterwarnings("ignore:seed . of .* failed:RuntimeWarning")
def test_a_run_of_which_every_seed_had_failed_ends_as_it_was(tmp_path):
    run(tmp_path / "run", LEARNERS[1], 60, probes.Endless, seeds=2)
    fail(tmp_path / "run", 60, {"0": "step 60: killed", "1": "step 50: killed"}, has_files=True)
    known = run(tmp_path / "run", LEARNERS[1], 90, probes.Endless, seeds=2, resume=True)
    assert (known.manifest.state, list(known.manifest.failures), known.manifest.steps_done) == ("failed", [0, 1], 60)


def fail(directory: Path, step: int, failures: dict[str, str], has_files: bool) -> None:
    """Let seeds have failed by a checkpoint, each of which had a process of its own."""
    saved = Checkpoint.open(directory / "checkpoint", step)
    files = {name: facts for name, facts in saved.files.items() if has_files or "seed_1." not in name}
    values = {**saved.values, "failures": failures, "groups": [[0], [1]]}
    Checkpoints(directory / "checkpoint", 2).commit(step, files, values)


def probes_seed(seed: int, episode: int) -> int:
    from csac.tasks.seeds import training_seed

    return training_seed(seed, episode)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"algorithm": replace(LEARNERS[0], discount=0.5)}, "discount is 0.99, not 0.5"),
        ({"algorithm": LEARNERS[1]}, "algorithm is 'csac', not 'sac'"),
        ({"task": "Walker2d-v4"}, "task is 'Hopper-v4', not 'Walker2d-v4'"),
        ({"seeds": 2}, r"seeds is \[0\], not \[0, 1\]"),
        ({"evaluation_interval": 50}, "evaluation.interval is 100, not 50"),
        ({"steps": 100}, "which 100 would shorten"),
    ],
)
def test_another_run_is_no_continuation(tmp_path, finished, change, message):
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=message):
        run(tmp_path / "run", **{"steps": 130, "resume": True, **change})
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_schedule_keeps_a_run_from_growing(tmp_path):
    scheduled = replace(ROLLOUT, learning_rate_schedule="linear")
    run(tmp_path / "run", scheduled, steps=130)
    with pytest.raises(InputError, match="a schedule"):
        resume(tmp_path / "run", steps=260)
    with pytest.raises(InputError, match="a schedule"):
        run(tmp_path / "fork", scheduled, steps=260, start_from=tmp_path / "run")


def test_two_processes_do_not_share_a_run(tmp_path, finished):
    opened = RunDirectory.open(tmp_path / "run")
    with opened.locked(), pytest.raises(InputError, match=r"in use by process \d+"):
        resume(tmp_path / "run", steps=260)


def test_what_another_process_did_before_the_run_was_locked_is_not_undone(tmp_path, finished, monkeypatch):
    """The manifest is read before the lock is taken, and was written back as it had been."""

    def meanwhile(*_: Any, **__: Any) -> str:
        RunDirectory.open(finished).update_manifest(steps=200, inexact_seeds=(0,))
        return ""

    monkeypatch.setattr("csac.training.train.memory_needed", meanwhile)
    with pytest.raises(InputError, match="a run of 200 steps, which 150 would shorten"):
        run(finished, steps=150, resume=True)
    found = RunDirectory.open(finished).manifest
    assert (found.steps, found.state, found.inexact_seeds) == (200, "finished", (0,))


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(tmp_path, uninterrupted):
    with pytest.raises(Crash):
        run(tmp_path / "run", on_evaluation=crash_at(400))
    folder = tmp_path / "run" / "checkpoint"
    assert steps_in(folder) == [240, 360]
    flip(folder / "step_360.seed_0.safetensors")
    entry = resume(tmp_path / "run").manifest.history[0]
    assert entry.step == 240
    assert "step_360.seed_0.safetensors has changed" in entry.complaints[0]
    assert contents(tmp_path / "run") == uninterrupted


def test_a_run_without_a_sound_checkpoint_is_refused_and_kept(tmp_path, finished):
    for path in (tmp_path / "run" / "checkpoint").glob("step_*.json"):
        path.write_text("{}")
    before = contents(tmp_path / "run")
    with pytest.raises(InputError, match=r"no checkpoint of .*run is sound \(.*\): restore one from a copy, or "):
        resume(tmp_path / "run", steps=260)
    assert contents(tmp_path / "run") == before


SPOILT: dict[str, Callable[[bytes], bytes]] = {
    "rows are removed": lambda content: content[: content.index(b"\n") + 1],
    "a digit is another": lambda content: content.replace(b"0,100,1,", b"0,100,1,9"),
    "lines come before it": lambda content: b"\n\n# mine\n" + content,
    "a spreadsheet saved it": lambda content: content.replace(b"\n", b"\r\n"),
    "it is no text": lambda content: b"\xff\xfe" + content,
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_a_table_that_was_changed_is_told_of_and_restored(tmp_path, finished, spoil):
    """The checkpoint has a copy: nothing that is false becomes part of the run, and nothing is lost."""
    path = finished / "evaluations.csv"
    before = path.read_bytes()
    path.write_bytes(spoil(before))
    assert path.read_bytes() != before
    (entry,) = resume(finished, steps=200).manifest.history
    assert entry.complaints == (f"{path} had changed since the checkpoint; it is restored",)
    assert entry.exact
    assert path.read_bytes().startswith(before)


def test_tables_that_are_gone_come_back(finished):
    before = {path: path.read_bytes() for path in finished.glob("*.csv")}
    for path in before:
        path.unlink()
    assert len(resume(finished, steps=200).manifest.history[0].complaints) == len(before) == 3
    assert all(path.read_bytes().startswith(content) for path, content in before.items())


def test_a_table_s_copy_that_is_damaged_is_not_needed(finished):
    (finished / "checkpoint" / "step_130.evaluations.csv").write_bytes(b"")
    (entry,) = resume(finished, steps=200).manifest.history
    assert (entry.step, entry.complaints) == (130, ())


def test_a_table_that_is_damaged_with_its_copy_costs_a_checkpoint_and_no_more(tmp_path, finished):
    for path in (finished / "evaluations.csv", finished / "checkpoint" / "step_130.evaluations.csv"):
        path.write_bytes(path.read_bytes()[:-2])
    (entry,) = resume(finished, steps=200).manifest.history
    assert entry.step == 120
    assert "step_130.evaluations.csv has" in entry.complaints[0]
    run(tmp_path / "whole", steps=200)
    assert (finished / "evaluations.csv").read_bytes() == (tmp_path / "whole" / "evaluations.csv").read_bytes()


@pytest.mark.parametrize("where", ["policy/seed_0.best.safetensors", "checkpoint/step_130.seed_0.best.safetensors"])
def test_a_best_policy_that_is_damaged_once_comes_back(finished, where):
    best = finished / "policy" / "seed_0.best.safetensors"
    before = best.read_bytes()
    flip(finished / where)
    (entry,) = resume(finished, steps=140).manifest.history
    assert (entry.step, entry.complaints) == (130, ())
    assert Checkpoint.open(finished / "checkpoint", 130).read("step_130.seed_0.best.safetensors") == before


def test_a_best_policy_that_is_lost_is_followed_by_the_best_of_later_evaluations(finished):
    """Learning does not need it. It had two names for one file before, so that one bad byte was in all."""
    best = finished / "policy" / "seed_0.best.safetensors"
    for path in [best, *finished.glob("checkpoint/*.best.safetensors")]:
        flip(path)
    resumed = resume(finished, steps=140)
    (entry,) = resumed.manifest.history
    assert entry.step == 130
    assert "seed_0.best.safetensors has changed" in entry.complaints[0]
    assert best.read_bytes() == (finished / "policy" / "seed_0.safetensors").read_bytes()  # evaluated once since


def test_transitions_that_are_damaged_in_one_place_are_mended(tmp_path, finished, uninterrupted):
    """Both checkpoints share them: there would be none to go on from."""
    shard = sorted(finished.glob("checkpoint/replay/*.safetensors"))[0]
    before = shard.read_bytes()
    shard.write_bytes(before[:1000] + bytes(4096) + before[5096:])
    (entry,) = resume(finished, steps=500).manifest.history
    assert (entry.step, entry.exact) == (130, True)
    assert entry.complaints == (f"{shard} was damaged in one place; it is mended from its parity",)
    assert contents(finished)["policy/seed_0.safetensors"] == uninterrupted["policy/seed_0.safetensors"]


def test_a_fork_of_damaged_transitions_has_them_mended_and_leaves_the_others_alone(tmp_path, finished):
    shard = sorted(finished.glob("checkpoint/replay/*.safetensors"))[0]
    before = shard.read_bytes()
    flip(shard)
    spoilt = shard.read_bytes()
    source = Source.find(finished)
    forked = RunDirectory.create(tmp_path / "fork", source.run.manifest)
    source.copy_to(forked, 2)
    assert (forked.path / "checkpoint" / "replay" / shard.name).read_bytes() == before
    assert shard.read_bytes() == spoilt
    Checkpoint.open(forked.path / "checkpoint", 130).verify()
    assert (forked.path / "episodes.csv").read_bytes() == (finished / "episodes.csv").read_bytes()


def flip(path: Path) -> None:
    """Flip a bit in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_checkpoints_are_kept_as_asked(tmp_path):
    run(tmp_path / "two")
    run(tmp_path / "all", keep_checkpoints=0)
    for name, steps in (("two", [480, 500]), ("all", [120, 240, 360, 480, 500])):
        folder = tmp_path / name / "checkpoint"
        assert steps_in(folder) == steps
        for step in steps:
            Checkpoint.open(folder, step).verify()
    # The ring of 150 transitions: what lies before step 330 is in no kept checkpoint of the first run.
    firsts = [int(path.name.split(".")[1].split("-")[1]) for path in (tmp_path / "two").glob("checkpoint/replay/*")]
    assert min(firsts) > 330


# Forks.


def test_a_fork_without_a_change_is_the_same_run(tmp_path, uninterrupted):
    run(tmp_path / "first", steps=500, keep_checkpoints=0)
    forked = run(tmp_path / "second", steps=500, start_from=f"{tmp_path / 'first'}@240")
    ours, theirs = contents(forked.path), uninterrupted
    assert {name: ours[name] for name in theirs} == theirs
    assert forked.manifest.forked_from == Origin(str(tmp_path / "first"), 240)


def test_a_run_goes_on_only_with_the_source_that_it_began_with(tmp_path, monkeypatch):
    """The same line may be repeated, from any folder; with another source it would be another run."""
    first = run(tmp_path / "first", steps=300, keep_checkpoints=0).path
    with monkeypatch.context() as patched:
        patched.chdir(tmp_path)
        forked = run(tmp_path / "second", steps=400, start_from="first@240").path
    before = contents(forked)
    for other in (f"{first}@120", tmp_path / "third", f"{tmp_path / 'third'}@240"):
        with pytest.raises(InputError, match=r"second goes on and began with .*first@240: leave .* out"):
            run(forked, steps=500, start_from=other, resume=True)
    with pytest.raises(InputError, match=r"first goes on and began with no other run: leave .* out"):
        run(first, steps=500, start_from=forked, resume=True)
    assert contents(forked) == before
    shutil.rmtree(first)
    assert run(forked, steps=410, start_from=f"{first}@240", resume=True).manifest.steps_done == 410


def test_a_fork_may_change_hyperparameters_and_says_so(tmp_path):
    run(tmp_path / "first", steps=300)
    changed = replace(LEARNERS[0], entropy_weight=0.9)
    forked = run(tmp_path / "second", changed, steps=400, start_from=tmp_path / "first")
    changes = ("entropy_weight is 0.2, not 0.9",)
    assert forked.manifest.forked_from == Origin(str(tmp_path / "first"), 300, changes)
    rows, before = forked.evaluations, RunDirectory.open(tmp_path / "first").evaluations
    np.testing.assert_array_equal(rows["return"][rows["step"] <= 300], before["return"])
    assert rows["step"].max() == 400


def test_a_fork_with_some_of_the_seeds_has_nothing_of_the_others(tmp_path):
    """The other one failed, and its rows would be in every mean."""
    fails = {"where": "step", "at": 130, "seeds": [probes_seed(0, episode) for episode in range(200)]}
    given: dict[str, Any] = {"task": "probes:Failing-v0", "environment_arguments": fails}
    with pytest.warns(RuntimeWarning, match="seed 0 of .* failed at step 130"):
        first = run(tmp_path / "first", steps=200, seeds=2, **given)
    forked = run(tmp_path / "second", steps=300, seeds=1, first_seed=1, start_from=first.path, **given)
    assert (forked.manifest.state, forked.manifest.failures) == ("finished", {})
    ours, theirs = forked.evaluations, first.evaluations
    np.testing.assert_array_equal(ours["return"][ours["step"] <= 200], theirs["return"][theirs["seed"] == 1])
    for name in ("evaluations.csv", "episodes.csv", "metrics.csv"):
        _, *lines = (forked.path / name).read_text().splitlines()
        assert {line.partition(",")[0] for line in lines} == {"1"}
    assert not list(forked.path.glob("**/*seed_0*"))
    assert resume(forked.path, steps=350).manifest.steps_done == 350
    with pytest.raises(InputError, match="every seed asked for had failed by step 200; begin with an earlier step"):
        run(tmp_path / "third", steps=300, seeds=1, start_from=first.path, **given)
    assert not (tmp_path / "third").exists()


@pytest.mark.parametrize(
    ("where", "change", "message"),
    [
        ("@100", {}, "no checkpoint of step 100; it has 120, 130"),
        ("@soon", {}, "'soon' is not a step"),
        ("@", {}, "'' is not a step; write DIRECTORY@STEP"),
        ("@10_", {}, "'10_' is not a step"),
        ("@1__0", {}, "'1__0' is not a step"),
        ("x", {}, "does not exist"),
        ("", {"algorithm": replace(LEARNERS[0], actor_hidden_sizes=(9, 9))}, r"actor.*is to be float32 \(11, 9\)"),
        ("", {"algorithm": LEARNERS[1]}, "algorithm is 'csac', not 'sac'"),
        ("", {"seeds": 2}, "has no seeds 1"),
        ("", {"task": "Walker2d-v4"}, r"is to be float32 \(17, 8\)"),
        ("", {"steps": 130}, "give more than the 130"),
    ],
)
def test_a_fork_that_does_not_fit_is_refused(tmp_path, short_run, where, change, message):
    with pytest.raises(InputError, match=message):
        run(tmp_path / "second", **{"steps": 400, "start_from": f"{short_run}{where}", **change})
    assert not (tmp_path / "second").exists()


@pytest.mark.parametrize("algorithm", [CSAC(), PPO()], ids=lambda algorithm: algorithm.name)
@pytest.mark.parametrize("before", [True, False])
def test_a_fork_that_would_see_observations_on_another_scale_is_refused(algorithm, before):
    """PPO's checkpoint has the statistics in any case; CSAC's had them, and they were left aside."""

    def of(normalises: bool) -> Manifest:
        changed = asdict(replace(algorithm, normalise_observations=normalises))
        return Manifest(task="Hopper-v4", algorithm=algorithm.name, hyperparameters=changed, seeds=(0,), steps=400)

    made: Any = SimpleNamespace(path="runs/one", manifest=of(before))
    checkpoint: Any = SimpleNamespace(step=100, values={"failures": {}})
    with pytest.raises(InputError, match="the other choice of normalise_observations"):
        Source(made, checkpoint).refuse_misfit(of(not before), False, {}, lambda _: None)


def test_a_replay_that_has_forgotten_transitions_cannot_become_larger(tmp_path):
    """It has no rows to put where the larger one would draw from: they were drawn as zeros."""
    run(tmp_path / "first", steps=200)
    with pytest.raises(InputError, match="its replay kept 150 transitions and no others, so replay_size cannot be 300"):
        run(tmp_path / "second", replace(LEARNERS[0], replay_size=300), steps=400, start_from=tmp_path / "first")
    assert not (tmp_path / "second").exists()


def test_a_fork_to_another_task_begins_its_episode_anew(tmp_path):
    """Of as many observations and actions, but another body: what was learnt goes on, the episode cannot."""
    run(tmp_path / "first", steps=130, task="HalfCheetah-v4")
    forked = run(tmp_path / "second", steps=200, task="Walker2d-v4", start_from=tmp_path / "first")
    assert (forked.manifest.state, forked.manifest.steps_done) == ("finished", 200)
    changes = ("task is 'HalfCheetah-v4', not 'Walker2d-v4'",)
    assert forked.manifest.forked_from == Origin(str(tmp_path / "first"), 130, changes)
    assert [entry.exact for entry in forked.manifest.history] == [False]
    assert Contract.load(forked.contract).task == "Walker2d-v4"
    # Its own first checkpoint still holds the other task's episode.
    again = run(tmp_path / "third", steps=150, task="Walker2d-v4", start_from=f"{tmp_path / 'second'}@130")
    assert again.manifest.forked_from == Origin(str(tmp_path / "second"), 130, changes)
    assert [entry.exact for entry in again.manifest.history] == [False]


def test_a_fork_says_where_it_is_not_what_its_source_would_have_gone_on_to_be(tmp_path):
    """Its own manifest, which is new, was asked what had changed, and which episodes cannot go on."""
    first = run(tmp_path / "first", LEARNERS[1], 90, probes.Endless, seeds=2)
    first.update_manifest(versions={**first.manifest.versions, "jax": "0.1"})
    forked = run(tmp_path / "second", LEARNERS[1], 100, probes.Endless, start_from=first.path, first_seed=1)
    (entry,) = forked.manifest.history
    assert (entry.exact, entry.previous["versions"]["jax"], entry.previous["groups"]) == (False, "0.1", [[0, 1]])


def fork_of(manifest: Manifest, **changes: Any) -> Manifest:
    made: Any = SimpleNamespace(path="runs/one", manifest=manifest)
    checkpoint: Any = SimpleNamespace(step=100, values={"failures": {"2": "step 50: it fell"}})
    return Source(made, checkpoint).begun(replace(manifest, inexact_seeds=(), **changes), {})


def test_a_continuation_is_exact_only_if_every_episode_goes_on():
    manifest = Manifest(task="Hopper-v4", algorithm="sac", seeds=(0, 1), steps=400)
    inexact = replace(manifest, inexact_seeds=(1,))
    restart = Restart(100, {}, [], [])
    assert restart.continuation(manifest, manifest).exact
    assert not restart.continuation(inexact, manifest).exact
    said = "note: seed 1 restarts the episode in progress, which the checkpoint could not hold"
    assert (said in restart.notes(inexact, manifest), said in restart.notes(manifest, manifest)) == (True, False)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"commit": "b"}, "the commit of csac was a and is b"),
        ({"versions": {"csac": "2", "python": "3.11.7"}}, "the version of csac was 1 and is 2"),
        ({"versions": {"csac": "1", "python": "3.12.0"}}, "the version of python was 3.11.7 and is 3.12.0"),
        ({"versions": {"csac": "1", "python": "3.11.7", "pybullet": "3"}}, "the version of pybullet was None and is 3"),
        ({"device": "gpu", "machine": Machine(gpu="GPU B")}, "the device was cpu and is GPU B"),
        (
            {"machine": Machine(xla_flags="--xla_a=1", matmul_precision="")},
            "the XLA_FLAGS was not set and is --xla_a=1",
        ),
        (
            {"machine": Machine(xla_flags="", matmul_precision="high")},
            "the precision of products was not set and is high",
        ),
    ],
)
def test_whatever_else_computes_is_noticed(change, said):
    versions = {"csac": "1", "python": "3.11.7"}
    machine = Machine(xla_flags="", matmul_precision="")
    before = Manifest(
        task="Hopper-v4", algorithm="sac", seeds=(0,), steps=400, machine=machine, versions=versions, commit="a"
    )
    now, restart = replace(before, **change), Restart(100, {}, [], [])
    entry = restart.continuation(before, now)
    assert (entry.exact, entry.previous["commit"]) == (False, "a")
    assert any(said in note for note in restart.notes(before, now))


def test_what_an_older_manifest_does_not_have_is_no_change():
    old = Manifest(task="Hopper-v4", algorithm="sac", seeds=(0,), steps=400)
    now = replace(old, machine=Machine(xla_flags="--xla_a=1", matmul_precision="high"))
    assert Restart(100, {}, [], []).continuation(old, now).exact


def test_another_model_of_gpu_is_another_device():
    plain = Manifest(task="Hopper-v4", algorithm="sac", seeds=(0,), steps=400)
    one, other = (replace(plain, machine=Machine(gpu=name), device="gpu") for name in ("GPU A", "GPU B"))
    assert Restart(100, {}, [], []).continuation(one, one).exact
    (_, said) = Restart(100, {}, [], []).notes(one, other)
    assert said == "note: not the same to the last bit from here on, because the device was GPU A and is GPU B"


def test_the_commit_of_a_run_is_the_one_that_it_goes_on_with(finished):
    run = RunDirectory.open(finished)
    ours = run.manifest.commit
    run.update_manifest(commit="0" * 40)
    (entry,) = resume(finished, steps=140).manifest.history
    assert (entry.exact, entry.previous["commit"]) == (False, "0" * 40)
    assert RunDirectory.open(finished).manifest.commit == ours


def test_a_fork_knows_which_of_its_seeds_begin_their_episode_anew():
    source = Manifest(task="Hopper-v4", algorithm="sac", seeds=(0, 1, 2), steps=400, inexact_seeds=(0, 1))
    assert fork_of(source).inexact_seeds == (0, 1)
    assert fork_of(source, seeds=(1, 2)).inexact_seeds == (1,)
    assert fork_of(replace(source, inexact_seeds=())).inexact_seeds == ()
    assert fork_of(replace(source, inexact_seeds=()), task="Walker2d-v4").inexact_seeds == (0, 1)


def test_where_no_checkpoints_are_wanted_none_is_made_after_one_either(tmp_path, short_run):
    forked = run(tmp_path / "second", steps=200, start_from=short_run, checkpoint_interval=0)
    assert forked.manifest.state == "finished"
    assert steps_in(forked.checkpoints) == [130]


def test_a_run_of_a_function_goes_on_through_train(tmp_path):
    with pytest.raises(Crash):
        run(tmp_path / "run", task=probes.Endless, on_evaluation=crash_at(200))
    with pytest.raises(InputError, match="a Python function"):
        resume(tmp_path / "run")
    assert run(tmp_path / "run", task=probes.Endless, resume=True).manifest.state == "finished"


def test_an_error_of_the_caller_s_own_function_is_theirs(tmp_path):
    """That a file of theirs is not there was told as: the run cannot be written."""

    def read(*_: Any) -> None:
        (tmp_path / "theirs" / "notes.txt").read_text()

    with pytest.raises(FileNotFoundError):
        run(tmp_path / "run", LEARNERS[1], 30, probes.Endless, on_evaluation=read)


def test_a_run_whose_arguments_are_not_as_json_has_them_goes_on_and_is_forked(tmp_path):
    """Tuples and NumPy's numbers come back as lists and plain numbers."""

    def given(directory: str, steps: int, **options: Any) -> RunDirectory:
        arguments = {"where": "step", "at": np.int64(1_000_000), "seeds": (1, 2)}
        return run(tmp_path / directory, LEARNERS[1], steps, probes.Failing, environment_arguments=arguments, **options)

    given("run", 30)
    assert given("run", 60, resume=True).manifest.steps_done == 60
    origin = given("fork", 90, start_from=tmp_path / "run").manifest.forked_from
    assert origin
    assert origin.changes == ()


def test_a_manifest_that_lacks_something_is_refused(tmp_path, finished):
    path = tmp_path / "run" / "manifest.json"
    fields = json.loads(path.read_text())
    del fields["evaluation"]
    path.write_text(json.dumps(fields))
    with pytest.raises(InputError, match="broken: 'evaluation' is missing"):
        resume(tmp_path / "run", steps=260)


def test_a_diverged_seed_names_its_first_bad_array_and_is_not_saved(tmp_path):
    wild = replace(LEARNERS[0], critic_learning_rate=1e30, actor_learning_rate=1e30)
    given = settings(wild, "Hopper-v4", 300, tmp_path / "checkpoint", evaluation_interval=1000, checkpoint_interval=50)
    told = [message for _, message in run_groups(given, [[0]], lambda: False)]
    (failed,) = [message for message in told if isinstance(message, messages.Failed)]
    assert "actor.layers.0.weight is not finite" in failed.reason
    assert 40 <= failed.step <= 50
    assert not [message for message in told if isinstance(message, messages.Saved) and message.step >= failed.step]


def test_what_a_stop_between_two_turns_saves_is_looked_at(tmp_path, monkeypatch):
    monkeypatch.setattr(Learner, "first_bad", lambda *_: "target_critics.layers.0.weight")
    given = settings(LEARNERS[1], "Pendulum-v1", 300, tmp_path / "checkpoint", checkpoint_interval=250)
    stops = iter([False] * 30 + [True])
    told = [message for _, message in run_groups(given, [[0]], lambda: next(stops))]
    (failed,) = [message for message in told if isinstance(message, messages.Failed)]
    assert (failed.step, failed.reason[:45]) == (30, "target_critics.layers.0.weight is not finite:")
    assert not [message for message in told if isinstance(message, messages.Saved)]
