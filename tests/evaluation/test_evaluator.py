"""Evaluation: known returns, numbers that depend on nothing but the policy and the episode, failures in words."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import gymnasium
import numpy as np
import probes
import pytest
from gymnasium import spaces

from csac.deploy.contract import Contract
from csac.deploy.policy import Policy, noise_generator
from csac.evaluation.episode import _success
from csac.evaluation.evaluator import (
    EPISODES_AT_ONCE,
    EvaluationEpisode,
    EvaluationFailure,
    Evaluator,
    evaluate,
    evaluate_episodes,
)
from csac.seeds import EVALUATION_SEED, FRESH_EVALUATION_SEED
from csac.tasks.environment import Environment
from csac.tasks.perturbations import Noise
from csac.tasks.registry import Task
from csac.types import InputError, Layer, PolicyNetwork, PolicyParameters


def policy_for(task: Task, weight: float = 0.0, bias: float = 0.0, log_std: float = 0.0) -> Policy:
    """A policy of one layer: tanh(weight * sum of the observation + bias), the same in every action dimension."""
    environment = Environment(task)
    observation_size, action_size = environment.spec[:2]
    mean = np.full((observation_size, action_size), weight)
    biases = np.concatenate([np.full(action_size, bias), np.full(action_size, log_std)])
    network = PolicyNetwork(PolicyParameters(((Layer(np.concatenate([mean, np.zeros_like(mean)], axis=1), biases),),)))
    return Policy(network, Contract("Task-v0", "csac", "relu", "tanh_gaussian", *environment.contract_parts))


class Lottery(gymnasium.Env):
    """Length and observations are drawn from the reset seed; the reward is the action."""

    observation_space = spaces.Box(-9.0, 9.0, (3,), np.float32)
    action_space = spaces.Box(-1.0, 3.0, (2,), np.float32)

    def __init__(self) -> None:
        self.left = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(1, 30))
        return self.observe(), {}

    def step(self, action):
        self.left -= 1
        return self.observe(), float(action.sum()), self.left == 0, False, {}

    def observe(self) -> np.ndarray:
        return self.np_random.normal(size=3).astype(np.float32)


class Goal(gymnasium.Env):
    """A dict observation; two steps; succeeds where the action reaches 1.5."""

    observation_space = spaces.Dict(
        goal=spaces.Box(-9.0, 9.0, (2,), np.float32), at=spaces.Box(-9.0, 9.0, (), np.float64)
    )
    action_space = spaces.Box(0.0, 2.0, (2, 1), np.float32)

    def __init__(self, success_key: str = "is_success") -> None:
        self.success_key, self.steps = success_key, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        self.steps, self.seed = 0, seed
        return self.observe(), {}

    def step(self, action):
        self.steps += 1
        succeeded = np.array(bool((action >= 1.5).all()))
        return self.observe(), 1.0, False, self.steps == 2, {self.success_key: succeeded}

    def observe(self) -> dict[str, Any]:
        return {"goal": np.ones(2, np.float32), "at": float(self.steps)}


def test_the_policy_sees_the_observation_of_its_own_episode():
    # tanh(large * x) = x: each episode earns -(x - x/2)² = -0.25; the observation of another would earn -2.25 at times.
    policy = policy_for(probes.ObservationActionReward, weight=100.0)
    returns = evaluate(policy, probes.ObservationActionReward, episodes=25)
    np.testing.assert_allclose(returns, np.full(25, -0.25), rtol=1e-5)


def test_episode_j_is_reset_with_the_first_seed_plus_j():
    def expected(seed: int) -> int:
        environment = Environment(Lottery)
        environment.reset(seed)
        return environment.raw.unwrapped.left  # pyright: ignore

    policy = policy_for(Lottery)
    lengths = [episode.length for episode in Evaluator(Lottery, episodes=23).run(policy)]
    assert lengths == [expected(EVALUATION_SEED + number) for number in range(23)]
    lengths = [episode.length for episode in Evaluator(Lottery, episodes=3, first_seed=77).run(policy)]
    assert lengths == [expected(77 + number) for number in range(3)]


class OwnGenerator(probes.ObservationReward):
    """Draws from a generator that no reset seeds."""

    def __init__(self) -> None:
        super().__init__()
        self.generator = np.random.default_rng(0)

    def first_observation(self) -> np.ndarray:
        return self.generator.normal(size=1).astype(np.float32)


class GlobalGenerator(OwnGenerator):
    """Draws from NumPy's global generator."""

    def first_observation(self) -> np.ndarray:
        return np.random.normal(size=1).astype(np.float32)


