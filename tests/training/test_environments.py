"""A seed with several environments: what is remembered, how often it learns, and that it is resumed and shared out."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import probes
import pytest
from helped import Forking, end_forks
from resuming import ROLLOUT, SMALL, Crash, contents, crash_at, run_with_copies
from resuming import run as train
from test_memory import RolloutWatcher, Watcher, check_story
from trainer import run

from csac import InputError, resume
from csac.algorithms import PPO, SAC
from csac.seeds import training_seed
from csac.tasks import workers
from csac.tasks.vector import SeedEnvironments
from csac.types import Cadence

SEEDS = (4, 9)
FOUR: dict[str, Any] = {
    "algorithm": SAC(**SMALL),
    "environments": 4,
    "perturbations": ("friction=1.5@150", "observation_noise=0.01@330"),
    "keep_checkpoints": 0,
}


@pytest.mark.parametrize("processes", [0, 2])
def test_each_environment_has_episodes_of_its_own_and_learns_once_a_turn(processes):
    outcome = run(
        Watcher(warmup_steps=10), probes.IdEncoded, 72, SEEDS, environments=3, environment_processes=processes
    )
    for seed, rows, state in zip(SEEDS, outcome.memories, outcome.states, strict=True):
        for environment in range(3):
            check_story(rows[environment::3], seed, environment)
        actions = rows[:, 4].reshape(-1, 3)
        assert len(set(actions[:4].ravel().tolist())) == 12  # each explores for itself
        # Two updates for each step; the first six after step 12, and the next actions are of what they learnt.
        made = np.minimum(6 * np.arange(1, 21), 100)  # it counts no more than a hundred
        np.testing.assert_allclose(actions[4:], np.repeat(made[:, None], 3, axis=1) / 100, atol=1e-6)
        np.testing.assert_array_equal(state.times, np.ones(100))


def test_a_rollout_holds_the_steps_of_a_turn_beside_each_other():
    watcher = RolloutWatcher(warmup_steps=0, updates_per_interval=1, batch_size=48, update_interval=48)
    outcome = run(watcher, probes.IdEncoded, 48, (4,), environments=2)
    rows = outcome.memories[0]
    for environment in range(2):
        check_story(rows[environment::2], 4, environment)
    np.testing.assert_array_equal(outcome.states[0].drawn[0], rows[:, :4])
    assert len(set(rows[:, 4].tolist())) == 48


@pytest.mark.parametrize(
    ("updates_per_step", "environments", "expected"),
    [
        *[(1, 1, (1, 1)), (1, 4, (4, 4)), (0.25, 1, (4, 1)), (0.25, 4, (4, 1)), (0.25, 3, (12, 3)), (2, 3, (3, 6))],
        (0.33, 8, (200, 66)),
    ],
)
def test_the_ratio_of_updates_to_steps_is_kept_whatever_the_number_of_environments(
    updates_per_step, environments, expected
):
    cadence = SAC(updates_per_step=updates_per_step).cadence.side_by_side(environments)
    assert (cadence.update_interval, cadence.updates_per_interval) == expected
    assert cadence.first_update == -(-10_000 // expected[0]) * expected[0]
    assert Cadence(0, 10, 5, 8).side_by_side(4)[1:3] == (12, 6)  # rounded up to whole turns
    assert SAC(updates_per_step=0.25, update_interval=50).cadence[1:3] == (52, 13)  # and to whole updates


def test_a_resumed_ppo_run_equals_one_that_was_never_stopped(tmp_path):
    whole = run_with_copies(tmp_path / "whole", 300, **{**FOUR, "algorithm": ROLLOUT})
    again = resume(tmp_path / "whole-300")
    assert contents(again.runs[0]) == contents(whole.runs[0])
    assert again.runs[0].manifest.history[-1].step == 240
    assert again.runs[0].manifest.history[-1].exact


def test_processes_change_no_number_and_their_episodes_are_resumed(tmp_path):
    whole = train(tmp_path / "whole", **FOUR)
    with pytest.raises(Crash):
        train(tmp_path / "there", on_evaluation=crash_at(300), environment_processes=2, **FOUR)
    there = train(tmp_path / "there", resume=True, environment_processes=2, **FOUR)
    assert contents(there.runs[0]) == contents(whole.runs[0])
    assert there.runs[0].manifest.history[-1].step == 240
    assert there.runs[0].manifest.history[-1].exact


@pytest.mark.parametrize("processes", [0, 2])
def test_a_seed_fails_once_where_one_of_its_environments_does(processes):
    arguments = {"at": 2, "seeds": [training_seed(4, 0, 1)]}
    environments = SeedEnvironments(probes.Failing, arguments, SEEDS, 2, processes)
    try:
        environments.reset()
        actions = np.zeros((2, 2, 1), np.float32)
        assert environments.step(actions).failures == []
        ((place, reason, details),) = environments.step(actions).failures
        assert (place, environments.alive.tolist()) == (0, [False, True])
        assert reason.startswith("step raised RuntimeError: the simulator broke (probes.py:")
        assert "maybe_fail" in details
        assert [episode.seed_index for episode in environments.step(actions).episodes] == [1, 1]
        assert environments.step(actions).failures == []
    finally:
        environments.close()


def test_a_process_may_have_more_environments_than_fit_into_its_pipe():
    environments = SeedEnvironments(probes.Large, None, [4], 256, 1)
    actions = np.random.default_rng(0).uniform(-1, 1, (1, 256, 1000)).astype(np.float32)
    environments.reset()
    np.testing.assert_array_equal(environments.step(actions).next_observation, actions)
    environments.close()


def test_the_death_of_a_process_is_the_failure_of_its_seeds():
    environments = SeedEnvironments(probes.Deadly, {"seed": training_seed(4, 1, 1)}, [4], 2, 2)
    environments.reset()
    actions = np.zeros((1, 2, 1), np.float32)
    outcomes = [environments.step(actions) for _ in range(3)]
    environments.perturb({"action_noise": 0.1})  # of what is left
    environments.close()
    assert [len(outcome.failures) for outcome in outcomes] == [0, 0, 1]  # episodes have three steps
    assert "SIGKILL" in outcomes[2].failures[0].reason
    assert not environments.is_any_alive


def test_what_holds_a_dead_process_s_pipe_open_keeps_no_step_waiting(tmp_path):
    environments = SeedEnvironments(Forking, {"folder": str(tmp_path)}, [4], 2, 2)
    environments.reset()
    outcome = environments.step(np.zeros((1, 2, 1), np.float32))
    environments.close()
    assert ("SIGKILL" in outcome.failures[0].reason, end_forks(tmp_path)) == (True, 2)


def test_processes_are_chosen_by_cores_and_by_what_a_step_costs(monkeypatch):
    monkeypatch.setattr(workers, "SECONDS_THAT_PAY", 0.0)
    assert [workers.choose_processes(probes.Endless, {}, *given) for given in ((8, 2), (2, 4), (8, 1), (1, 8))] == [
        *(2, 2, 0, 0)
    ]
    assert workers.choose_processes(probes.Failing, {}, 8, 2) == 0  # it fails where its failure is told
    monkeypatch.setattr(workers, "SECONDS_THAT_PAY", 60.0)
    assert workers.choose_processes(probes.Endless, {}, 8, 2) == 0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"task": lambda: gymnasium.make_vec("Hopper-v4", 2)}, "makes several environments at once"),
        ({"steps": 502}, "multiple of environments"),
        ({"algorithm": PPO(rollout_steps=66, minibatches=2), "steps": 500}, "environments must divide rollout_steps"),
        ({"environment_processes": 5}, "environment_processes"),
    ],
)
def test_numbers_that_do_not_go_together_are_refused(tmp_path, changes, words):
    with pytest.raises(InputError, match=words):
        train(tmp_path / "run", **{"algorithm": SAC(**SMALL), "environments": 4, **changes})
    assert not (tmp_path / "run").exists()
