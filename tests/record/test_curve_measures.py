"""What a learning curve tells, with the arithmetic worked out."""

import numpy as np
import pytest

from csac.record.curve_measures import area_under_curve, dispersion_within, drawdown, recovery, steps_to_reach


def rows_of(*evaluations):
    """Rows from (seed, step, return) triples."""
    return np.array(list(evaluations), [("seed", np.int64), ("step", np.int64), ("return", np.float64)])


def curve(*returns, seed=0):
    """One seed's evaluations at 100, 200, ..."""
    return [(seed, 100 * (number + 1), value) for number, value in enumerate(returns)]


def test_the_area_under_a_curve_worked_by_hand():
    # From 0 to 100: 100 (10 + 20) / 2 = 1500; to 300: 200 (20 + 0) / 2 = 2000; 3500 / 300 steps
    steps, returns = np.array([0, 100, 300]), np.array([10.0, 20.0, 0.0])
    assert area_under_curve(steps, returns) == pytest.approx(3500 / 300)
    assert area_under_curve(steps, np.array([10.0, np.nan, 0.0])) == 5.0
    assert np.isnan(area_under_curve(steps[:1], returns[:1]))


def test_a_threshold_is_reached_at_its_first_evaluation_or_not_at_all():
    steps, returns = np.array([100, 200, 300, 400]), np.array([1.0, np.nan, 5.0, 2.0])
    assert steps_to_reach(steps, returns, 1.0) == 100
    assert steps_to_reach(steps, returns, 2.0) == 300
    assert steps_to_reach(steps, returns, 5.1) == np.inf
    assert steps_to_reach(steps[:0], returns[:0], 0.0) == np.inf


def test_the_drawdown_is_the_largest_fall_and_not_the_last():
    assert drawdown(np.array([1.0, 10.0, 4.0, 12.0, 9.0])) == 6.0  # from 10 to 4
    assert drawdown(np.array([1.0, np.nan, 2.0])) == 0.0
    assert np.isnan(drawdown(np.array([])))


def test_dispersion_within_a_run_does_not_see_its_trend():
    # Changes 2, 2, 2, 2: no spread. Changes 4, -4, 4, -4, 4: quartiles -4 and 4.
    assert dispersion_within(np.array([0.0, 2.0, 4.0, 6.0, 8.0])) == 0.0
    assert dispersion_within(np.array([0.0, 4.0, 0.0, 4.0, 0.0, 4.0])) == 8.0
    assert np.isnan(dispersion_within(np.array([0.0, 4.0, np.nan])))


def test_recovery_worked_by_hand():
    """A perturbation after step 400; 90 % of the return before are 90.

    before = (90 + 100 + 110) / 3 = 100; lowest 40, so the drop is 60; it is below 90 at 500 and 600 and back at 700;
    losses 0 60 20 5 0 at 400, 500, ...: area = 100 (30 + 40 + 12.5 + 2.5) = 8500; final = (80 + 95 + 120) / 3;
    the largest fall from the highest so far is from 110 to 40.
    """
    rows = rows_of(*curve(50.0, 90.0, 100.0, 110.0, 40.0, 80.0, 95.0, 120.0))
    (one,) = recovery(rows, 400).values()
    assert one._asdict() == pytest.approx(
        {
            "before": 100.0,
            "drop": 60.0,
            "relative_drop": 0.6,
            "steps_to_regain": 300.0,
            "area_lost": 8500.0,
            "final": 295 / 3,
            "worst_drawdown": 70.0,
        }
    )


def test_a_return_that_never_drops_loses_nothing():
    one = recovery(rows_of(*curve(90.0, 100.0, 110.0, 101.0, 100.0)), 300)[0]
    assert (one.before, one.drop, one.relative_drop, one.steps_to_regain, one.area_lost) == (100, 0, 0, 0, 0)
    assert one.worst_drawdown == 10.0


def test_a_drop_to_nine_tenths_is_none_to_regain():
    one = recovery(rows_of(*curve(100.0, 100.0, 90.0, 95.0)), 200)[0]
    assert (one.drop, one.steps_to_regain) == (10.0, 0.0)
    assert one.area_lost == 100 * (5 + 7.5)


def test_a_late_fall_is_regained_late_and_one_that_lasts_never():
    assert recovery(rows_of(*curve(100.0, 95.0, 99.0, 80.0, 89.9, 90.0, 0.0)), 100)[0].steps_to_regain == 500.0
    assert recovery(rows_of(*curve(100.0, 50.0, 89.0)), 100)[0].steps_to_regain == np.inf


def test_the_recovery_of_negative_returns():
    """Of -100, 90 % are -110; the drop is a share of 100."""
    one = recovery(rows_of(*curve(-100.0, -150.0, -111.0, -110.0)), 100)[0]
    assert (one.drop, one.relative_drop, one.steps_to_regain) == (50.0, 0.5, 300.0)
    assert one.area_lost == pytest.approx(100 * (25 + 30.5 + 10.5))
    assert np.isnan(recovery(rows_of(*curve(0.0, -1.0)), 100)[0].relative_drop)


def test_the_drop_of_small_returns_is_a_share_of_them():
    assert recovery(rows_of(*curve(0.5, 0.1)), 100)[0].relative_drop == pytest.approx(0.8)
    assert recovery(rows_of(*curve(-0.5, -1.0)), 100)[0].relative_drop == pytest.approx(1.0)


def test_final_and_before_stay_between_their_perturbations():
    """After step 200; the one before it was after step 100."""
    one = recovery(rows_of(*curve(100.0, 60.0, 30.0, 40.0)), 200, since=100)[0]
    assert (one.before, one.drop, one.final) == (60.0, 30.0, 35.0)


def test_recovery_begins_between_evaluations():
    """After step 150: no loss there, 20 at 200 and 10 at 300: 50 / 2 * 20 + 100 * 15."""
    one = recovery(rows_of(*curve(100.0, 80.0, 90.0)), 150)[0]
    assert (one.before, one.area_lost, one.steps_to_regain) == (100.0, 2000.0, 150.0)


def test_recovery_with_too_few_evaluations():
    rows = rows_of(*curve(4.0, 2.0))
    nothing_before, nothing_after = recovery(rows, 50)[0], recovery(rows, 200)[0]
    np.testing.assert_array_equal(nothing_before, [np.nan] * 5 + [3.0, 2.0])
    np.testing.assert_array_equal(nothing_after, [3.0] + [np.nan] * 4 + [3.0, 2.0])
    assert recovery(rows, 100)[0].before == 4.0
    assert recovery(rows_of(), 100) == {}


def test_recovery_is_each_seeds_own_and_ends_where_it_is_told():
    rows = rows_of(*curve(10.0, 5.0, 9.0, 1.0), *curve(20.0, np.nan, 4.0, 30.0, seed=7))
    whole, part = recovery(rows, 100), recovery(rows, 100, until=300)
    assert {seed: one.drop for seed, one in whole.items()} == {0: 9.0, 7: 16.0}
    assert {seed: one.drop for seed, one in part.items()} == {0: 5.0, 7: 16.0}
    assert {seed: one.final for seed, one in part.items()} == {0: 7.0, 7: 4.0}
    assert {seed: one.steps_to_regain for seed, one in part.items()} == {0: 200.0, 7: np.inf}
    assert whole[7].area_lost == 200 * 8 + 100 * 8
