"""Guards: known answers of the definition, then every format against it."""

from __future__ import annotations

import numpy as np
import pytest
from artefacts import HIGH, LOW, exported, leave
from policies import algorithm_policy, contract

from csac.deploy.guards import Guards, GuardState, guarded, make_guards
from csac.types import InputError

TWO = contract(((None, (2,)),), (2,), low=-1.0, high=3.0)  # a range of 4, its middle 1


def guards(**given) -> Guards:
    return make_guards(TWO, **given)


def run_guards(chosen: Guards, steps: list[tuple[list[float], list[float]]]) -> list[list[float]]:
    state = GuardState()
    return [
        guarded(chosen, state, TWO, np.array(seen, np.float32), np.array(action, np.float32)).tolist()
        for seen, action in steps
    ]


GOOD, NAN, FAR = [0.0, 0.0], [0.0, float("nan")], [5.0, 0.0]


def test_a_bad_observation_gives_the_fallback():
    steps = [(GOOD, [2.0, 2.0]), (NAN, [2.0, 2.0]), (GOOD, [3.0, 3.0]), (GOOD, [float("inf"), 0.0])]
    assert run_guards(guards(fallback="middle"), steps) == [[2, 2], [1, 1], [3, 3], [1, 1]]
    assert run_guards(guards(fallback="zero"), steps) == [[2, 2], [0, 0], [3, 3], [0, 0]]
    assert run_guards(guards(fallback="-1,2.5"), steps) == [[2, 2], [-1, 2.5], [3, 3], [-1, 2.5]]
    assert run_guards(guards(fallback="last"), steps) == [[2, 2], [2, 2], [3, 3], [3, 3]]
    assert run_guards(guards(fallback="last"), steps[1:2]) == [[1, 1]]  # none before: the middle


def test_what_is_out_of_range_is_bad_and_what_is_on_its_edge_is_not():
    chosen = guards(fallback="zero", observation_low=np.array([-5.0, -np.inf]), observation_high=np.array([5.0, 1.0]))
    steps = [(FAR, [2.0, 2.0]), ([5.001, 0.0], [2.0, 2.0]), ([-5.0, -1e30], [2.0, 2.0]), ([0.0, 1.1], [2.0, 2.0])]
    assert run_guards(chosen, steps) == [[2, 2], [0, 0], [2, 2], [0, 0]]


def test_the_watchdog_gives_up_after_so_many_bad_ones_in_a_row_and_stays_so():
    steps = [(NAN, [2.0, 2.0]), (GOOD, [2.0, 2.0]), (NAN, [2.0, 2.0]), (NAN, [2.0, 2.0]), (GOOD, [2.0, 2.0])]
    assert run_guards(guards(fallback="zero", watchdog=2), steps) == [[0, 0], [2, 2], [0, 0], [0, 0], [0, 0]]
    assert run_guards(guards(fallback="zero", watchdog=3), steps)[-1] == [2, 2]


def test_the_rate_limit_is_a_share_of_the_range_and_holds_for_fallbacks_too():
    # A tenth of a range of 4 is 0.4 in a step; the first action is not limited.
    steps = [(GOOD, [3.0, -1.0]), (GOOD, [-1.0, 3.0]), (NAN, [0.0, 0.0]), (GOOD, [2.2, -0.2])]
    limited = run_guards(guards(fallback="zero", rate_limit=0.1), steps)
    np.testing.assert_allclose(limited, [[3, -1], [2.6, -0.6], [2.2, -0.2], [2.2, -0.2]], atol=1e-6)


def test_a_rate_limit_alone_falls_back_on_the_last_action_whatever_else_is_asked_for():
    steps = [(GOOD, [2.0, 2.0]), (NAN, [0.0, 0.0]), (FAR, [0.0, 0.0]), (GOOD, [0.0, 0.0])]
    given = {"rate_limit": 1.0, "watchdog": 2, "observation_high": np.full(2, 4.0)}
    assert run_guards(guards(**given), steps) == [[2, 2]] * 4


def test_the_bound_of_a_task_in_float64_is_within_its_bounds():
    task = contract(((None, (2,)),), (1,), low=-np.pi, high=float(np.nextafter(np.float32(0.8), np.float32(0))))
    assert make_guards(task, fallback="0.8").fallback_action == task.action_high
    with pytest.raises(InputError, match="outside of the action's bounds"):
        make_guards(task, fallback="0.80001")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"fallback": "half"}, "it is zero, middle, last, or numbers"),
        ({"fallback": "1"}, "1 numbers where the task has 2 actions"),
        ({"fallback": "1,4"}, "outside of the action's bounds"),
        ({"fallback": "1,nan"}, "outside of the action's bounds"),
        ({"watchdog": 3}, "need a --fallback"),
        ({"observation_low": np.zeros(2)}, "need a --fallback"),
        ({"observation_high": np.zeros(2)}, "need a --fallback"),
        ({"watchdog": 0, "fallback": "zero"}, "at least 1"),
        ({"watchdog": 2**24 + 1, "fallback": "zero"}, "16,777,217 bad observations: give at most 16,777,216"),
        ({"rate_limit": 0.0}, "more than 0, at most 1"),
        ({"rate_limit": float("nan")}, "more than 0, at most 1"),
    ],
)
def test_guards_that_cannot_be_meant_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        guards(**given)


