"""Hyperparameters out of their range are refused, by name and value."""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from csac.algorithms import ALGORITHMS, CSAC, PPO, SAC, SD3, TD3
from csac.algorithms.hyperparameters import without_effect
from csac.types import InputError

OFF_POLICY = (CSAC, SAC, TD3, SD3)
SHARED = {
    "discount": [-0.1, 1.0, math.nan],
    "target_rate": [0.0, 1.1],
    "actor_learning_rate": [0.0, -1e-3, math.inf, 10**400, 1e-46],
    "actor_hidden_sizes": [(0,), (64, -1), (64, 1.5), ("64",), 64, "64", None, (True,)],
    "batch_size": [0, -1, 1.5, True, "256", 2**31],
    "replay_size": [0, 1e6],
    "warmup_steps": [-1, 0.5],
    "max_gradient_norm": [-1.0, math.inf],
    "adam_momentum": [1.0, 0.99999999],  # which is 1 in 32 bits
}
OWN = {
    CSAC: {
        "entropy_weight": [-0.1, math.nan, math.inf, "0.2", "automatic", None, True, 1e39],
        "relative_entropy_weight": [-0.5, math.nan],
        "reference_policy": ["algorithm2", None],
        "reference_period": [0, 2.5],
        "reference_rate": [0.0, 1.5],
    },
    SAC: {"entropy_weight": ["fixed"], "initial_entropy_weight": [0.0], "target_entropy": [math.inf, "-3", -1e39]},
    TD3: {"policy_delay": [0, 1.5], "target_noise_clip": [-0.5], "exploration_std": [-0.1]},
    SD3: {"noise_samples": [0], "inverse_temperature": [-0.1, math.inf], "importance_sampling": [1]},
    PPO: {"normalise_rewards": [0, "no", None], "clip_range": [0.0], "entropy_weight": ["auto"]},
}
CASES = [(CSAC, *case) for case in SHARED.items()] + [(kind, *case) for kind in OWN for case in OWN[kind].items()]


@pytest.mark.parametrize(("algorithm", "name", "values"), CASES)
def test_bad_values_are_refused(algorithm, name, values):
    for value in values:
        with pytest.raises(InputError) as error:
            algorithm(**{name: value})
        message = str(error.value)
        assert message.startswith(f"{name} must be ")
        assert f"not {value!r}" in message
        assert "\n" not in message


def test_the_edges_of_the_ranges_are_accepted():
    CSAC(entropy_weight=0.0, relative_entropy_weight=0, discount=0.0, target_rate=1.0, reference_rate=1.0)
    CSAC(reference_period=1, batch_size=1, replay_size=1, warmup_steps=0, max_gradient_norm=0, actor_hidden_sizes=())
    SAC(target_entropy=-3, entropy_weight=0)


def test_numbers_of_numpy_become_those_of_python():
    given: dict[str, Any] = {
        "discount": np.float32(0.5),
        "batch_size": np.int64(8),
        "max_gradient_norm": np.int32(1),
        "actor_hidden_sizes": [np.int64(8), 4],
        "entropy_weight": np.str_("auto"),
        "target_entropy": np.float16(-2),
    }
    ours = SAC(**given)
    plain = SAC(discount=0.5, batch_size=8, max_gradient_norm=1.0, actor_hidden_sizes=(8, 4), target_entropy=-2.0)
    assert ours == plain
    assert json.loads(json.dumps(vars(ours))) == json.loads(json.dumps(vars(plain)))  # as the manifest holds it
    assert hash(ours) is not None  # a static argument of compiled programs
    wrong: list[Any] = [np.float32("nan"), np.True_, np.array([0.5])]
    for value in wrong:
        with pytest.raises(InputError, match="discount must be a finite number"):
            SAC(discount=value)


