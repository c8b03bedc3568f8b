"""An episode goes on from its snapshot, in another environment, as if nothing had happened."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import probes
import pytest
from trajectories import steps_of

from csac.tasks.environment import Environment
from csac.tasks.failures import EnvironmentFailure
from csac.tasks.vector import SeedEnvironments
from csac.types import Snapshot

TASKS = ["HalfCheetah-v4", "Ant-v4", "Hopper-v4", "Humanoid-v5", "Pusher-v5", "Pendulum-v1", "MountainCarContinuous-v0"]


def actions(environment: Environment, count: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(-0.3, 0.3, (count, environment.spec.action_size)).astype(np.float32)


def play(environment: Environment, chosen: np.ndarray) -> list[tuple]:
    """Step until the actions or the episode end: (observation, reward, terminated, truncated)."""
    steps = []
    for action in chosen:
        observation, *rest, _ = environment.step(action)
        steps.append((tuple(observation), *rest))
        if rest[1] or rest[2]:
            break
    return steps


def through_json(saved: Snapshot) -> Snapshot:
    return Snapshot({name: array.copy() for name, array in saved.arrays.items()}, json.loads(json.dumps(saved.values)))


@pytest.mark.parametrize("task", TASKS)
def test_an_episode_of_gymnasiums_own_tasks_goes_on_bit_for_bit(task):
    first, second = Environment(task), Environment(task)
    first.reset(7)
    chosen = actions(first, 120)
    play(first, chosen[:3])
    saved = first.snapshot()
    assert saved
    saved = through_json(saved)
    second.reset(8)
    play(second, chosen[50:55])  # whatever it did before
    second.restore(7, saved)
    after = play(first, chosen[3:])
    assert len(after) > 1
    assert play(second, chosen[3:]) == after


def test_the_time_limit_and_the_generator_go_on():
    first, second = Environment("Reacher-v5"), Environment("Reacher-v5")
    first.reset(1)
    chosen = actions(first, 60)
    play(first, chosen[:20])
    first.raw.unwrapped.np_random.random(5)
    saved = first.snapshot()
    assert saved
    second.restore(1, saved)
    assert len(play(second, chosen)) == 30  # of the 50 that an episode has
    assert second.raw.unwrapped.np_random.random() == first.raw.unwrapped.np_random.random()


class Counting(probes.Endless):
    """Its reward counts its steps; it can be saved."""

    def step(self, action):
        super().step(action)
        return self.observation, float(self.steps), False, self.steps == self.length, {}

    def get_snapshot(self):
        return {"observation": self.observation}, {"steps": self.steps}

    def set_snapshot(self, arrays, values):
        self.observation, self.steps = arrays["observation"], values["steps"]


def test_an_environment_can_offer_its_own_snapshot():
    first, second = Environment(Counting), Environment(Counting)
    first.reset(0)
    play(first, actions(first, 4))
    saved = first.snapshot()
    assert saved
    second.restore(0, through_json(saved))
    assert [reward for _, reward, _, _ in play(second, actions(second, 9))] == [5, 6, 7, 8, 9, 10]


@pytest.mark.parametrize(
    "task",
    [
        probes.Endless,
        lambda: gymnasium.wrappers.FrameStackObservation(gymnasium.make("Hopper-v5"), 2),
        lambda: type("Own", (type(gymnasium.make("Hopper-v5").unwrapped),), {"__module__": "own"})(),
    ],
    ids=["nothing offered", "a wrapper that remembers", "a class of one's own"],
)
def test_what_cannot_be_had_whole_is_not_offered(task):
    environment = Environment(task)
    environment.reset(0)
    assert environment.snapshot() is None


def test_a_snapshot_of_another_physics_is_refused():
    ant, hopper = Environment("Ant-v4"), Environment("Hopper-v4")
    ant.reset(0)
    saved = ant.snapshot()
    assert saved
    with pytest.raises(EnvironmentFailure, match="has other arrays"):
        hopper.restore(0, saved)


def test_an_episode_that_cannot_be_saved_starts_anew_with_its_own_seed():
    first, second = (SeedEnvironments(probes.IdEncoded, None, (4,)) for _ in range(2))
    first.reset()
    steps_of(first, 3)  # an episode of two steps, and one step of the second episode
    saved = through_json(first.save(0))
    assert not saved.values["exact"]
    second.restore(0, saved)
    assert second.observations[0, 0] == first.observations[0, 0]  # the reset seed
    assert second.observations[0, 2] == 0  # the step


def test_an_episode_that_is_not_taken_back_starts_anew_with_its_own_seed():
    """The array of another MuJoCo is missing here; the seed had failed, and with it every other seed of the run."""
    first, second, third = (SeedEnvironments("Hopper-v4", None, (4,)) for _ in range(3))
    began = first.reset()[0].copy()
    steps_of(first, 5)
    saved = through_json(first.save(0))
    del saved.arrays["mujoco.qpos"]
    assert second.restore(0, saved) is False
    assert "has other arrays" in second.refused[0]
    np.testing.assert_array_equal(second.observations[0], began)
    third.reset()
    assert steps_of(second, 120) == steps_of(third, 120)  # the next episodes have the seeds that they would have had


def test_an_episode_that_has_one_time_limit_more_starts_anew():
    first = SeedEnvironments(lambda: Counting(20), None, (4,))
    second = SeedEnvironments(lambda: gymnasium.wrappers.TimeLimit(Counting(20), 7), None, (4,))
    first.reset()
    steps_of(first, 5)
    assert second.restore(0, through_json(first.save(0))) is False
    episodes = [episode for _, _, episodes in steps_of(second, 7) for episode in episodes]
    assert [episode[1:3] for episode in episodes] == [(1 + 2 + 3 + 4 + 5 + 6 + 7, 7)]


def test_a_seed_that_neither_takes_its_episode_back_nor_can_be_reset_has_failed():
    first = SeedEnvironments(probes.Unsavable, {"gives": "one way"}, (4,))
    second = SeedEnvironments(probes.Failing, {"where": "reset"}, (4,))
    first.reset()
    assert second.restore(0, first.save(0)) is False
    outcome = second.step(np.zeros((1, 1), np.float32))
    (failure,) = outcome.failures
    assert failure.reason.startswith("reset raised RuntimeError: the simulator broke")


@pytest.mark.parametrize(
    ("gives", "problem"),
    [
        ("error", "get_snapshot raised KeyError: 'position'"),
        ("exit", "get_snapshot raised SystemExit: 7"),
        ("nothing", "get_snapshot raised TypeError"),
        ("objects", "get_snapshot gave 'bodies', which is no array of numbers"),
        ("values", "get_snapshot gave values that JSON cannot hold: TypeError"),
    ],
)
def test_an_episode_that_cannot_be_saved_says_why_and_begins_anew(gives, problem):
    first, second = (SeedEnvironments(probes.Unsavable, {"gives": gives}, [3]) for _ in range(2))
    first.reset()
    first.step(np.zeros((1, 1), np.float32))
    saved = first.save(0)
    assert saved.values["problem"].startswith(problem)
    assert second.restore(0, saved) is False
    np.testing.assert_array_equal(second.observations, SeedEnvironments(probes.Unsavable, {}, [3]).reset())
