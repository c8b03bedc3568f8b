"""Environments: what is refused, what a step gives, how a seed fails alone, and that nothing is printed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import probes
import pytest
from gymnasium import spaces

from csac.seeds import EVALUATION_SEED, FRESH_EVALUATION_SEED, training_seed
from csac.tasks.environment import Environment
from csac.tasks.failures import EnvironmentFailure, one_line
from csac.tasks.vector import SeedEnvironments
from csac.types import InputError

UNIT = spaces.Box(-1.0, 1.0, (1,), np.float32)
NUMBERED: Any = {"a": UNIT, 1: UNIT}
DISORDERED = spaces.Dict(OrderedDict(z=UNIT, a=spaces.Box(-9, 9, (1, 2)), m=spaces.Box(-9, 9, ())))
NAN, INF = float("nan"), float("inf")


class Scripted(gymnasium.Env):
    """Gives what it is told and remembers the actions."""

    def __init__(
        self, observation_space=UNIT, action_space=UNIT, observation: Any = (0.0,), ending: Any = (0, 0)
    ) -> None:
        self.observation_space, self.action_space = observation_space, action_space
        self.observation, self.ending = observation, ending
        self.reward: Any = 1.0
        self.actions: list[np.ndarray] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self.observation, {}

    def step(self, action: np.ndarray) -> Any:
        self.actions.append(action)
        return self.observation, self.reward, *self.ending, {"note": 1}


def scripted(**settings: Any) -> Environment:
    return Environment(lambda: Scripted(**settings))


def steps_of(environments: SeedEnvironments, count: int, action: float = 0.0) -> list:
    actions = np.full((len(environments.seeds), 1), action, np.float32)
    return [environments.step(actions) for _ in range(count)]


# What is refused


@pytest.mark.parametrize(
    ("name", "space", "message"),
    [
        ("action_space", spaces.Box(-np.inf, np.inf, (2,)), "infinite bounds"),
        ("action_space", spaces.Box(-1e300, 1e300, (2,), np.float64), "infinite bounds"),
        ("action_space", spaces.Box(0, 5, (2,), np.int64), "continuous"),
        ("action_space", spaces.MultiDiscrete([2, 3]), "continuous"),
        ("action_space", spaces.Box(-1.0, 1.0, (0,)), "continuous"),
        ("action_space", None, "continuous"),
        ("observation_space", spaces.Discrete(4), "Discrete.*FlattenObservation"),
        ("observation_space", spaces.Dict(a=spaces.Dict(b=UNIT)), r"observation\['a'\] is a .*Dict"),
        ("observation_space", spaces.Box(0, 255, (8, 8, 3), np.uint8), "image"),
        ("observation_space", spaces.Box(-1.0, 1.0, (0,)), "empty"),
        ("observation_space", spaces.Dict(NUMBERED), r"observation\[1\]"),
        ("observation_space", spaces.Dict(), "empty"),
        ("observation_space", type("Box", (), {"__module__": "gym.spaces.box"})(), r"gym\.spaces\.box\.Box"),
    ],
)
def test_a_space_that_cannot_be_learnt_is_refused(name, space, message):
    with pytest.raises(InputError, match=f"Scripted: .*{message}"):
        scripted(**{name: space})


def test_an_environment_without_a_space_is_refused_and_closed():
    closed = []

    class Bare(gymnasium.Env):
        def close(self):
            closed.append(True)

    with pytest.raises(InputError, match=r"Bare: .*observation_space"):
        Environment(Bare)
    assert closed


def test_a_function_that_returns_the_same_environment_again_is_refused():
    one = Scripted()
    Environment(lambda: one).close()
    with pytest.raises(InputError, match="again"):
        Environment(lambda: one)


def test_a_render_mode_that_the_task_lacks_is_refused():
    with pytest.raises(InputError, match="'hologram': it has human, rgb_array"):
        Environment("Pendulum-v1", render_mode="hologram")
    assert Environment("Pendulum-v1", render_mode="rgb_array").raw.render_mode == "rgb_array"


# What an environment is


@pytest.mark.parametrize(
    ("space", "observation", "flat"),
    [
        (spaces.Box(-9, 9, (2,), np.float64), np.array([1.0, 2.0]), [1, 2]),
        (spaces.Box(-9, 9, (), np.float32), 3.5, [3.5]),
        (spaces.Box(-9, 9, (2, 2), np.float16), np.array([[1, 2], [3, 4]], np.float16), [1, 2, 3, 4]),
        (spaces.Box(0, 255, (2,), np.uint8), np.array([255, 255], np.uint8), [255, 255]),
        (spaces.Box(-np.inf, np.inf, (2,), np.float64), np.array([1e30, -1e30]), [1e30, -1e30]),
        (DISORDERED, {"m": 4.0, "z": [1.0], "a": [[2.0, 3.0]]}, [2, 3, 4, 1]),
    ],
)
def test_observations_become_flat_float32(space, observation, flat):
    environment = scripted(observation_space=space, observation=observation)
    first = environment.reset(0)
    second, *_ = environment.step(np.zeros(1, np.float32))
    np.testing.assert_array_equal(first, np.array(flat, np.float32))
    np.testing.assert_array_equal(second, np.array(flat, np.float32))
    assert first.dtype == second.dtype == np.float32
    assert environment.spec.observation_size == len(flat)
    assert environment.raw_observation is observation


def test_an_array_that_the_environment_reuses_is_copied():
    reused = np.array([1.0], np.float32)
    environment = scripted(observation=reused)
    first = environment.reset(0)
    reused[0] = 2.0
    assert first[0] == 1.0


@pytest.mark.parametrize("shape", [(), (6,), (2, 3)])
def test_actions_reach_the_environment_in_its_shape_and_bounds(shape):
    low, high = np.full(shape, -1.0, np.float32), np.full(shape, 3.0, np.float32)
    environment = scripted(action_space=spaces.Box(low, high))
    environment.step(np.linspace(-1, 1, max(1, int(np.prod(shape))), dtype=np.float32))
    (action,) = environment.raw.unwrapped.actions  # pyright: ignore
    expected = np.linspace(-1, 3, 6).reshape(shape) if shape else -1.0
    np.testing.assert_allclose(action, expected, rtol=1e-6)
    assert action.shape == shape
    assert action.dtype == np.float32


def test_actions_lie_in_a_box_of_doubles_too():
    space = spaces.Box(np.array([0.1, -0.3]), np.array([0.7, 1 / 3]), dtype=np.float64)
    environment = scripted(action_space=space)
    for action in ([-1, -1], [1, 1], [0, 0]):
        environment.step(np.array(action, np.float32))
    assert all(space.contains(action) for action in environment.raw.unwrapped.actions)  # pyright: ignore
    np.testing.assert_allclose(environment.contract_parts.action_high, space.high, rtol=1e-6)


@pytest.mark.parametrize("width", [0.0, 1e-12])
def test_bounds_between_which_no_float32_lies_are_the_nearest(width):
    """Rounded inwards they were the wrong way round, and no contract with them can be opened again."""
    space = spaces.Box(np.array([0.1, -1.0]), np.array([0.1 + width, 1.0]), dtype=np.float64)
    parts = scripted(action_space=space).contract_parts
    np.testing.assert_array_equal(parts.action_low, np.array([0.1, -1.0], np.float32))
    np.testing.assert_array_equal(parts.action_high, np.array([0.1, 1.0], np.float32))


@pytest.mark.parametrize("reward", [2, np.float32(2), np.array(2.0), np.int64(2)])
def test_rewards_become_floats_and_flags_bools(reward):
    environment = scripted(ending=(np.bool_(True), 1))
    environment.raw.unwrapped.reward = reward  # pyright: ignore
    environment.reset(0)
    _, value, terminated, truncated, info = environment.step(np.zeros(1, np.float32))
    assert (type(value), value) == (float, 2.0)
    assert (terminated, truncated) == (True, True)
    assert type(terminated) is type(truncated) is bool
    assert info == {"note": 1}


# What fails


@pytest.mark.parametrize(
    ("space", "observation", "message"),
    [
        (spaces.Box(-9, 9, (3,)), np.array([0, 1, NAN]), "observation[2] is nan"),
        (spaces.Box(-9, 9, (2, 2)), np.array([[0, 1], [-INF, 1]]), "observation[1, 0] is -inf"),
        (spaces.Box(-9, 9, ()), np.array(INF), "observation is inf"),
        (spaces.Box(-9, 9, (1,), np.float64), np.array([1e39]), "observation[0] is inf"),
        (spaces.Box(-9, 9, (3,)), np.zeros((1, 3)), "observation has shape (1, 3) where its space has (3,)"),
        (spaces.Box(-9, 9, (3,)), ["a", "b", "c"], "observation is not an array of numbers"),
        (spaces.Box(-9, 9, (2,)), [[1], [1, 2]], "observation is not an array of numbers"),
        (UNIT, [10**400], "observation is not an array of numbers"),
        (spaces.Dict(a=UNIT, b=UNIT), {"a": [0.0], "b": [NAN]}, "observation['b'][0] is nan"),
        (spaces.Dict(a=UNIT, b=UNIT), {"a": [0.0]}, "observation has no 'b'"),
        (spaces.Dict(a=UNIT), np.zeros(1), "observation has no 'a'"),
    ],
)
def test_a_bad_observation_is_named(space, observation, message):
    environment = scripted(observation_space=space, observation=observation)
    with pytest.raises(EnvironmentFailure) as failure:
        environment.step(np.zeros(1, np.float32))
    assert str(failure.value).startswith(message)
    with pytest.raises(EnvironmentFailure, match=r"after reset$"):
        environment.reset(0)


@pytest.mark.parametrize("reward", [NAN, -INF, 1e39, np.ones(1), None, "high", 10**400])
def test_a_bad_reward_is_named(reward):
    environment = scripted()
    environment.raw.unwrapped.reward = reward  # pyright: ignore
    with pytest.raises(EnvironmentFailure, match=r"^reward "):
        environment.step(np.zeros(1, np.float32))


@pytest.mark.parametrize(
    ("action", "message"), [([NAN], r"action\[0\] is nan"), ([0.0, 0.0], r"shape \(2,\)"), ([[0.0]], r"shape \(1, 1\)")]
)
def test_a_bad_action_never_reaches_the_environment(action, message):
    environment = scripted()
    with pytest.raises(EnvironmentFailure, match=message):
        environment.step_environment_scale(np.array(action))
    assert environment.raw.unwrapped.actions == []  # pyright: ignore


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A user's module, whose environment divides by zero in a helper's function and raises in a library below it."""
    (tmp_path / "divides.py").write_text(
        "import json\n"
        "import probes\n"
        "class Task(probes.Endless):\n"
        "    def step(self, action):\n"
        "        return self.divide(0)\n"
        "    def divide(self, by):\n"
        "        return 1 / by\n"
        "    def reset(self, *, seed=None, options=None):\n"
        "        json.loads('{')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    import divides  # pyright: ignore[reportMissingImports]

    yield divides
    del sys.modules["divides"]


def test_an_error_is_told_with_its_place_in_the_users_own_code(module):
    task = Environment(module.Task)
    with pytest.raises(EnvironmentFailure, match=r"^reset raised JSONDecodeError: .* \(divides\.py:9\)$"):
        task.reset(0)
    with pytest.raises(EnvironmentFailure, match=r"^step raised ZeroDivisionError: .* \(divides\.py:7\)$"):
        task.step(np.zeros(1, np.float32))


@pytest.mark.parametrize(
    ("error", "start"),
    [
        (RuntimeError("no file \udcff\nhere"), "RuntimeError: no file \\udcff here"),
        (RuntimeError("\x1b[31mno\x1b[0m file\x07 here"), "RuntimeError: no file here"),
        (RuntimeError(), "RuntimeError"),
    ],
)
def test_whatever_an_error_says_can_be_written_down(error, start):
    assert one_line(error).startswith(start)
    assert one_line(error).encode()


# Several seeds


def test_each_episode_has_a_reset_seed_of_its_own():
    seeds = [training_seed(seed, episode) for seed in range(20) for episode in range(50)]
    assert len(set(seeds)) == len(seeds)
    assert min(seeds) > max(EVALUATION_SEED, FRESH_EVALUATION_SEED) + 1_000_000
    assert max(seeds) < 2**31
    assert seeds[:2] == [1_895_069_886, 1_817_441_348]  # for good: an old run resumes with them


def test_environments_are_closed_where_another_of_them_cannot_be_made():
    made = []

    class Scarce(probes.Endless):
        def __init__(self):
            assert len(made) < 2, "no more simulators"
            super().__init__()
            made.append("open")

        def close(self):
            made[made.index("open")] = "closed"

    with pytest.raises(InputError, match="no more simulators"):
        SeedEnvironments(Scarce, None, [7, 9], environments=2)
    assert made == ["closed", "closed"]


def test_steps_keep_the_true_final_observation_and_both_flags():
    environments = SeedEnvironments(probes.IdEncoded, None, [7, 9])
    observations = environments.reset()
    finished = []
    episode, step = 0, 0
    for count in range(12):
        action = np.array([[0.1], [0.2]], np.float32) + np.float32(count / 100)
        instances = [training_seed(seed, episode) % 65536 for seed in (7, 9)]
        np.testing.assert_array_equal(observations[:, :3], [[instance, episode, step] for instance in instances])
        outcome = environments.step(action)
        step += 1
        ends = step == 2 + episode % 3
        expected = [[instance, episode, step] for instance in instances]
        np.testing.assert_array_equal(outcome.next_observation[:, :3], expected)
        np.testing.assert_array_equal(outcome.next_observation[:, 3:], action)
        np.testing.assert_array_equal(outcome.reward, [step, step])
        assert outcome.terminated.tolist() == [ends and episode % 3 in (0, 2)] * 2
        assert outcome.truncated.tolist() == [ends and episode % 3 in (1, 2)] * 2
        finished += [(episode, *row[:3]) for row in outcome.episodes]
        if ends:
            episode, step = episode + 1, 0
        else:
            np.testing.assert_array_equal(outcome.observation, outcome.next_observation)
        observations = outcome.observation
    lengths = {0: 2, 1: 3, 2: 4, 3: 2}
    assert finished == [(e, i, n * (n + 1) / 2, n) for e, n in lengths.items() for i in (0, 1)]


def test_arrays_have_their_types_and_stay_as_they_were():
    environments = SeedEnvironments(probes.IdEncoded, None, [0, 1, 2])
    first = environments.reset()
    (outcome,) = steps_of(environments, 1)
    kept = [array.copy() for array in (first, *outcome[:5])]
    steps_of(environments, 5)
    for array, copy in zip((first, *outcome[:5]), kept, strict=True):
        np.testing.assert_array_equal(array, copy)
    assert [array.dtype for array in outcome[:5]] == [np.float32, np.float32, bool, bool, np.float32]
    assert [array.shape for array in outcome[:5]] == [(3, 4), (3,), (3,), (3,), (3, 4)]
    assert not np.shares_memory(outcome.observation, outcome.next_observation)


def test_a_seed_steps_the_same_alone_and_beside_others():
    alone = SeedEnvironments("Hopper-v4", None, [5])
    beside = SeedEnvironments("Hopper-v4", None, [4, 5, 6])
    np.testing.assert_array_equal(alone.reset()[0], beside.reset()[1])
    actions = np.random.default_rng(0).uniform(-1, 1, (100, 1, 3)).astype(np.float32)
    for action in actions:
        one, other = alone.step(action), beside.step(np.repeat(action, 3, axis=0))
        np.testing.assert_array_equal(one.next_observation[0], other.next_observation[1])
        np.testing.assert_array_equal(one.observation[0], other.observation[1])
        assert one.reward[0] == other.reward[1]


def test_a_seed_that_breaks_fails_alone_and_is_not_stepped_again():
    environments = SeedEnvironments(probes.Failing, {"at": 3, "seeds": [training_seed(1, 0)]}, [0, 1, 2])
    environments.reset()
    before, last, broken, after = steps_of(environments, 4)
    assert before.failures == last.failures == after.failures == []
    ((index, reason, details),) = broken.failures
    assert index == 1
    assert re.fullmatch(r"step raised RuntimeError: the simulator broke \(probes\.py:\d+\)", reason)
    assert "maybe_fail" in details
    assert environments.alive.tolist() == [True, False, True]
    raws = [environment.raw.unwrapped for environment in environments.environments]
    assert [raw.count["step"] for raw in raws] == [4, 3, 4]  # pyright: ignore
    assert [episode.seed_index for episode in broken.episodes] == [0, 2]


class Panic(BaseException):
    """What an extension written in Rust raises."""


class Panicking(probes.Failing):
    error: BaseException = Panic("index out of bounds")

    def maybe_fail(self, where: str) -> None:
        try:
            super().maybe_fail(where)
        except RuntimeError:
            raise self.error from None


@pytest.mark.parametrize("where", ["step", "reset"])
@pytest.mark.parametrize("error", [Panic("index out of bounds"), SystemExit(7)])
def test_a_panic_and_an_exit_fail_their_seed_alone(monkeypatch, where, error):
    monkeypatch.setattr(Panicking, "error", error)
    arguments = {"where": where, "seeds": [training_seed(0, 0)]}
    environments = SeedEnvironments(Panicking, arguments, [0, 1])
    environments.reset()
    failures = [failure for step in steps_of(environments, 2) for failure in step.failures]
    assert [(failure.seed_index, failure.reason.partition(":")[0]) for failure in failures] == [
        (0, f"{where} raised {type(error).__name__}")
    ]
    assert environments.alive.tolist() == [False, True]


def test_a_keyboard_interrupt_is_nobodys_failure(monkeypatch):
    monkeypatch.setattr(Panicking, "error", KeyboardInterrupt())
    environments = SeedEnvironments(Panicking, {}, [0])
    environments.reset()
    with pytest.raises(KeyboardInterrupt):
        steps_of(environments, 1)


@pytest.mark.parametrize(
    ("where", "value", "reason"), [("reward", INF, "reward is inf"), ("observation", NAN, "observation[0] is nan")]
)
def test_a_failed_seed_stays_at_its_last_good_values(where, value, reason):
    arguments = {"where": where, "value": value, "at": 3, "seeds": [training_seed(0, 0)]}
    environments = SeedEnvironments(probes.NonFinite, arguments, [0, 1])
    environments.reset()
    *_, broken, after = steps_of(environments, 4)
    assert broken.failures == [(0, reason, "")]
    for outcome in (broken, after):
        np.testing.assert_array_equal(outcome.observation, np.zeros((2, 1)))
        np.testing.assert_array_equal(outcome.next_observation, np.zeros((2, 1)))
        np.testing.assert_array_equal(outcome.reward, [1.0, 1.0])
        assert not (outcome.terminated | outcome.truncated).any()


def test_a_seed_that_fails_in_its_first_reset_is_reported_by_the_first_step():
    environments = SeedEnvironments(probes.Failing, {"where": "reset"}, [0, 1])
    environments.reset()
    assert environments.alive.all()
    first, second = steps_of(environments, 2)
    assert [failure.seed_index for failure in first.failures] == [0, 1]
    assert second.failures == []
    assert not environments.is_any_alive


def test_a_seed_that_fails_in_a_later_reset_has_finished_its_episode():
    environments = SeedEnvironments(probes.Failing, {"where": "reset", "at": 2}, [0])
    environments.reset()
    *_, last = steps_of(environments, 3)
    assert [episode[:3] for episode in last.episodes] == [(0, 3.0, 3)]
    assert [failure.seed_index for failure in last.failures] == [0]
    assert environments.alive.tolist() == [False]


def test_a_stopped_seed_steps_no_more():
    environments = SeedEnvironments(probes.Failing, {"at": 2}, [0, 1])
    environments.reset()
    environments.stop(0)
    assert environments.alive.tolist() == [False, True]
    _, second = steps_of(environments, 2)
    assert [failure.seed_index for failure in second.failures] == [1]


# What an environment does to the process that it is in


@pytest.mark.parametrize("exits", [False, True])
def test_an_error_while_closing_is_logged_and_keeps_nobody(caplog, exits):
    Environment("probes:Failing-v0", {"where": "close", "exits": exits}).close()
    (message,) = caplog.messages
    assert message.startswith("probes:Failing-v0: close raised ")


def test_the_working_directory_stays_where_it_was(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def task() -> gymnasium.Env:
        os.chdir("/")
        return probes.Endless()

    Environment(task)
    assert Path.cwd() == tmp_path


RUN = """
import numpy as np
from csac.tasks.environment import Environment
from csac.tasks.vector import SeedEnvironments
environments = SeedEnvironments("HalfCheetah-v4", None, [0, 1])
environments.reset()
environments.step(np.zeros((2, 6), np.float32))
environments.environments[0].raw.unwrapped.data.qvel[:] = 1e30
environments.step(np.zeros((2, 6), np.float32))
Environment("Pendulum-v1", render_mode="rgb_array").close()
environments.close()
"""


def test_nothing_is_printed_and_no_file_is_left(tmp_path):
    command = [sys.executable, "-W", "always", "-c", RUN]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []


def test_warnings_of_the_users_own_environment_are_shown():
    def task() -> gymnasium.Env:
        gymnasium.logger.warn("hidden")
        import warnings

        warnings.warn("the user's own", stacklevel=1)
        return probes.Endless()

    with pytest.warns(UserWarning, match="the user's own") as shown:
        Environment(task)
    assert len(shown) == 1