@pytest.mark.parametrize("task", [OwnGenerator, GlobalGenerator])
def test_episodes_of_a_task_that_ignores_its_seed_differ_and_can_be_repeated(task):
    policy, evaluator = policy_for(task), Evaluator(task, episodes=25)
    episodes = evaluator.run(policy)
    assert len({episode.episode_return for episode in episodes}) == 25
    assert evaluator.run(policy) == episodes
    assert Evaluator(task, episodes=25).run_batch(policy, 20) == episodes[20:]


@pytest.mark.parametrize("deterministic", [True, False])
def test_an_episode_depends_on_no_other(deterministic):
    policy = policy_for(Lottery, weight=0.7)
    few = Evaluator(Lottery, episodes=3).run(policy, deterministic)
    many = Evaluator(Lottery, episodes=2 * EPISODES_AT_ONCE + 3).run(policy, deterministic)
    again = Evaluator(Lottery, episodes=3, first_seed=EVALUATION_SEED + EPISODES_AT_ONCE).run(policy, deterministic)
    assert few == many[:3]
    assert [episode[1:] for episode in again] == [
        episode[1:] for episode in many[EPISODES_AT_ONCE : EPISODES_AT_ONCE + 3]
    ]
    assert len({episode.episode_return for episode in many}) == len(many)


def test_an_evaluation_can_be_repeated():
    task = "Hopper-v4"
    policy = policy_for(task, weight=0.1)
    evaluator = Evaluator(task)
    first = evaluator.run(policy)
    evaluator.run(policy_for(task, weight=-0.3))
    assert evaluator.run(policy) == first
    assert Evaluator(task).run(policy) == first
    evaluator.close()
    assert evaluator.run(policy) == first


def test_stochastic_actions_are_those_of_the_episode():
    policy = policy_for(Lottery, log_std=-1.0)
    (episode,) = Evaluator(Lottery, episodes=1).run(policy, deterministic=False)
    generator = noise_generator(EVALUATION_SEED)
    noise = [generator.standard_normal(2, dtype=np.float32) for _ in range(episode.length)]
    # Actions 1 + 2 tanh(noise / e) in each of two dimensions.
    expected = sum(float(np.sum(1 + 2 * np.tanh(np.exp(-1.0) * part))) for part in noise)
    assert episode.episode_return == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("seed", [0, 7, EVALUATION_SEED])
def test_task_policy_and_noise_have_streams_of_their_own(seed):
    noise = Noise()
    noise.set({"observation_noise": 1.0, "action_noise": 1.0}, seed)
    zeros, ones = np.zeros(100, np.float32), np.full(100, 1e9, np.float32)
    children = np.random.default_rng(seed).spawn(3)  # as a task may have generators of its own
    streams = [
        noise.on_observation(zeros),
        noise.on_action(zeros, -ones, ones) / 1e9,
        noise_generator(seed).standard_normal(100, dtype=np.float32),
        *(generator.standard_normal(100, dtype=np.float32) for generator in [np.random.default_rng(seed), *children]),
    ]
    correlations = np.corrcoef(streams) - np.eye(len(streams))
    assert np.abs(correlations).max() < 0.5


def test_the_environments_are_made_once_and_only_as_many_as_needed():
    made = []

    def task() -> gymnasium.Env:
        made.append(1)
        return probes.ConstantReward()

    evaluator = Evaluator(task, episodes=3)
    assert made == []
    policy = policy_for(probes.ConstantReward)
    evaluator.run(policy)
    evaluator.run(policy)
    assert len(made) == 3
    evaluator = Evaluator(task, episodes=35)
    evaluator.run(policy)
    assert len(made) == 3 + EPISODES_AT_ONCE


@pytest.mark.parametrize(
    ("told", "success"),
    [
        *(({"is_success": verdict}, None) for verdict in ("no", b"yes", None, float("nan"), [], object(), {})),
        *(({"is_success": verdict}, 0.0) for verdict in (False, 0.0, np.array([True, False]))),
        *(({"is_success": verdict}, 1.0) for verdict in (np.True_, 1, [[True], [True]])),
        ({"is_success": None, "success": True}, 1.0),
        ({"is_success": "no", "success": 0}, 0.0),
        ({"is_success": False, "success": True}, 0.0),
        ({"is_success": None, "success": "yes"}, None),
    ],
)
def test_success_is_a_boolean_or_a_number_or_it_is_not_known(told, success):
    assert _success(told) == success


