"""The statistics of the protocol, by hand, from results as `csac study run --results` collects them."""

from __future__ import annotations

import runpy
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from csac.studies.arms import Arm
from csac.studies.study import Method, Study

EVIDENCE = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[1] / "results" / "reference" / "evidence.py")))
STUDY = Study("s", "S", ("Hopper-v4",), (Method("SAC, 0.2", "sac", "paper"), Method("CSAC", "csac")), steps=50)


def rows(curves: Mapping[int, Sequence[float]]) -> np.ndarray:
    """Evaluations of one episode each at steps 10, 20, ... for each seed's curve."""
    told = [(seed, 10 * (i + 1), value) for seed, curve in curves.items() for i, value in enumerate(curve)]
    return np.array(told, [("seed", int), ("step", int), ("return", float)])


def arm(method: Method, curves: Mapping[int, Sequence[float]], failed: tuple[int, ...] = (), condition=()) -> Arm:
    manifests: list[Any] = [SimpleNamespace(seeds=[seed]) for seed in curves]
    evaluations = [rows({seed: curve}) for seed, curve in curves.items()]
    return Arm(
        method.label,
        "Hopper-v4",
        condition,
        manifests=manifests,
        evaluations=evaluations,
        failures=dict.fromkeys(failed, "NaN"),
    )


def test_the_final_return_is_the_mean_of_the_last_fifth():
    # Of 100 steps those after 80 count: 90 and 100.
    final = EVIDENCE.final_returns(rows({0: [0, 0, 0, 0, 0, 0, 0, 9, 1, 2], 3: [0] * 8 + [4, 6]}), 100)
    assert final == {0: 1.5, 3: 5.0}


def test_only_seeds_that_every_method_has_count_and_a_failed_one_has_nothing():
    sac, csac = STUDY.methods
    arms = [
        arm(sac, {0: [1, 5, 2, 2, 2], 1: [1, 2, 3, 4, 4], 2: [9] * 5}),
        arm(csac, {0: [1, 2, 3, 4, 5]}, failed=(1,)),
    ]
    found = EVIDENCE.measured(STUDY, arms)["Hopper-v4"]
    np.testing.assert_array_equal(found["SAC, 0.2"].final, [2, 4])
    np.testing.assert_array_equal(found["CSAC"].final, [5, 0])
    np.testing.assert_array_equal(found["SAC, 0.2"].drawdown, [3, 0])
    np.testing.assert_array_equal(found["CSAC"].drawdown, [0, np.inf])
    # Scaled by SAC's mean of 3; pairs (5, 2), (5, 4) are won and (0, 2), (0, 4) lost.
    np.testing.assert_allclose(EVIDENCE.scaled({"Hopper-v4": found})["CSAC"], [[5 / 3], [0]])
    table = EVIDENCE.overall_table(STUDY, {"Hopper-v4": found})
    assert [cell.value for cell in table.rows[1].cells[1:5]] == pytest.approx([5 / 6, 5 / 6, 0.0, 0.5])
    assert table.rows[1].cells[5].value == pytest.approx((1.0 + 0.5 + 0.0 + 0.0) / 4)  # falls 0 and ∞ against 3 and 0


def test_recovery_is_the_area_lost_as_a_share_of_the_return_before():
    # After step 20 the return 4 falls to 2 and comes back: losses 0, 2, 0, 0 at 20, 30, 40, 50 make 20 in area, over 4.
    condition = ("friction=2@20",)
    measured = EVIDENCE.measure(arm(STUDY.methods[0], {0: [4, 4, 2, 4, 4]}, condition=condition), 50, [0])
    assert measured.area_lost.tolist() == [5.0]


def test_intervals_appear_from_five_seeds_on():
    sac, csac = STUDY.methods
    arms = [arm(sac, {seed: [1.0 + seed] * 5 for seed in range(5)}), arm(csac, {seed: [9.0] * 5 for seed in range(5)})]
    found = EVIDENCE.measured(STUDY, arms)
    assert EVIDENCE.overall_table(STUDY, found).rows[1].cells[4].text == "1.00 (1.00 to 1.00)"
