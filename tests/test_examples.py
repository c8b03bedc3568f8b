"""The examples that speak of the theory print what the theory says."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest

LAG = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[1] / "examples" / "reference_lag.py")))


@pytest.mark.parametrize(("tau", "expected"), [(0.05, 0.9), (0.5, 0.9), (5.0, 5.0 / 5.2), (50.0, 50.0 / 50.2)])
def test_an_iteration_leaves_the_larger_of_alpha_and_the_discount(tau, expected):
    # Values shrink by γ = 0.9, advantages by α = τ / (τ + 0.2): 0.2, 0.71, 0.96 and 0.996.
    assert LAG.contraction(0.2, tau, 0.9) == pytest.approx(expected, abs=3e-3)


@pytest.mark.parametrize(
    ("choice", "lag"),
    [
        (LAG.Choice("algorithm1"), 0.0),
        (LAG.Choice("previous"), 1.0),
        (LAG.Choice("average", rate=0.05), 20.0),
        (LAG.Choice("average", rate=1.0), 1.0),  # which is `previous`
        (LAG.Choice("periodic", period=1), 0.0),  # which is `algorithm1`
    ],
)
def test_a_reference_slows_down_by_its_lag(choice, lag):
    # 0.01·0.5 / 0.5² = 0.02 of the way back to the reference in each update: 1 + 0.02 x lag times as long.
    assert LAG.predicted_slow_down(choice, 0.02) == pytest.approx(1 + 0.02 * lag)
    assert LAG.measured_slow_down(choice, 0.5, 0.5, 0.01, updates=600) == pytest.approx(1 + 0.02 * lag, rel=1e-3)


@pytest.mark.parametrize(("tau", "lag"), [(0.25, 49.5), (50.0, 100.0)])
def test_a_period_lags_by_half_of_it_and_by_all_of_it_where_it_holds_fast(tau, lag):
    choice, resistance = LAG.Choice("periodic", period=100), 0.001 * tau / 0.5**2
    expected = 1 + resistance * lag if tau < 1 else resistance * lag
    assert LAG.predicted_slow_down(choice, resistance) == pytest.approx(expected, rel=1e-3)
    assert LAG.measured_slow_down(choice, tau, 0.5, 0.001, updates=800) == pytest.approx(expected, rel=1e-3)