@pytest.mark.parametrize(
    ("algorithm", "name", "value"),
    [(CSAC, "entropy_weight", 10**10), (SAC, "target_entropy", -3), (SD3, "discount", Fraction(99, 100))],
)
def test_a_number_is_kept_as_a_float_where_floats_belong(algorithm, name, value):
    kept = getattr(algorithm(**{name: value}), name)
    assert type(kept) is float
    assert kept == float(value)


def test_every_number_has_a_range():
    """A hyperparameter that is added without a range would be accepted whatever it is."""
    for algorithm in ALGORITHMS.values():
        for name, value in vars(algorithm()).items():
            if isinstance(value, int | float) and name != "target_entropy_per_dimension":  # any number
                settings: dict[str, Any] = {name: -1}
                with pytest.raises(InputError, match=name):
                    algorithm(**settings)


def test_bounds_are_inclusive_in_32_bits():
    assert SAC(updates_per_step=0.01).updates_per_step == 0.01


def test_hyperparameters_without_effect_are_told():
    assert without_effect(CSAC(entropy_weight="auto")) == {"reference_period": "reference_policy average"}
    assert without_effect(SAC(entropy_weight=0.2))["target_entropy"] == "entropy_weight 0.2"
    assert without_effect(TD3()) == {}


@pytest.mark.parametrize("algorithm", OFF_POLICY)
def test_a_replay_holds_a_batch_and_a_normalised_batch_has_a_spread(algorithm):
    with pytest.raises(InputError, match="replay_size must be at least batch_size, 256, not 255"):
        algorithm(replay_size=255)
    algorithm(replay_size=256)
    if algorithm is not SD3:
        with pytest.raises(InputError, match="batch_size of at least 2"):
            algorithm(critic_normalisation="batch", batch_size=1)


def test_minibatches_are_equal_parts_of_more_than_one_transition():
    cases: list[dict[str, Any]] = [{"minibatches": 30}, {"rollout_steps": 16}, {"rollout_steps": 8, "minibatches": 8}]
    for settings in cases:
        with pytest.raises(InputError, match="minibatches"):
            PPO(**settings)


@pytest.mark.parametrize(
    ("algorithm", "given", "told"),
    [
        (SAC, {"gamma": 0.9}, "'gamma': it is discount here"),
        (CSAC, {"discount": 0.9, "buffer_size": 8}, "'buffer_size': it is replay_size here"),
        (SAC, {"learning_rate": 1}, "'learning_rate': it is actor_learning_rate and critic_learning_rate here"),
        (SAC, {"temperature": "automatic"}, "'temperature': it is entropy_weight (a number, or auto) here"),
        (SAC, {"temperature_learning_rate": 1e-3}, "'temperature_learning_rate': it is weight_learning_rate here"),
        (SAC, {"ent_coef": "auto"}, "'ent_coef': it is entropy_weight here"),
        (PPO, {"batch_size": 64}, "'batch_size': it is minibatches (their number) here"),
        (TD3, {"discont": 0.9}, "'discont': did you mean discount?"),
        (SD3, {"verbose": 1}, "'verbose'"),
    ],
)
def test_a_hyperparameter_of_another_name_is_refused_with_what_it_is_called_here(algorithm, given, told):
    with pytest.raises(InputError) as refusal:
        algorithm(**given)
    assert str(refusal.value) == f"{algorithm.__name__} has no hyperparameter {told}"


def test_a_copy_with_a_hyperparameter_of_another_name_is_refused_alike():
    changes: dict[str, Any] = {"tau": 0.01}
    with pytest.raises(InputError, match=r"SAC has no hyperparameter 'tau'.*target_rate"):
        dataclasses.replace(SAC(), **changes)
    assert dataclasses.replace(SAC(), target_rate=0.01) == SAC(target_rate=0.01)


def test_an_algorithm_shows_its_hyperparameters_to_whoever_asks():
    for algorithm in ALGORITHMS.values():
        names = [field.name for field in dataclasses.fields(algorithm)]
        assert list(inspect.signature(algorithm).parameters) == names
