import numpy as np
import pytest
from scipy import stats

from csac.record.statistics import (
    best_return,
    bootstrap_interval,
    drawdown,
    evaluation_matrix,
    interquartile_mean,
    is_case,
    last_evaluations,
    maximum_average_return,
    mean_and_interval,
    mean_over_episodes,
    probability_of_improvement,
    recovery,
    steps_to_reach,
)
from csac.types import InputError


def rows_of(*evaluations):
    """Rows from (seed, step, return) triples."""
    return np.array(list(evaluations), [("seed", np.int64), ("step", np.int64), ("return", np.float64)])


def test_the_matrix_averages_episodes_and_marks_what_is_missing():
    rows = rows_of((7, 200, 5.0), (3, 100, 1.0), (3, 100, 3.0), (7, 100, -1.0))  # seed 3 was not evaluated at 200
    steps, seeds, returns = evaluation_matrix(rows)
    np.testing.assert_array_equal(steps, [100, 200])
    np.testing.assert_array_equal(seeds, [3, 7])
    np.testing.assert_array_equal(returns, [[2.0, np.nan], [-1.0, 5.0]])


def test_the_t_interval_worked_by_hand():
    # 2, 4, 6: mean 4, s = sqrt((4 + 0 + 4) / 2) = 2, t(0.975, 2) = 4.302653, reach = 4.302653 * 2 / sqrt(3) = 4.968275
    mean, low, high = mean_and_interval(np.array([2.0, 4.0, 6.0]))
    assert mean == pytest.approx(4.0)
    assert low == pytest.approx(-0.968275, abs=1e-6)
    assert high == pytest.approx(8.968275, abs=1e-6)


def test_intervals_go_down_the_seed_axis_and_leave_nans_out():
    nan = np.nan
    values = np.array([[2.0, 2.0, nan, 1.0], [4.0, 4.0, nan, nan], [6.0, 6.0, nan, nan], [nan, 8.0, nan, nan]])
    mean, low, high = mean_and_interval(values)
    np.testing.assert_allclose(mean, [4.0, 5.0, nan, 1.0])
    expected = stats.t.interval(0.95, 3, loc=5.0, scale=stats.sem([2, 4, 6, 8]))
    np.testing.assert_allclose(low, [-0.968275, expected[0], nan, nan], atol=1e-6)
    np.testing.assert_allclose(high, [8.968275, expected[1], nan, nan], atol=1e-6)


@pytest.mark.parametrize("count", range(1, 13))
def test_the_interquartile_mean_is_scipys_trimmed_mean(count):
    values = np.random.default_rng(count).normal(size=count)
    assert interquartile_mean(values) == pytest.approx(stats.trim_mean(values, 0.25))


def test_the_interquartile_mean_pools_all_axes_and_leaves_nans_out():
    scores = np.array([[-1e9, 1.0, 2.0, 1e9], [3.0, 4.0, np.nan, 0.0], [9.0, np.nan, np.nan, np.nan]])
    assert interquartile_mean(scores) == pytest.approx((1 + 2 + 3 + 4) / 4)  # of -1e9 0 | 1 2 3 4 | 9 1e9
    assert np.isnan(interquartile_mean(np.array([np.nan])))


def test_the_bootstrap_resamples_within_a_task_and_each_task_for_itself():
    scores = np.stack([np.full(5, 10.0), np.arange(5.0), np.arange(5.0)], axis=1)
    seen = []
    bootstrap_interval(lambda resampled: seen.append(resampled) or 0.0, scores, repetitions=50)
    assert all((resampled[:, 0] == 10.0).all() for resampled in seen)
    assert all(set(resampled[:, 1]) <= set(range(5)) for resampled in seen)
    assert any((resampled[:, 1] != resampled[:, 2]).any() for resampled in seen)


def test_there_is_no_bootstrap_interval_below_five_seeds():
    assert bootstrap_interval(np.mean, np.arange(4.0)) is None
    assert bootstrap_interval(np.mean, np.array([1.0, 2.0, 3.0, 4.0, np.nan])) is None
    assert bootstrap_interval(np.mean, np.ones(5)) == (1.0, 1.0)


def test_the_maximum_average_return_is_of_the_mean_over_seeds():
    # means over seeds: 5 at step 100, 6 at 200, 6 at 300; a single seed reaches 10
    rows = rows_of((0, 100, 10.0), (1, 100, 0.0), (0, 200, 5.0), (1, 200, 7.0), (0, 300, 6.0), (1, 300, 6.0))
    assert maximum_average_return(rows) == (6.0, 200)


