"""An artefact that computes other actions than its policy is found, and one that only rounds otherwise is not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from artefacts import NO_GUARDS, exported
from policies import ALGORITHMS, algorithm_policy

from csac.deploy.guards import make_guards
from csac.deploy.policy import Policy
from csac.deploy.verify import compare_actions
from csac.types import InputError, Layer

RECORDED = np.random.default_rng(0).normal(size=(100, 5)).astype(np.float32)


def nudged(policy: Policy, by: float) -> Policy:
    """The policy with the bias of its first action moved."""
    layers = policy.network.parameters.actors[0]
    moved = np.where(np.arange(layers[-1].bias.size) == 0, np.float32(by), np.float32(0.0))
    last = Layer(layers[-1].weight, layers[-1].bias + moved)
    parameters = policy.network.parameters._replace(actors=((*layers[:-1], last),))
    return Policy(policy.network._replace(parameters=parameters), policy.contract)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_policys_own_artefact_differs_by_rounding(tmp_path, algorithm):
    policy = algorithm_policy(algorithm)
    for guards in (NO_GUARDS, make_guards(policy.contract, "last", 0.05)):
        compared = compare_actions(exported(tmp_path, policy, "numpy", guards), policy, RECORDED)
        assert 1_090 <= compared.observations <= 1_100
        assert 0.0 < compared.largest < 2e-6 < 1e-5 <= compared.allowed


def test_a_difference_above_a_hundred_thousandth_of_the_range_is_refused(tmp_path):
    policy = algorithm_policy("csac")
    # tanh moves by at most as much as its argument, which is half of the share of the range.
    close = compare_actions(exported(tmp_path / "close", nudged(policy, 1e-5), "numpy"), policy, RECORDED)
    assert 1e-6 < close.largest < 1e-5
    with pytest.raises(InputError, match="the numpy artefact is not the policy of the run"):
        compare_actions(exported(tmp_path / "far", nudged(policy, 1e-4), "numpy"), policy, RECORDED)


def test_an_artefact_may_round_as_the_policy_itself_does(tmp_path):
    policy = algorithm_policy("csac")
    compared = compare_actions(exported(tmp_path, policy, "numpy"), policy, RECORDED * 1e5)
    assert compared.allowed > 2e-5
    assert compared.largest <= compared.allowed


def test_of_two_actors_that_are_valued_alike_either_may_be_chosen(tmp_path):
    # One critic for both that sees no action: the values are equal, and which is first is rounding's to say.
    policy = algorithm_policy("sd3")
    actors, critics = policy.network.parameters.actors, policy.network.parameters.critics
    blind = (Layer(critics[0][0].weight * np.repeat([1.0, 0.0], [5, 3])[:, None], critics[0][0].bias), *critics[0][1:])
    near = (*blind[:-1], Layer(blind[-1].weight, blind[-1].bias + np.float32(1e-9)))
    parameters = policy.network.parameters._replace(critics=(blind, near))
    swapped = parameters._replace(actors=actors[::-1], critics=(near, blind))
    policy, other = (Policy(policy.network._replace(parameters=one), policy.contract) for one in (parameters, swapped))
    compare_actions(exported(tmp_path, other, "numpy"), policy)


@pytest.mark.parametrize("change", [{"repeats_last": False}, {"largest_change": np.full(3, 0.126, np.float32)}])
def test_guards_that_differ_are_found(tmp_path, change):
    policy = algorithm_policy("csac")
    artefact = exported(tmp_path, policy, "numpy", make_guards(policy.contract, "last", 0.05))
    artefact.guards = dataclasses.replace(artefact.guards, **change)
    with pytest.raises(InputError, match="is not the policy of the run"):
        compare_actions(artefact, policy)
