"""A task of which one instance can live is evaluated in the training environment, between its episodes."""

from __future__ import annotations

import dataclasses
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.mujoco.hopper_v4 import HopperEnv
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import TimeLimit
from played import run_of_task
from resuming import LEARNERS, Crash, contents, crash_at, run

from csac import InputError, load
from csac.evaluation.evaluator import evaluate
from csac.evaluation.play import evaluate_run


class OneHopper(HopperEnv):
    """A second instance cannot be made."""

    live = 0

    def __init__(self):
        super().__init__()
        OneHopper.live += 1
        assert OneHopper.live == 1, "the robot is in use"

    def close(self):
        OneHopper.live -= 1
        super().close()


def single():
    return TimeLimit(OneHopper(), 50)


HOPPER = partial(gymnasium.make, "Hopper-v4", max_episode_steps=50)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return run(tmp_path_factory.mktemp("single") / "run", task=HOPPER, evaluation_environments=0).runs[0]


def test_evaluations_wait_for_the_end_of_the_episode(whole):
    assert np.unique(whole.evaluations["step"]).tolist() == [100, 200, 300, 400, 500]
    assert whole.rows("episodes")["length"].sum() + 50 > 500  # none was cut short but the last one
    last = whole.evaluations[whole.evaluations["step"] == 500]
    again = evaluate(load(whole), HOPPER, episodes=2, first_seed=whole.config.evaluation_seed)
    np.testing.assert_array_equal(last["return"], again)


def test_one_instance_is_enough(whole, tmp_path):
    one = run(tmp_path / "run", task=single, evaluation_environments=0).runs[0]
    assert OneHopper.live == 0
    assert contents(one)["evaluations.csv"] == contents(whole)["evaluations.csv"]


def test_it_resumes_exactly(whole, tmp_path):
    with pytest.raises(Crash):
        run(tmp_path / "again", task=HOPPER, evaluation_environments=0, on_evaluation=crash_at(300))
    again = run(tmp_path / "again", task=HOPPER, evaluation_environments=0, resume=True)
    assert contents(again.runs[0]) == contents(whole)


def test_a_longer_run_goes_on_as_if_it_had_not_ended(whole, tmp_path):
    settings = {"task": HOPPER, "evaluation_environments": 0}
    run(tmp_path / "run", steps=250, **settings)
    longer = run(tmp_path / "run", resume=True, **settings).runs[0]
    assert longer.policy_file("last").read_bytes() == whole.policy_file("last").read_bytes()
    assert longer.manifest.history[-1].exact


def test_evaluate_keeps_to_one_instance_too(tmp_path, monkeypatch):
    monkeypatch.setitem(gymnasium.registry, "One-v0", EnvSpec("One-v0", lambda **_: single()))
    (made,) = run_of_task(tmp_path / "run", "One-v0").runs
    config = dataclasses.replace(made.config, evaluation_environments=0)
    made.update_manifest(config=config)
    ((_, episodes),) = evaluate_run(tmp_path / "run", episodes=3)
    assert len(episodes) == 3
    assert OneHopper.live == 0


def test_fewer_environments_give_the_same_numbers(tmp_path):
    """Ten episodes, as the last bits depend on the row that an observation has in its batch."""
    one = run(tmp_path / "run", steps=100, evaluation_environments=1, evaluation_episodes=10).runs[0]
    again = evaluate(load(one), "Hopper-v4", episodes=10, first_seed=one.config.evaluation_seed)
    np.testing.assert_array_equal(one.evaluations["return"], again)


@pytest.mark.parametrize("options", [{"seeds": 2, "seeds_per_process": 2}, {"evaluation_processes": 2}])
def test_several_seeds_or_processes_cannot_share_it(tmp_path, options):
    with pytest.raises(InputError, match="evaluation_environments=0"):
        run(tmp_path / "run", LEARNERS[1], evaluation_environments=0, **options)