@pytest.mark.parametrize(
    "given",
    [
        {"fallback": "zero"},
        {"fallback": "0.25,-0.5,2"},
        {"fallback": "middle", "observation_low": LOW, "observation_high": HIGH},
        {"fallback": "last", "observation_low": LOW, "observation_high": HIGH},
        {"fallback": "middle", "watchdog": 3},
        {"rate_limit": 0.05},
        {"fallback": "last", "observation_low": LOW, "observation_high": HIGH, "watchdog": 4, "rate_limit": 0.02},
    ],
)
def test_every_format_guards_as_defined(tmp_path, format, given):
    policy = algorithm_policy("csac")
    chosen = make_guards(policy.contract, **given)
    artefact = exported(tmp_path, policy, format, guards=chosen)
    seen = np.random.default_rng(0).normal(size=(60, 5)).astype(np.float32)
    seen[5::7, 2] = np.nan
    seen[11::13, 0] = np.inf
    seen[30:34, 4] = -np.inf
    expected, state = [], GuardState()
    for row, observation in enumerate(seen):
        if row == 45:
            artefact.reset()
            state = GuardState()
        action = policy.contract.to_environment(policy.act(observation[None])[0])
        expected.append(guarded(chosen, state, policy.contract, observation, action))
        np.testing.assert_allclose(artefact.act(observation), expected[-1], atol=2e-5)
    assert np.isfinite(expected).all() or chosen.fallback is None


@pytest.mark.parametrize(
    "given", [{"fallback": "0.25,-0.5,2"}, {"fallback": "last"}, {"fallback": "zero", "watchdog": 2}]
)
def test_every_format_takes_no_action_that_is_no_number(tmp_path, format, given):
    """The observation is good, but the first layer overflows, and the second one sums infinities of both signs."""
    policy = algorithm_policy("csac")
    policy.network.parameters.actors[0][0].weight[0] *= 1e6
    chosen, state = make_guards(policy.contract, **given), GuardState()
    artefact = exported(tmp_path, policy, format, guards=chosen)
    good, far = np.zeros(5, np.float32), np.array([3e38, 0, 0, 0, 0], np.float32)
    assert np.isnan(policy.act(far[None])).all()
    for observation in (far, good, far, far, good):
        action = policy.contract.to_environment(policy.act(observation[None])[0])
        expected = guarded(chosen, state, policy.contract, observation, action)
        np.testing.assert_allclose(artefact.act(observation), expected, atol=2e-5)


@pytest.mark.parametrize("broken", [0, 1])
def test_every_format_falls_back_where_one_of_two_actors_gives_no_number(tmp_path, format, broken: int):
    policy = algorithm_policy("sd3")
    policy.network.parameters.actors[broken][0].weight[0] *= 1e6
    guards, state = make_guards(policy.contract, fallback="0.25,-0.5,2"), GuardState()
    artefact = exported(tmp_path, policy, format, guards=guards)
    far = np.array([3e38, 0, 0, 0, 0], np.float32)
    action = policy.contract.to_environment(policy.act(far[None])[0])
    expected = guarded(guards, state, policy.contract, far, action)
    np.testing.assert_array_equal(expected, guards.fallback_action)
    np.testing.assert_allclose(artefact.act(far), expected)


@pytest.mark.parametrize(
    "given", [{"fallback": "0.25,-0.5,2"}, {"fallback": "last"}, {"fallback": "0.25,-0.5,2", "rate_limit": 1.0}]
)
def test_an_action_is_the_callers_own(tmp_path, format, given):
    policy = algorithm_policy("csac")
    chosen = make_guards(policy.contract, **given)
    artefact, state = exported(tmp_path, policy, format, guards=chosen), GuardState()
    good, bad = np.zeros(5, np.float32), np.full(5, np.nan, np.float32)
    answers = []
    for observation in (good, bad, bad, good, bad):
        action = policy.contract.to_environment(policy.act(observation[None])[0])
        expected = guarded(chosen, state, policy.contract, observation, action)
        answer = artefact.act(observation)
        answers.append(answer.copy())
        np.testing.assert_allclose(answer, expected, atol=2e-5)
        answer *= 100.0  # as a controller may, in place
        expected *= 100.0
    np.testing.assert_array_equal(answers[1], answers[2])
    np.testing.assert_array_equal(answers[1], answers[4])
    if given["fallback"] != "last":
        np.testing.assert_array_equal(answers[1], np.array([0.25, -0.5, 2.0], np.float32))


def test_the_longest_watchdog_trips_in_a_graph_too(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    policy = algorithm_policy("csac")
    leave(tmp_path, policy, "onnx", guards=make_guards(policy.contract, "zero", watchdog=2**24))
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    good, bad = np.zeros((1, 5), np.float32), np.full((1, 5), np.nan, np.float32)
    state = np.array([[0, 0, 0, 1, 2**24 - 1]], np.float32)  # one bad step before it
    before = session.run(["action"], {"observation": good, "state": state})[0]
    np.testing.assert_allclose(before, policy.predict(good)[0], atol=2e-5)
    _, state = session.run(None, {"observation": bad, "state": state})
    np.testing.assert_array_equal(session.run(["action"], {"observation": good, "state": state})[0], np.zeros((1, 3)))


def test_guards_come_back_out_of_the_contract(tmp_path):
    policy = algorithm_policy("csac")
    chosen = make_guards(policy.contract, "last", LOW, HIGH, 4, 0.02)
    back = exported(tmp_path, policy, "numpy", guards=chosen).contract.guards
    for name, value in vars(chosen).items():
        np.testing.assert_array_equal(getattr(back, name), value)
