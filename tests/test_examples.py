"""The examples that speak of the theory print what the theory says."""

from __future__ import annotations

import math
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
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


NEAR_THE_END = [LAG.Choice("previous"), LAG.Choice("average", rate=0.05), LAG.Choice("periodic", period=20)]


@pytest.mark.parametrize("choice", [LAG.Choice("algorithm1"), *NEAR_THE_END])
@pytest.mark.parametrize("tau", [0.5, 5.0])
def test_half_of_the_distance_is_gone_when_theory_says_so(choice, tau):
    weights = LAG.Weights(0.2, tau)  # τ = 0.5 lengthens the way with `previous` by 2 %, and with the others by more
    predicted = LAG.predicted_half_life(choice, weights, 0.5, 0.01)
    assert LAG.measured_half_life(choice, weights, 0.5, 0.01) == pytest.approx(predicted, rel=0.01)


@pytest.mark.parametrize(("choice", "lag"), zip(NEAR_THE_END, (1.0, 20.0, 9.5), strict=True))
def test_a_short_lag_adds_itself_times_tau_by_sigma(choice, lag):
    # An update goes 1e-4·0.2 / 0.5² = 1 / 12,500 of the way by itself; τ / σ is 25.
    by_itself = LAG.predicted_half_life(LAG.Choice("algorithm1"), LAG.Weights(0.2, 0.0), 0.5, 1e-4)
    longer = LAG.predicted_half_life(choice, LAG.Weights(0.2, 5.0), 0.5, 1e-4) - by_itself
    assert longer == pytest.approx(math.log(2) * 25 * lag, rel=0.03)


def test_a_long_lag_is_a_refresh():
    # Where the policy is done long before its reference is renewed, each renewal leaves α = 0.5 / 0.7 of the distance.
    weights, refreshes = LAG.Weights(0.2, 0.5), math.log(0.5) / math.log(0.5 / 0.7)
    periodic = LAG.predicted_half_life(LAG.Choice("periodic", period=5000), weights, 0.5, 0.01)
    assert periodic == pytest.approx(5000 * refreshes, rel=1e-6)
    # A running average is renewed all the time: 1 - α of the way in every 1 / rate updates.
    average = LAG.predicted_half_life(LAG.Choice("average", rate=1e-6), weights, 0.5, 0.01)
    assert average == pytest.approx(1e6 * math.log(2) * 0.7 / 0.2, rel=1e-3)


@pytest.mark.parametrize("choice", NEAR_THE_END)
def test_beyond_its_limit_a_step_back_is_larger_than_the_one_before(choice):
    def steps(share):
        tau = share * LAG.largest_stable_resistance(choice) * 0.5**2 / 0.01
        way = LAG.means(choice, LAG.Weights(0.0, tau), 0.5, 0.01, 40, LAG.even_pull)
        return np.abs(np.diff(np.asarray(way)))[-20:]  # one period

    stable, unstable = steps(0.9), steps(1.1)
    assert stable.max() < 2e-4  # of 1e-4 that Q alone moves it
    assert unstable[-1] > 3 * unstable[1] > 0