def test_the_maximum_average_return_skips_points_that_lack_a_seed():
    rows = rows_of((0, 100, 1.0), (1, 100, 3.0), (1, 200, 50.0))
    assert maximum_average_return(rows) == (2.0, 100)


@pytest.mark.parametrize("rows", [rows_of(), rows_of((0, 100, 1.0), (1, 200, 2.0))])
def test_there_is_no_maximum_without_a_complete_point(rows):
    with pytest.raises(InputError, match="no evaluation point holds every seed"):
        maximum_average_return(rows)


def test_the_last_evaluations_are_each_seeds_own():
    rows = rows_of(*((0, step, float(step)) for step in (1, 2, 3, 4)), (5, 1, 8.0), (5, 2, 6.0), (6, 1, np.nan))
    assert last_evaluations(rows) == {0: 3.0, 5: 7.0}
    assert last_evaluations(rows, points=1) == {0: 4.0, 5: 6.0}
    assert last_evaluations(rows_of()) == {}


def test_silence_is_a_no_in_cases_and_unknown_in_numbers():
    cases, counts = np.array([1.0, np.nan, np.nan, 0.0]), np.array([3.0, np.nan, 1.0])
    assert (is_case(cases), is_case(counts), is_case(np.array([np.nan]))) == (True, False, False)
    assert (mean_over_episodes(cases, True), mean_over_episodes(counts, False)) == (0.25, 2.0)
    assert np.isnan(mean_over_episodes(np.array([np.nan]), False))


def test_the_best_return_of_each_seed():
    # Seed 0 has means 2 and 4, not the 7 of a single episode; seed 1 has -5, and one evaluation that says nothing.
    rows = rows_of((0, 100, 2.0), (0, 200, 1.0), (0, 200, 7.0), (1, 100, -5.0), (1, 200, np.nan))
    assert [best_return(rows[rows["seed"] == seed]) for seed in (0, 1, 2)] == [4.0, -5.0, -np.inf]


def test_the_probability_of_improvement_worked_by_hand():
    # Pairs of 3, 5 with 1, 3, 4: 3 > 1, 3 = 3, 3 < 4 and 5 above all: (1 + 0.5 + 0 + 3) / 6
    x, y = np.array([3.0, 5.0]), np.array([1.0, 3.0, 4.0])
    assert probability_of_improvement(x, y) == pytest.approx(4.5 / 6)
    assert probability_of_improvement(y, x) == pytest.approx(1.5 / 6)
    assert probability_of_improvement(x, x) == 0.5
    assert probability_of_improvement(x, np.array([4.0, np.nan])) == 0.5  # of 3 < 4 and 5 > 4
    assert np.isnan(probability_of_improvement(x, np.array([np.nan])))
    assert probability_of_improvement(np.array([-np.inf, 1.0]), np.array([-np.inf])) == 0.75  # two failures are equal


def test_tasks_weigh_the_same_in_the_probability_of_improvement():
    # Task 0: 1 of 1 pair; task 1: none of 2 pairs, for a NaN takes one away in task 0.
    x, y = np.array([[2.0, 0.0], [np.nan, 0.0]]), np.array([[1.0, 5.0]])
    assert probability_of_improvement(x, y) == 0.5


# What rliable 1.2.0 gives for these scores [seed, task] of two algorithms with six and five seeds.

FIRST = np.array([[0, 5, 10], [7, 4, 1], [6, 6, 6], [8, 0, 3], [2, 8, 3], [10, 8, 6]], float)
SECOND = np.array([[1, 5, 9], [6, 1, 7], [10, 7, 4], [2, 1, 0], [4, 5, 6]], float)


def test_point_estimates_are_those_of_rliable():
    assert interquartile_mean(FIRST) == pytest.approx(5.4)
    assert interquartile_mean(SECOND) == pytest.approx(4.444444444444445)
    assert probability_of_improvement(FIRST, SECOND) == pytest.approx(0.55)


def test_intervals_are_those_of_rliable():
    # rliable's own, of 50,000 and 5,000 resamples: (3.5, 6.9) and (0.344, 0.75); these resamples are others.
    assert bootstrap_interval(interquartile_mean, FIRST) == pytest.approx((3.5, 6.9), abs=0.15)
    assert bootstrap_interval(probability_of_improvement, FIRST, SECOND) == pytest.approx((0.344, 0.75), abs=0.02)


# Of one learning curve.


def curve(*returns, seed=0):
    """One seed's evaluations at 100, 200, ..."""
    return [(seed, 100 * (number + 1), value) for number, value in enumerate(returns)]


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