@pytest.mark.parametrize("key", ["is_success", "success"])
def test_success_is_what_the_last_step_says(key):
    for bias, success in ((9.0, 1.0), (0.0, 0.0)):
        episodes = Evaluator(Goal, {"success_key": key}, episodes=2).run(policy_for(Goal, bias=bias))
        assert [episode.success for episode in episodes] == [success, success]


def test_episodes_are_offered_with_all_that_is_known_of_them():
    policy = policy_for(Goal, bias=9.0)
    for evaluated in (policy, Foreign(policy)):
        episodes = evaluate_episodes(evaluated, Goal, episodes=3, events=("is_success", "missing"))
        assert episodes == [
            EvaluationEpisode(number, 2.0, 2, 1.0, {"is_success": True, "missing": None}) for number in range(3)
        ]
    np.testing.assert_array_equal(evaluate(policy, Goal, episodes=3), [2.0, 2.0, 2.0])


@pytest.mark.parametrize(
    ("task", "arguments", "message"),
    [
        (probes.Failing, {"at": 2}, "at step 1: step raised RuntimeError: the simulator broke"),
        (probes.Failing, {"where": "reset"}, "at step 0: reset raised RuntimeError: the simulator broke"),
        (probes.NonFinite, {"at": 3}, "at step 2: reward is nan"),
        (probes.NonFinite, {"where": "observation"}, r"at step 0: observation\[0\] is nan"),
    ],
)
def test_an_environment_that_fails_is_named(task, arguments, message):
    seed = EVALUATION_SEED + 4
    evaluator = Evaluator(task, {**arguments, "seeds": [seed]})
    with pytest.raises(EvaluationFailure, match=f"evaluation episode 4, reset with seed {seed}, {message}"):
        evaluator.run(policy_for(probes.Endless))


class Fragile(probes.Endless):
    """Breaks for good at an action below zero."""

    is_broken = False

    def step(self, action):
        self.is_broken |= bool(action < 0.0)
        if self.is_broken:
            raise RuntimeError("it is broken")
        return super().step(action)


def test_what_a_policy_has_broken_is_not_the_next_policy_s():
    evaluator, good = Evaluator(Fragile, {"length": 3}, episodes=2), policy_for(probes.Endless, bias=1.0)
    alone = evaluator.run(good)
    with pytest.raises(EvaluationFailure, match="it is broken"):
        evaluator.run(policy_for(probes.Endless, bias=-1.0))
    assert evaluator.run(good) == alone


def test_a_policy_that_is_not_a_number_fails():
    with pytest.raises(EvaluationFailure, match=r"action\[0\] is nan"):
        evaluate(policy_for(probes.Endless, bias=float("nan")), probes.Endless, episodes=1)


def test_a_policy_of_another_task_is_refused():
    with pytest.raises(
        InputError, match=r"trained on observations \(1,\) and actions \(1,\); Lottery has \(3,\) and \(2,\)"
    ):
        evaluate(policy_for(probes.Endless), Lottery)
    with pytest.raises(InputError, match=r"Goal has at \(\), goal \(2,\) and \(2, 1\)"):
        evaluate(policy_for(Lottery), Goal)


@pytest.mark.parametrize(
    ("trained_on", "task", "is_warned"),
    [
        ("HalfCheetah-v4", "Walker2d-v4", True),
        ("Walker2d-v5", "Walker2d-v4", True),
        ("Walker2d-v4", "Walker2d-v4", False),
        ("mine:Walker2d-v4", "Walker2d-v4", False),  # the module may have been imported already
        ("make_walker", "Walker2d-v4", False),  # a Python function, of whatever
        (None, "Walker2d-v4", False),
        ("HalfCheetah-v4", lambda: gymnasium.make("Walker2d-v4"), False),
    ],
)
def test_a_policy_of_another_task_of_the_same_sizes_is_warned_of(trained_on, task, is_warned):
    policy = policy_for("Walker2d-v4")
    policy = Policy(policy.network, dataclasses.replace(policy.contract, task=trained_on))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert evaluate(policy, task, episodes=1).shape == (1,)
    assert [str(trained_on) in str(warning.message) for warning in told] == [True] * is_warned


