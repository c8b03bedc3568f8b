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
from csac.types import InputError

BOTH = {
    "entropy_weight": [-0.1, math.nan, math.inf, "0.2", None, True],
    "discount": [-0.1, 1.0, math.nan],
    "target_rate": [0.0, 1.1],
    "actor_learning_rate": [0.0, -1e-3, math.inf],
    "critic_learning_rate": [0.0, -1e-3],
    "actor_hidden_sizes": [(0,), (64, -1), (64, 1.5), ("64",), 64, "64", None, (True,)],
    "critic_hidden_sizes": [(0,), 64],
    "batch_size": [0, -1, 1.5, True, "256"],
    "replay_size": [0, 1e6],
    "warmup_steps": [-1, 0.5],
    "updates_per_step": [0, 0.5],
    "update_interval": [0, 2.5],
    "max_gradient_norm": [-1.0, math.inf],
}
CSAC_ONLY = {
    "relative_entropy_weight": [-0.5, math.nan],
    "reference_policy": ["algorithm2", None],
    "reference_period": [0, 2.5],
    "reference_rate": [0.0, 1.5],
    "relative_entropy_estimator": ["exact"],
}
SAC_ONLY = {"temperature": ["auto"], "target_entropy": [math.inf, "-3"], "temperature_learning_rate": [0.0]}
CASES = [
    (algorithm, name, value)
    for algorithm, fields in ((CSAC, BOTH | CSAC_ONLY), (SAC, BOTH | SAC_ONLY))
    for name, values in fields.items()
    for value in values
]


@pytest.mark.parametrize(("algorithm", "name", "value"), CASES)
def test_bad_values_are_refused(algorithm, name, value):
    with pytest.raises(InputError) as error:
        algorithm(**{name: value})
    message = str(error.value)
    assert name in message
    assert repr(value) in message
    assert "\n" not in message


def test_the_edges_of_the_ranges_are_accepted():
    CSAC(entropy_weight=0.0, relative_entropy_weight=0, discount=0.0, target_rate=1.0, reference_rate=1.0)
    CSAC(reference_period=1, batch_size=1, replay_size=1, warmup_steps=0, max_gradient_norm=0, actor_hidden_sizes=())
    SAC(target_entropy=None)
    SAC(target_entropy=-3, temperature="fixed", entropy_weight=0)


def test_numbers_of_numpy_are_numbers():
    given: dict[str, Any] = {
        "discount": np.float32(0.5),
        "target_rate": np.float64(0.25),
        "batch_size": np.int64(8),
        "max_gradient_norm": np.int32(1),
        "actor_hidden_sizes": [np.int64(8), 4],
        "temperature": np.str_("fixed"),
        "target_entropy": np.float16(-2),
    }
    ours, plain = SAC(**given), SAC("fixed", 1.0, -2.0, 0.5, 0.25, actor_hidden_sizes=(8, 4), batch_size=8)
    assert ours == dataclasses.replace(plain, max_gradient_norm=1)
    assert json.loads(json.dumps(vars(ours)))["discount"] == 0.5  # as the manifest holds it
    assert hash(ours) is not None  # a static argument of compiled programs


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("discount", np.float32("nan"), "a finite number, not nan"),
        ("discount", np.float64(1.5), "less than 1, not 1.5"),
        ("discount", np.True_, "a finite number, not True"),
        ("discount", np.array([0.5]), "a finite number"),
        ("batch_size", np.float64(8), "a whole number, not 8.0"),
        ("actor_hidden_sizes", (np.int64(0),), "at least 1"),
        ("actor_hidden_sizes", np.array([8, 8]), "a tuple"),
        ("temperature", np.array([0.1, 0.2]), "one of automatic, fixed"),
    ],
)
def test_bad_values_of_numpy_are_refused(name, value, words):
    settings: dict[str, Any] = {name: value}
    with pytest.raises(InputError, match=words):
        SAC(**settings)


def test_an_automatic_temperature_cannot_begin_at_zero():
    with pytest.raises(InputError, match="entropy_weight"):
        SAC(entropy_weight=0.0)


def test_every_number_has_a_range():
    """A hyperparameter that is added without a range would be accepted whatever it is."""
    for algorithm in ALGORITHMS.values():
        for name, value in vars(algorithm()).items():
            if isinstance(value, int | float):
                settings: dict[str, Any] = {name: -1}
                with pytest.raises(InputError, match=name):
                    algorithm(**settings)


def test_numbers_beyond_what_programs_count_with():
    cases: list[tuple[dict[str, Any], str]] = [
        ({"reference_period": 10**10}, "reference_period must be at most 2,147,483,647, not 10000000000"),
        ({"policy_delay": 2**31}, "policy_delay must be at most 2,147,483,647"),
        ({"discount": 10**400}, "discount must be a finite number"),
        ({"actor_learning_rate": 10**400}, "actor_learning_rate must be a finite number"),
    ]
    for settings, words in cases:
        with pytest.raises(InputError, match=words):
            CSAC(**settings)


