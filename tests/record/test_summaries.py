"""What runs have reached, with the arithmetic worked out."""

from typing import Any

import numpy as np
import pytest

from csac.record.report_tables import (
    case_comparison_table,
    case_table,
    comparison_table,
    recovery_table,
    results_table,
)
from csac.record.summaries import (
    case_names,
    over_seeds,
    perturbation_recoveries,
    recoveries,
)

NAN = np.nan


def rows_of(*returns, success: Any = NAN, **events):
    """Rows of one episode each at 10, 20, ..., with `returns` [seed][point]."""
    columns = [("seed", int), ("step", int), ("episode", int), ("return", float), ("length", int), ("success", float)]
    rows = [(seed, 10 * (t + 1), 0, value, 5) for seed, line in enumerate(returns) for t, value in enumerate(line)]
    table = np.zeros(len(rows), [*columns, *((name, float) for name in events)])
    for name, column in zip(("seed", "step", "episode", "return", "length"), zip(*rows, strict=True), strict=False):
        table[name] = column
    table["success"] = success
    for name, values in events.items():
        table[name] = values
    return table


def lines(table):
    return [list(table.headings), *([cell.text for cell in row.cells] for row in table.rows)]


def test_over_seeds_says_no_more_than_there_is():
    # 2, 4, 6: std 2, reach 4.302653 * 2 / sqrt 3 = 4.968275
    assert over_seeds([2.0, 4.0, NAN, 6.0]) == pytest.approx((3, 4.0, 2.0, 4 - 4.968275, 4 + 4.968275), abs=1e-6)
    assert over_seeds([2.0, 4.0]) == pytest.approx((2, 3.0, np.sqrt(2), NAN, NAN), nan_ok=True)
    assert over_seeds([2.0]) == pytest.approx((1, 2.0, NAN, NAN, NAN), nan_ok=True)
    assert over_seeds([NAN]) == pytest.approx((0, NAN, NAN, NAN, NAN), nan_ok=True)


def test_the_results_of_a_run():
    # Of seeds 0 and 1, at 10: 0 and 8; at 20: 9 and 3; at 30: 2 and 4. Together they are best at 20: 6.
    table = results_table(rows_of([0.0, 9.0, 2.0], [8.0, 3.0, 4.0], [99.0]), failed={2}, episodes={0: 7})
    assert lines(table) == [
        ["seed", "last return", "last three", "best", "at step", "episodes"],
        ["0", "2.00", "3.67", "9.00", "20", "7"],
        ["1", "4.00", "5.00", "8.00", "10", "0"],
        ["2", "99.00", "99.00", "99.00", "10", "0"],
        ["mean", "3.00", "4.33", "6.00", "20", ""],
        ["± std", "1.41", "0.94", "4.24", "", ""],
    ]
    assert [row.kind for row in table.rows] == ["plain", "plain", "failed", "summary", "summary"]


def test_the_last_of_all_is_where_all_are():
    assert lines(results_table(rows_of([1.0, 50.0], [3.0])))[3][1] == "2.00"


@pytest.mark.parametrize("rows", [rows_of([NAN, NAN]), rows_of([1.0])[:0]])
def test_a_run_without_returns_has_no_results(rows):
    assert results_table(rows).rows == ()


def test_runs_beside_the_first():
    first, second = lines(comparison_table([("a", rows_of([1.0, 4.0], [2.0, 6.0]), 0), ("b", rows_of([5.0, 4.0]), 1)]))[
        1:
    ]
    assert first == ["a", "2", "20", "3.25 ± 1.06", "2 seeds: no interval", "1.00", "5.00 at 20"]
    assert second == ["b", "1 (1 failed)", "20", "4.50", "1 seed: no interval", "1.38", "5.00 at 10"]


def test_five_seeds_are_compared_by_their_probability_of_improvement():
    """Of 4, 4, 4, 4, 4 and 1, 4, 5, 6, 7: 4 is above 1, equal to 4 and below the rest, (1 + 0.5) / 5."""
    a, b = rows_of([1.0], [4.0], [5.0], [6.0], [7.0]), rows_of(*[[4.0]] * 5)
    first, second = lines(comparison_table([("a", a, 0), ("b", b, 0)]))[1:]
    assert first[-1] == ""
    assert second[-1].startswith("0.30 (")
    assert first[-2].startswith("5.00 (")