@pytest.mark.parametrize(("low", "high", "is_taken"), [(-1.0, 3.0, True), (0.0, 1.0, True), (-1.0, 3.1, False)])
def test_a_policy_is_refused_where_its_actions_leave_the_tasks_bounds(low, high, is_taken):
    policy = policy_for(Lottery)
    for rounding in (0.0, 1e-7):
        ends = (np.full(2, (1.0 + rounding) * end, np.float32) for end in (low, high))
        names = ("action_low", "action_high")
        other = Policy(policy.network, dataclasses.replace(policy.contract, **dict(zip(names, ends, strict=True))))
        if is_taken:
            assert evaluate(other, Lottery, episodes=1).shape == (1,)
        else:
            with pytest.raises(InputError, match=r"action\[0\] is between -1 and 3.1; Lottery takes -1 to 3"):
                evaluate(other, Lottery, episodes=1)


class Foreign:
    """Somebody else's policy, with nothing but `predict`; it counts its steps in its state."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.calls: list[tuple] = []

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.calls.append((observation, state, episode_start, deterministic))
        action, _ = self.policy.predict(observation)
        return action, (state or 0) + 1


def test_any_object_that_predicts_is_evaluated_alike():
    policy = policy_for(Lottery, weight=0.7)
    ours = evaluate(policy, Lottery, episodes=13)
    assert ours.shape == (13,)
    assert ours.dtype == np.float64
    np.testing.assert_allclose(evaluate(Foreign(policy), Lottery, episodes=13), ours, rtol=1e-5)


def test_a_foreign_policy_meets_the_same_episodes_again():
    foreign = Foreign(policy_for(GlobalGenerator))
    once, again = (evaluate(foreign, GlobalGenerator, episodes=3).tolist() for _ in range(2))
    assert once == again
    assert len(set(once)) == 3


def test_a_foreign_policy_sees_raw_observations_its_state_and_the_starts():
    foreign = Foreign(policy_for(Goal))
    assert evaluate(foreign, Goal, episodes=2, deterministic=False).tolist() == [2.0, 2.0]
    observations, states, starts, flags = zip(*foreign.calls, strict=True)
    assert [observation["at"] for observation in observations] == [0.0, 1.0, 0.0, 1.0]
    assert states == (None, 1, None, 1)
    assert [start.tolist() for start in starts] == [[True], [False], [True], [False]]
    assert set(flags) == {False}


def test_a_foreign_action_of_the_wrong_shape_is_named():
    class Batched:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.zeros((1, 2)), state

    with pytest.raises(EvaluationFailure, match=r"action has shape \(1, 2\) where its space has \(2,\)"):
        evaluate(Batched(), Lottery)


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"episodes": 0}, "episodes"),
        ({"episodes": "3"}, "episodes"),
        ({"episodes": 1, "first_seed": -5}, "first_seed"),
        ({"deterministic": "no"}, "deterministic"),
        ({"events": "hit"}, "hit"),
        ({"events": ["return"]}, "return"),
        ({"perturbations": "wind=2"}, "wind"),
    ],
)
def test_a_wrong_argument_is_named(given, name):
    policy = policy_for(Lottery)
    for evaluated in (policy, Foreign(policy)):
        with pytest.raises(InputError, match=name):
            evaluate_episodes(evaluated, Lottery, **given)


@pytest.mark.parametrize("answer", [np.zeros(2), (np.zeros(2), None, None)])
def test_what_cannot_predict_is_refused(answer):
    class Other:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return answer

    with pytest.raises(InputError, match=r"predict of a Other must return \(action, state\), not "):
        evaluate(Other(), Lottery)
    for given in ({}, Policy):
        with pytest.raises(InputError, match="has no predict"):
            evaluate(given, Lottery)


def test_reports_use_other_episodes_than_training():
    policy = policy_for(Lottery)
    fresh = [episode.episode_return for episode in Evaluator(Lottery, first_seed=FRESH_EVALUATION_SEED).run(policy)]
    np.testing.assert_array_equal(evaluate(policy, Lottery, episodes=10), fresh)
    assert FRESH_EVALUATION_SEED - EVALUATION_SEED >= 1_000_000


def test_an_episode_that_never_ends_is_broken_off(monkeypatch):
    monkeypatch.setattr("csac.evaluation.evaluator.LONGEST_EPISODE", 30)
    evaluator = Evaluator(lambda: probes.Endless(length=10**9), episodes=2)
    assert [episode.length for episode in evaluator.run(policy_for(probes.Endless))] == [30, 30]
