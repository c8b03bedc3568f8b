"""Guards: known answers of the definition, then every format against it."""

from __future__ import annotations

import numpy as np
import pytest
from artefacts import exported
from policies import algorithm_policy, contract

from csac.deploy.guards import Guards, make_guards
from csac.types import InputError

TWO = contract(((None, (2,)),), (2,), low=-1.0, high=3.0)  # a range of 4, its middle 1
GOOD, NAN = [0.0, 0.0], [0.0, float("nan")]


def run_guards(steps: list[tuple[list[float], list[float]]], **given) -> list[list[float]]:
    guards, last, sent = make_guards(TWO, **given), None, []
    for observation, action in steps:
        last = guards.apply(np.array(action, np.float32), np.array(observation, np.float32), last, TWO)
        sent.append(last.tolist())
    return sent


def test_what_is_not_finite_gives_the_fallback():
    steps = [(GOOD, [2.0, 2.0]), (NAN, [2.0, 2.0]), (GOOD, [3.0, 3.0]), (GOOD, [float("inf"), 0.0])]
    assert run_guards(steps, fallback="middle") == [[2, 2], [1, 1], [3, 3], [1, 1]]
    assert run_guards(steps, fallback="zero") == [[2, 2], [0, 0], [3, 3], [0, 0]]
    assert run_guards(steps, fallback="-1,2.5") == [[2, 2], [-1, 2.5], [3, 3], [-1, 2.5]]
    assert run_guards(steps, fallback="last") == [[2, 2], [2, 2], [3, 3], [3, 3]]
    assert run_guards(steps[1:2], fallback="last") == [[1, 1]]  # none before: the middle


def test_the_rate_limit_is_a_share_of_the_range_and_holds_for_fallbacks_too():
    # A tenth of a range of 4 is 0.4 in a step; the first action is not limited.
    steps = [(GOOD, [3.0, -1.0]), (GOOD, [-1.0, 3.0]), (NAN, [0.0, 0.0]), (GOOD, [2.2, -0.2])]
    limited = run_guards(steps, fallback="zero", rate_limit=0.1)
    np.testing.assert_allclose(limited, [[3, -1], [2.6, -0.6], [2.2, -0.2], [2.2, -0.2]], atol=1e-6)


def test_a_rate_limit_alone_falls_back_on_the_last_action():
    steps = [(GOOD, [2.0, 2.0]), (NAN, [0.0, 0.0])]
    assert run_guards(steps, rate_limit=1.0) == [[2, 2]] * 2


def test_the_bound_of_a_task_in_float64_is_within_its_bounds():
    task = contract(((None, (2,)),), (1,), low=-np.pi, high=float(np.nextafter(np.float32(0.8), np.float32(0))))
    assert make_guards(task, fallback="0.8").fallback == task.action_high
    with pytest.raises(InputError, match="outside of the action's bounds"):
        make_guards(task, fallback="0.80001")


@pytest.mark.parametrize("fallback", ["half", "1", "1,4", "1,nan"])
def test_fallbacks_that_do_not_fit_are_refused(fallback):
    with pytest.raises(InputError, match=f"--fallback {fallback}"):
        make_guards(TWO, fallback=fallback)


@pytest.mark.parametrize("limit", [0.0, 1.1, float("nan")])
def test_limits_that_do_not_fit_are_refused(limit):
    with pytest.raises(InputError, match="--rate-limit"):
        make_guards(TWO, rate_limit=limit)


KINDS = [{"fallback": "0.25,-0.5,2"}, {"fallback": "last"}, {"rate_limit": 0.05}, {"fallback": "zero", "rate_limit": 1}]


@pytest.mark.parametrize("given", KINDS)
def test_every_format_guards_as_defined(tmp_path, format, given):
    policy = algorithm_policy("csac")
    guards = make_guards(policy.contract, **given)
    artefact = exported(tmp_path, policy, format, guards)
    for name, value in vars(guards).items():
        np.testing.assert_array_equal(getattr(artefact.guards, name), value)
    seen = np.random.default_rng(0).normal(size=(60, 5)).astype(np.float32)
    seen[5::7, 2] = np.nan
    seen[11::13, 0] = np.inf
    seen[30:34, 4] = -np.inf
    last = None
    for row, observation in enumerate(seen):
        if row == 45:
            artefact.reset()
            last = None
        action = policy.contract.to_environment(policy.act(observation[None])[0])
        last = guards.apply(action, observation, last, policy.contract)
        answer = artefact.act(observation)
        np.testing.assert_allclose(answer, last, atol=2e-5)
        assert np.isfinite(answer).all()
        answer *= 100.0  # as a controller may, in place: neither the fallback nor the state is the caller's


@pytest.mark.parametrize("algorithm", ["csac", "sd3"])
def test_every_format_sends_no_action_that_is_no_number(tmp_path, format, algorithm):
    """The observation is good, but a first layer overflows, and the second one sums infinities of both signs."""
    policy = algorithm_policy(algorithm)
    policy.network.parameters.actors[-1][0].weight[0] *= 1e6
    artefact = exported(tmp_path, policy, format, make_guards(policy.contract, "0.25,-0.5,2"))
    far = np.array([3e38, 0, 0, 0, 0], np.float32)
    assert np.isnan(policy.act(far[None])).all()
    np.testing.assert_array_equal(artefact.act(far), np.array([0.25, -0.5, 2.0], np.float32))


def test_without_guards_nothing_is_replaced():
    assert np.isnan(Guards().apply(np.full(2, np.nan), np.zeros(2), None, TWO)).all()