def test_seeds_that_were_never_evaluated_together_have_no_maximum():
    table = comparison_table([("a", rows_of([1.0, 2.0], [3.0])[1:], 0)])
    assert lines(table)[1][6] == ""
    assert {*table.headings} - {*table.without_empty_columns().headings} == {"to the first", "maximum average return"}


def test_the_bootstrap_resamples_seeds_and_not_their_evaluations():
    """Each seed's last evaluations are 0 and 100: their mean is 50 in every resample of the seeds."""
    assert lines(comparison_table([("a", rows_of(*[[0.0, 100.0]] * 6), 0)]))[1][-2] == "50 (50 to 50)"


def test_success_is_over_all_of_the_last_evaluations():
    # Of each seed 2 of 4, of the last three 2 of 3; one episode says nothing, which is a no.
    rows = rows_of([1.0] * 4, [1.0] * 4, success=[0, 1, NAN, 1, 0, 0, 1, 1])
    assert lines(comparison_table([("a", rows, 0)]))[1][-1] == "67% ± 0%"


def test_what_a_perturbation_cost_several_runs():
    """After step 10. Seed 0 of `a` falls from 100 to 40 and is back at 30; its seed 1 never is; `b` loses nothing."""
    a = recoveries("a", rows_of([100.0, 40.0, 95.0], [200.0, 100.0, 150.0]), 10)
    b = recoveries("b", rows_of([10.0, 11.0]), 10)
    assert (a.regained, a.known, a.metrics["drop"].mean, b.regained, b.known) == (1, 2, 80.0, 1, 1)
    assert a.metrics["steps_to_regain"].seeds == 0
    assert lines(recovery_table([a, b])) == [
        ["run", "seed", "before", "drop", "relative", "steps to 90 %", "area lost", "final", "drawdown"],
        ["a", "0", "100.0", "60.0", "60%", "20", "625", "67.5", "60.0"],
        ["a", "1", "200.0", "100.0", "50%", "never", "1.25k", "125.0", "100.0"],
        ["a", "mean", "150.0", "80.0", "55%", "1 of 2", "938", "96.2", "80.0"],
        ["a", "± std", "70.7", "28.3", "7%", "", "442", "40.7", "28.3"],
        ["b", "0", "10.00", "0.00", "0%", "0", "0", "11.00", "0.00"],
    ]
    assert recovery_table([a]).title == "a"


def test_each_perturbation_is_looked_at_as_far_as_the_next():
    rows = rows_of([10.0, 5.0, 8.0, 1.0])
    first, second = perturbation_recoveries(rows, [(0, "gravity"), (10, "friction"), (30, "mass"), (90, "gain")])
    assert (first.label, first.seeds[0].drop) == ("friction after step 10, until 30", 5.0)
    assert (second.label, second.seeds[0].drop) == ("mass after step 30", 5.5)  # before: (5 + 8) / 2
    assert perturbation_recoveries(rows[:0], [(10, "friction")]) == []


def test_cases_are_shares_and_numbers_are_means():
    rows = rows_of([1.0] * 2, [1.0] * 2, crashed=[1, NAN, 0, 0], stops=[4, NAN, 1, 3])
    assert lines(case_table(rows)) == [
        ["per 1,000 rollouts (from 2 of each seed)", "seed 0", "seed 1", "mean ± std"],
        ["crashed", "500.0", "0.0", "250.0 ± 353.6"],
        ["stops (mean)", "4.000", "2.000", "3.000 ± 1.414"],
    ]


def test_a_number_that_is_only_ever_0_or_1_in_one_run_is_no_case_beside_another():
    few, many = rows_of([1.0] * 2, stops=[0, 1]), rows_of([1.0] * 2, stops=[2, 3], crashed=[1, 1])
    assert case_names([few]) == {"stops": True}
    assert case_names([few, many]) == {"stops": False, "crashed": True}
    assert lines(case_comparison_table([("few", few), ("many", many)])) == [
        ["per 1,000 rollouts (from 2 of each seed)", "few", "many"],
        ["return (mean)", "1.0", "1.0"],
        ["stops (mean)", "0.500", "2.500"],
        ["crashed", "", "1,000.0"],
    ]


def test_what_nobody_tells_of_is_no_case():
    assert case_table(rows_of([1.0])) is None
    assert case_comparison_table([("a", rows_of([1.0]))]) is None
    assert lines(case_table(rows_of([1.0], crashed=[NAN])))[1:] == [["crashed (mean)", ""]]
