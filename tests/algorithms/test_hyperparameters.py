"""Hyperparameters out of their range are refused, by name and value."""

from __future__ import annotations

import math
from typing import Any

import pytest

from csac.algorithms import ALGORITHMS, CSAC, SAC
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