@pytest.mark.parametrize(
    ("algorithm", "settings", "words"),
    [
        (CSAC, {"entropy_weight": 1e39}, "entropy_weight must be a number that 32 bits can hold.*not 1e\\+39"),
        (PPO, {"clip_range": 10**39}, "clip_range must be a number that 32 bits can hold, 1.2e-38 to 3.4e"),
        (SAC, {"target_entropy": -1e39}, "target_entropy must be a number that 32 bits can hold"),
        (TD3, {"max_gradient_norm": 1e-46}, "max_gradient_norm must be a number that 32 bits can hold"),
        (SAC, {"adam_momentum": 0.99999999}, "adam_momentum must be .*less than 1 in 32 bits, not 0.99999999"),
        (CSAC, {"discount": 1 - 1e-9}, "discount must be at least 0 and less than 1 in 32 bits, not 0.999999999"),
    ],
)
def test_numbers_that_32_bits_make_others_of_are_refused(algorithm, settings, words):
    with pytest.raises(InputError, match=words):
        algorithm(**settings)


@pytest.mark.parametrize(
    ("algorithm", "name", "value"),
    [
        (CSAC, "entropy_weight", 10**10),  # more than JAX takes of a whole number
        (CSAC, "relative_entropy_weight", 1),
        (SAC, "target_entropy", -(10**10)),
        (TD3, "max_gradient_norm", 0),
        (SD3, "discount", Fraction(99, 100)),
        (PPO, "clip_range", np.int64(1)),
    ],
)
def test_a_number_is_kept_as_a_float_where_floats_belong(algorithm, name, value):
    kept = getattr(algorithm(**{name: value}), name)
    assert type(kept) is float
    assert kept == float(value)


@pytest.mark.parametrize("algorithm", [CSAC, SAC, TD3])
def test_one_transition_has_no_spread_to_normalise_by(algorithm):
    with pytest.raises(InputError, match="critic_normalisation batch needs a batch_size of at least 2"):
        algorithm(critic_normalisation="batch", batch_size=1)
    algorithm(critic_normalisation="batch", batch_size=2)


@pytest.mark.parametrize("algorithm", [CSAC, SAC, TD3, SD3])
def test_a_replay_holds_a_batch(algorithm):
    with pytest.raises(InputError, match="replay_size must be at least batch_size, 256, not 255"):
        algorithm(replay_size=255)
    algorithm(replay_size=256)


@pytest.mark.parametrize(
    ("algorithm", "given", "told"),
    [
        (SAC, {"gamma": 0.9}, "SAC has no hyperparameter 'gamma': it is discount here"),
        (CSAC, {"discount": 0.9, "buffer_size": 8}, "CSAC has no hyperparameter 'buffer_size': it is replay_size here"),
        (SAC, {"learning_rate": 1}, "'learning_rate': it is actor_learning_rate and critic_learning_rate here"),
        (SAC, {"autotune": True}, "SAC has no hyperparameter 'autotune': it is temperature=\"automatic\" here"),
        (SAC, {"ent_coef": "auto"}, "SAC has no hyperparameter 'ent_coef': it is temperature or entropy_weight here"),
        (CSAC, {"ent_coef": "auto"}, "CSAC has no hyperparameter 'ent_coef': it is entropy_weight here"),
        (PPO, {"batch_size": 64}, "PPO has no hyperparameter 'batch_size': it is minibatches (their number) here"),
        (TD3, {"discont": 0.9}, "TD3 has no hyperparameter 'discont': did you mean discount?"),
        (SD3, {"verbose": 1}, "SD3 has no hyperparameter 'verbose'"),
        (SAC, {"entropy_weight": "auto"}, "a finite number, not 'auto': it adapts with temperature=\"automatic\""),
        (SAC, {"temperature": 0.2}, 'not 0.2: write temperature="fixed", entropy_weight=0.2'),
        (PPO, {"entropy_weight": "auto"}, "entropy_weight must be a finite number, not 'auto'"),
    ],
)
def test_what_other_libraries_call_it_is_told_in_python_too(algorithm, given, told):
    with pytest.raises(InputError) as refusal:
        algorithm(**given)
    assert str(refusal.value).endswith(told)


def test_a_copy_with_a_hyperparameter_of_another_name_is_refused_alike():
    changes: dict[str, Any] = {"tau": 0.01}
    with pytest.raises(InputError, match="SAC has no hyperparameter 'tau': it is target_rate here"):
        dataclasses.replace(SAC(), **changes)
    assert dataclasses.replace(SAC(), target_rate=0.01) == SAC(target_rate=0.01)


def test_an_algorithm_shows_its_hyperparameters_to_whoever_asks():
    for algorithm in ALGORITHMS.values():
        names = [field.name for field in dataclasses.fields(algorithm)]
        assert list(inspect.signature(algorithm).parameters) == names
