"""Whether two devices learn the same: what is compared, with the CPU in both places."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
import pytest

from benchmarks.workers import agreement


class Device(NamedTuple):
    """The CPU, said to be a GPU."""

    device_kind: str


@pytest.fixture(scope="module")
def state():
    """What two seeds have learnt in two updates."""
    return agreement.learnt(jax.devices("cpu")[0], updates=2, preset="paper")


def test_what_a_device_learns_agrees_with_itself(state):
    assert len(state) == 2
    assert agreement.largest_difference(state, state) == 0.0


def test_critics_and_optimisers_are_compared_too(state):
    """Halving all of a part makes a difference of a half of its largest number."""
    for name in ("actor", "critics", "target_critics", "critic_optimiser"):
        other = state[1]._replace(**{name: jax.tree.map(lambda leaf: leaf * 0.5, getattr(state[1], name))})
        assert agreement.largest_difference(state, [state[0], other]) == pytest.approx(0.5, rel=1e-3), name


def test_what_is_no_number_is_a_difference():
    ours, theirs = {"a": np.ones(2), "b": np.ones(2)}, {"a": np.array([1.0, np.nan]), "b": np.ones(2)}
    assert np.isnan(agreement.largest_difference(ours, theirs))


def test_the_measurement_tells_of_the_gpu(state, monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda kind: [Device("a GPU" if kind == "gpu" else kind)])
    monkeypatch.setattr(agreement, "compute_as_csac_does", lambda: None)  # for other tests' numbers stay what they are
    monkeypatch.setattr(agreement, "learnt", lambda device, updates, preset: state)
    assert agreement.measure(0) == {"device": "a GPU"}
    told = {"device": "a GPU", "preset": "strong", "updates": 2, "largest_difference": 0.0}
    assert agreement.measure(2, "strong") == told


def test_the_preset_is_the_one_that_is_compared():
    (first, _) = agreement.learnt(jax.devices("cpu")[0], updates=1, preset="strong")
    assert first.target_critics is None
