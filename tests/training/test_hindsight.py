"""Relabelled transitions by hand, where they go, and that a run with them is resumed to the last byte."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict
from resuming import ROLLOUT, SMALL, Crash, contents, crash_at, run

import csac
from csac import InputError
from csac.algorithms import SAC
from csac.training.hindsight import places_of, relabelled
from csac.types import Spec

REST: dict[str, Any] = {"speed": Box(-9.0, 9.0, (2,), np.float32), "a_time": Box(0.0, 9.0, (1,), np.float32)}


class Walk(gymnasium.Env):
    """Walk a line by the action towards a goal; four steps, or fewer where the goal is reached."""

    metadata = {"render_modes": []}  # noqa: RUF012
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, shift: float = 0.0, scale: float = 1.0, fails: bool = False) -> None:
        goal = Box(-9.0, 9.0, (1,), np.float32)
        self.observation_space = Dict(achieved_goal=goal, desired_goal=goal, **REST)
        self.shift, self.scale, self.fails = shift, scale, fails

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.goal, self.count = 0.0, float(self.np_random.uniform(-2, 2)), 0
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        self.place, self.count = self.place + float(action[0]), self.count + 1
        seen = self.observe()
        reward = self.scale * self.compute_reward(seen["achieved_goal"], seen["desired_goal"], {}) + self.shift
        return seen, reward, reward == 0.0, self.count == 4, {}

    def observe(self) -> dict[str, np.ndarray]:
        one = {"achieved_goal": [self.place], "desired_goal": [self.goal], "speed": [1, 2], "a_time": [self.count]}
        return {name: np.array(value, np.float32) for name, value in one.items()}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: dict[str, Any]) -> float:
        if self.fails and float(desired[0]) != np.float32(self.goal):
            raise RuntimeError("lost its goal")
        return 0.0 if abs(float(achieved[0] - desired[0])) < 0.1 else -1.0

    def get_snapshot(self) -> tuple[dict[str, Any], dict[str, Any]]:
        return {}, {"place": self.place, "goal": self.goal, "count": self.count}

    def set_snapshot(self, arrays: Any, values: dict[str, Any]) -> None:
        self.place, self.goal, self.count = values["place"], values["goal"], values["count"]


class Ending(Walk):
    """Tells which goals end an episode."""

    def compute_terminated(self, achieved: np.ndarray, desired: np.ndarray, info: dict[str, Any]) -> bool:
        return self.compute_reward(achieved, desired, info) == 0.0


class Mute(gymnasium.ObservationWrapper):
    """Has goals, and hides how they are rewarded."""

    def observation(self, observation: Any) -> Any:
        return observation

    def has_wrapper_attr(self, name: str) -> bool:
        return name != "compute_reward" and super().has_wrapper_attr(name)


def test_relabelled_transitions_by_hand():
    # Flat: achieved, desired, other. Three steps of 0 → 1 → 2 → 5 with the goal 9; the last one terminates.
    places = [0, 1, 2, 5]
    episode = np.array(
        [[places[i], 9, 7, 0.5, -1, places[i + 1], 9, 7, i == 2, 0] for i in range(3)], np.float32
    )  # observation 3, action 1, reward, next observation 3, terminated, truncated
    asked = []

    def relabel(achieved, desired):
        asked.append((achieved[:, 0].tolist(), desired[:, 0].tolist()))
        return np.where(achieved[:, 0] == desired[:, 0], 0.0, -1.0), None

    goals = slice(0, 1), slice(1, 2)
    rows = relabelled(episode, goals, Spec(3, 1), 50, np.random.default_rng(0), relabel)
    assert rows.shape == (150, 10)
    ((achieved, desired),) = asked
    assert achieved == [1] * 50 + [2] * 50 + [5] * 50
    # Each of its own step and the later ones is a goal, and no earlier one.
    assert [set(desired[i : i + 50]) for i in (0, 50, 100)] == [{1, 2, 5}, {2, 5}, {5}]
    np.testing.assert_array_equal(rows[:, 1], desired)
    np.testing.assert_array_equal(rows[:, 6], desired)
    np.testing.assert_array_equal(rows[:, 4], np.where(np.array(achieved) == desired, 0, -1))
    same = [0, 2, 3, 5, 7, 8, 9]
    np.testing.assert_array_equal(rows[:, same], np.repeat(episode, 50, axis=0)[:, same])
    ended = relabelled(
        episode, goals, Spec(3, 1), 50, np.random.default_rng(0), lambda a, d: (relabel(a, d)[0], a[:, 0] < 2)
    )
    np.testing.assert_array_equal(ended[:, 8], np.array(achieved) < 2)
    assert relabelled(episode, goals, Spec(3, 1), 4, np.random.default_rng(0), lambda a, d: None).shape == (0, 10)


def test_goals_are_found_among_the_parts_in_the_order_of_their_names():
    parts = (("a", (3,)), ("achieved_goal", (2, 2)), ("desired_goal", (2, 2)), ("observation", (6,)))
    assert places_of(parts) == (slice(3, 7), slice(7, 11))


@pytest.mark.parametrize(
    ("task", "settings"),
    [
        (Walk, {}),
        (Ending, {"environments": 3, "environment_processes": 2}),
        (Ending, {"algorithm": SAC(update_interval=7, **{**SMALL, "replay_size": 10_000})}),
    ],
    ids=["one", "several", "interval"],
)
def test_a_replay_has_each_step_once_and_its_copies_when_its_episode_ends(tmp_path, task, settings):
    given: dict[str, Any] = {"algorithm": SAC(**{**SMALL, "replay_size": 10_000}), "task": task, **settings}
    made = run(tmp_path / "run", steps=120, seeds=2, seeds_per_process=2, hindsight=2, **given)
    for one in made.runs:
        replay = csac.load_checkpoint(one.path).replay()
        steps = sum(episode["length"] for episode in one.rows("episodes"))
        interval = given["algorithm"].cadence.update_interval
        assert len(replay["rewards"]) == 120 - 120 % interval + 2 * steps
        before, after = replay["observations"], replay["next_observations"]  # a_time, achieved, desired, speed
        reached = np.abs(after[:, 1] - after[:, 2]) < 0.1
        np.testing.assert_array_equal(replay["rewards"], np.where(reached, 0.0, -1.0))
        np.testing.assert_array_equal(before[:, 2], after[:, 2])
        if task is Ending:
            np.testing.assert_array_equal(replay["terminated"], reached)
        assert 0.3 < reached.mean() < 0.9  # two goals in three are of the same or a later step


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"environments": 4}], ids=["one", "four"])
def test_a_crash_in_mid_episode_changes_no_byte(tmp_path, settings):
    given: dict[str, Any] = {"algorithm": SAC(**SMALL), "task": Walk, "steps": 320, "hindsight": 3, **settings}
    given |= {"seeds": 2, "seeds_per_process": 2, "checkpoint_interval": 108}  # no multiple of an episode
    whole = run(tmp_path / "whole", **given)
    with pytest.raises(Crash):
        run(tmp_path / "again", on_evaluation=crash_at(300), **given)
    again = run(tmp_path / "again", resume=True, **given)
    assert [contents(one) for one in again.runs] == [contents(one) for one in whole.runs]
    assert all(one.manifest.history[-1].exact for one in again.runs)
    with pytest.raises(InputError, match="hindsight is 3, not 2"):
        run(tmp_path / "again", resume=True, **given | {"hindsight": 2})
    with pytest.raises(InputError, match="hindsight is 3, not 0"):
        run(tmp_path / "fork", start_from=whole.path, **given | {"hindsight": 0, "steps": 400})


@pytest.mark.slow
def test_an_episode_that_restarts_is_left_out(tmp_path):
    class Forgetful(Walk):
        get_snapshot = None  # pyright: ignore[reportAssignmentType]

    given: dict[str, Any] = {"algorithm": SAC(**{**SMALL, "replay_size": 10_000}), "task": Forgetful, "hindsight": 2}
    run(tmp_path / "run", steps=121, checkpoint_interval=121, **given)
    longer = run(tmp_path / "run", steps=200, checkpoint_interval=121, resume=True, **given)
    copies = len(csac.load_checkpoint(longer).replay()["rewards"]) - 200
    assert copies == 2 * sum(episode["length"] for episode in longer.runs[0].rows("episodes"))


def test_a_reward_that_cannot_be_computed_ends_the_seed(tmp_path):
    with pytest.warns(RuntimeWarning, match="seed 0 failed"):
        made = run(tmp_path / "run", SAC(**SMALL), 100, task=Walk, environment_arguments={"fails": True}, hindsight=2)
    assert "compute_reward raised RuntimeError: lost its goal" in made.failures[0]


@pytest.mark.parametrize(
    ("task", "algorithm", "arguments", "told"),
    [
        ("Pendulum-v1", SAC(**SMALL), {}, "achieved_goal and desired_goal .* not one Box"),
        (lambda: Mute(Walk()), SAC(**SMALL), {}, "hindsight needs compute_reward"),
        (Walk, ROLLOUT, {}, "hindsight is for algorithms with a replay"),
        (Walk, SAC(n_steps=2, **SMALL), {}, "n_steps must be 1"),
        (Walk, SAC(**SMALL), {"scale": 3.0}, "gave -3 and its compute_reward -1"),
    ],
)
def test_what_has_no_use_for_it_is_refused(tmp_path, task, algorithm, arguments, told):
    with pytest.raises(InputError, match=told) as error:
        run(tmp_path / "run", algorithm, 64, task=task, environment_arguments=arguments, hindsight=4)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()
