"""The statistics and the choices of the protocol, by hand, from results as `csac study run --results` collects them."""

from __future__ import annotations

import dataclasses
import runpy
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made import MadeRecords
from studying import make_run

from csac.record.rendering import Row, Table
from csac.studies.arms import Arm, gather
from csac.studies.cells import Cell, Store
from csac.studies.results import Results, collect
from csac.studies.study import Method, Study, read_study
from csac.types import InputError

FOLDER = Path(__file__).parents[1] / "results" / "reference"
EVIDENCE = SimpleNamespace(**runpy.run_path(str(FOLDER / "evidence.py")))
STUDY = Study("s", "S", ("Hopper-v4",), (Method("SAC, 0.2", "sac", "paper"), Method("CSAC", "csac")), steps=50)


def rows(curves: Mapping[int, Sequence[float]]) -> np.ndarray:
    """Evaluations of one episode each at steps 10, 20, ... for each seed's curve."""
    told = [(seed, 10 * (i + 1), value) for seed, curve in curves.items() for i, value in enumerate(curve)]
    return np.array(told, [("seed", int), ("step", int), ("return", float)])


def arm(
    method: Method,
    curves: Mapping[int, Sequence[float]],
    failed: tuple[int, ...] = (),
    condition: tuple[str, ...] = (),
    task: str = "Hopper-v4",
) -> Arm:
    manifests: list[Any] = [SimpleNamespace(seeds=[seed]) for seed in curves]
    evaluations = [rows({seed: curve}) for seed, curve in curves.items()]
    failures = dict.fromkeys(failed, "NaN")
    return Arm(method.label, task, condition, manifests=manifests, evaluations=evaluations, failures=failures)


def cells_of_row(table: Table, *labels: str) -> Sequence[Any]:
    def texts(row: Row) -> list[str]:
        return [cell.text.strip("*") for cell in row.cells[: len(labels)]]

    return next(row.cells for row in table.rows if texts(row) == list(labels))


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
    found = EVIDENCE.measured(STUDY, arms)
    sac_here, csac_here = found["Hopper-v4"]["SAC, 0.2"], found["Hopper-v4"]["CSAC"]
    np.testing.assert_array_equal(sac_here.final, [2, 4])
    np.testing.assert_array_equal(csac_here.final, [5, 0])
    np.testing.assert_array_equal(sac_here.drawdown, [3, 0])
    np.testing.assert_array_equal(csac_here.drawdown, [0, np.inf])
    # Scaled by SAC's mean of 3; pairs (5, 2), (5, 4) are won and (0, 2), (0, 4) lost.
    np.testing.assert_allclose(EVIDENCE.scaled(found, [0, 1])["CSAC"], [[5 / 3], [0]])
    overall = EVIDENCE.overall_table(STUDY, found)
    assert [cell.value for cell in cells_of_row(overall, "CSAC")[1:]] == pytest.approx([5 / 6, 5 / 6, 0.0])
    compared = cells_of_row(EVIDENCE.comparison_table(STUDY, found), "CSAC", "SAC, 0.2")
    assert (compared[2].value, compared[3].text) == (0.5, "no verdict")
    assert compared[4].value == pytest.approx((1.0 + 0.5 + 0.0 + 0.0) / 4)  # falls 0 and ∞ against 3 and 0


def test_a_failed_seed_makes_no_arm_steadier():
    sac, csac = STUDY.methods
    curves = {0: [1, 5, 2, 2, 2], 1: [1, 2, 3, 4, 4], 2: [3, 1, 1, 1, 1]}
    arms = [arm(sac, curves), arm(csac, {seed: curves[seed] for seed in (0, 1)}, failed=(2,))]
    table = EVIDENCE.task_table("Hopper-v4", EVIDENCE.measured(STUDY, arms)["Hopper-v4"])
    place = table.headings.index("drawdown, mean")
    whole, broken = (cells_of_row(table, label)[place : place + 2] for label in ("SAC, 0.2", "CSAC"))
    # Falls of 3, 0 and 2; the quartiles of three seeds are 1, 2, 1, 1.5 and 1.5 apart at the five evaluations.
    assert [cell.value for cell in whole] == pytest.approx([5 / 3, 7 / 5])
    assert [cell.text for cell in broken] == ["", ""]


def test_recovery_is_the_area_lost_as_a_share_of_the_return_before():
    # After step 20 the return 4 falls to 2 and comes back: losses 0, 2, 0, 0 at 20, 30, 40, 50 make 20 in area, over 4.
    condition = ("friction=2@20",)
    measured = EVIDENCE.measure(arm(STUDY.methods[0], {0: [4, 4, 2, 4, 4]}, condition=condition), 50, [0])
    assert measured.area_lost.tolist() == [5.0]


def test_what_is_over_all_tasks_is_over_the_seeds_that_all_tasks_have():
    sac, csac = STUDY.methods
    study = Study("s", "S", ("Hopper-v4", "Ant-v4"), STUDY.methods, steps=50, seeds=6)
    arms = [
        arm(sac, {seed: [2.0] * 5 for seed in range(6)}),
        arm(csac, {**{seed: [3.0] * 5 for seed in range(5)}, 5: [99.0] * 5}),
        arm(sac, {seed: [1.0] * 5 for seed in range(5)}, task="Ant-v4"),
        arm(csac, {seed: [0.5] * 5 for seed in range(5)}, task="Ant-v4"),
    ]
    found = EVIDENCE.measured(study, arms)
    assert EVIDENCE.common_seeds(study, found) == [0, 1, 2, 3, 4]
    overall = cells_of_row(EVIDENCE.overall_table(study, found), "CSAC")
    assert overall[1].value == pytest.approx((1.5 + 0.5) / 2)  # without seed 5 and its 99
    compared = cells_of_row(EVIDENCE.comparison_table(study, found), "CSAC", "SAC, 0.2")
    assert compared[2].text == "0.500 (0.500 to 0.500)"
    assert compared[3].text == "not told apart"
    assert [cell.text for cell in compared[-2:]] == ["1.000 (1.000 to 1.000)", "0.000 (0.000 to 0.000)"]
    assert EVIDENCE.common_seeds(study, {"Hopper-v4": found["Hopper-v4"]}) == []  # a task has nothing


def test_the_tables_say_which_seeds_are_missing_and_left_out():
    methods = (Method("SAC, 0.2", "sac", "paper"), Method("CSAC", "csac"))
    study = Study("s", "S", ("Hopper-v4", "Ant-v4"), methods, steps=1_000, seeds=2, evaluation_interval=100)
    source = MadeRecords(lambda cell, step: None if (cell.task, cell.seed) == ("Ant-v4", 1) else 1.0)
    told = EVIDENCE.told(study, source)
    assert "- not run: CSAC on Ant-v4: seed 1\n" in told
    assert "- left out of what is over all tasks: Hopper-v4, seed 1, which another task lacks\n" in told
    assert "S: comparisons, seeds 0" in told
    alone = EVIDENCE.told(study, source, only=[1])
    assert alone.startswith("## S: seeds 1 alone\n\n- not run: SAC, 0.2 on Ant-v4: seed 1\n")
    assert "left out of what is over all tasks: Hopper-v4, seed 1" in alone
    assert "comparisons" not in alone
    one_task = study.narrowed(["Ant-v4"])
    assert EVIDENCE.told(one_task, source, has_more_tasks=True).startswith("## S: on Ant-v4 alone\n\n- not run")
    both = EVIDENCE.told(one_task, source, only=[0], has_more_tasks=True)
    assert both.startswith("## S: seeds 0, on Ant-v4 alone\n\n**Ant-v4**")
    with pytest.raises(InputError, match="s has the seeds 0 to 1"):
        EVIDENCE.told(study, source, only=[7])


def test_some_seeds_alone_are_scaled_by_themselves():
    sac, csac = STUDY.methods
    arms = [
        arm(sac, {seed: [1.0 + seed] * 5 for seed in range(4)}),
        arm(csac, {seed: [4.0 + 4 * seed] * 5 for seed in range(4)}),
    ]
    found = EVIDENCE.measured(STUDY, arms, [2, 3])
    assert found["Hopper-v4"]["CSAC"].seeds == (2, 3)
    np.testing.assert_allclose(EVIDENCE.scaled(found, [2, 3])["CSAC"], [[12 / 3.5], [16 / 3.5]])


def test_seeds_that_failed_before_their_first_evaluation_have_reached_nothing(tmp_path):
    store, failed = Store(tmp_path / "runs"), {"state": "failed", "failures": {0: "step 3: NaN"}}
    study = dataclasses.replace(STUDY, seeds=1)
    for _, _, cell in study.entries():
        run = make_run(store, cell, **(failed if cell.algorithm == "csac" else {"state": "finished"}))
        if cell.algorithm == "sac":
            run.append("evaluations", [{"seed": 0, "step": 50, "episode": 0, "return": 4.0, "length": 9}])
        collect(store, cell, tmp_path / "out")
    found = EVIDENCE.measured(study, gather(study, Results(tmp_path / "out")))["Hopper-v4"]
    assert [found[label].final.tolist() for label in ("SAC, 0.2", "CSAC")] == [[4.0], [0.0]]
    assert "not run" not in EVIDENCE.told(study, Results(tmp_path / "out"))


def test_an_interval_on_one_side_of_one_half_is_a_verdict():
    assert [EVIDENCE.verdict(one) for one in (None, (0.51, 0.9), (0.1, 0.49), (0.5, 0.9), (0.1, 0.5))] == [
        "no verdict",
        "better",
        "worse",
        "not told apart",
        "not told apart",
    ]


def test_a_form_is_judged_beside_what_is_the_same_without_relative_entropy():
    bounded = Method("bounded, none", "csac", None, {"relative_entropy_weight": 0, "target_log_prob_bound": 5})
    sac = Method("SAC, 0.2", "sac", "paper"), Method("SAC, automatic", "sac")
    forms = {
        "SAC, 0.2": {"reference_policy": "previous"},
        "SAC, automatic": {"entropy_weight": "auto"},
        "bounded, none": {"target_log_prob_bound": 5.0, "relative_entropy_form": "implicit"},
        None: {"target_log_prob_bound": 4.0},
    }
    study = Study("s", "S", ("Hopper-v4",), (*sac, bounded))
    found = [EVIDENCE.counterpart(study, Method("CSAC", "csac", None, one)) for one in forms.values()]
    assert [one and one.label for one in found] == list(forms)


def test_close_scores_are_ranked_by_the_worst_seed():
    values = {
        "highest": np.array([[1.0, 0.0], [1.0, 2.0]]),
        "close and steady": np.array([[0.9, 0.99], [1.0, 1.09]]),
        "close to the second": np.array([[0.988, 0.988], [0.988, 0.988]]),
        "far": np.full((2, 2), 0.97),
    }
    # 1, 0.995, 0.988, 0.97: the steady one wins of the first two; then the first alone, for 0.988 is 0.012 away.
    assert EVIDENCE.ranked(values) == ["close and steady", "highest", "close to the second", "far"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for path in FOLDER.glob("*.toml"):
        shutil.copy(path, tmp_path)
    return tmp_path


def returns(cell: Cell, step: int) -> float:
    """CSAC with an average comes first, then a period of 100."""
    told = cell.hyperparameters
    if cell.algorithm == "sac" or told["reference_policy"] == "algorithm1":
        return 100.0 if cell.algorithm == "sac" else 900.0
    value = {"average": 300.0 - told["reference_rate"], "periodic": 250.0 - told["reference_period"] / 100}
    return value.get(told["reference_policy"], 200.0)


def test_each_stage_is_written_from_the_results_of_the_screen(folder):
    source = MadeRecords(returns)
    for _ in range(2):  # a second time changes nothing
        EVIDENCE.write("chosen", folder, source)
    chosen = ["CSAC, average 0.005", "CSAC, average 0.05"]
    fixed = ["SAC, 0.2", "SAC, automatic", "CSAC, paper"]
    for name, first in (("confirm", fixed), ("ant", fixed), ("recovery", fixed[:1])):
        study = read_study(folder / f"{name}.toml")
        assert [method.label for method in study.methods] == [*first, *chosen]
        assert EVIDENCE.counterpart(study, study.methods[-1]).label == "SAC, 0.2"

    EVIDENCE.write("options", folder, source)
    written = {one.label: one.hyperparameters_on("Hopper-v4") for one in read_study(folder / "options.toml").methods}
    form = chosen[0]
    assert list(written)[3:7] == [form, f"{form}, tau 0.05", f"{form}, tau 5", f"{form}, entropy weight automatic"]
    assert written[f"{form}, tau 0.05"]["relative_entropy_weight"] == 0.05
    implicit = written[f"{form}, implicit, log-densities bounded"]
    assert (implicit["relative_entropy_form"], implicit["reference_rate"]) == ("implicit", 0.005)
    two = written["CSAC, periodic 1000, two references"]
    assert (two["critic_reference"], two["relative_entropy_weight"]) == ("earlier", 0.5)
    learnt = written["CSAC, periodic 1000, relative-entropy weight automatic"]
    assert (learnt["relative_entropy_weight"], learnt["target_relative_entropy"]) == ("auto", 0.01)
    assert f"{form}, relative-entropy weight automatic" not in written


def test_a_best_form_in_the_actor_only_is_given_what_it_has_not(folder):
    def best(cell: Cell, step: int) -> float:
        return 500.0 if cell.hyperparameters.get("relative_entropy_form") == "actor_only" else returns(cell, step)

    EVIDENCE.write("options", folder, MadeRecords(best))
    form = "CSAC, periodic 1000, in the actor only"
    methods = {method.label: method for method in read_study(folder / "options.toml").methods[2:]}
    assert list(methods)[1] == form
    assert f"{form}, in the actor only" not in methods
    assert f"{form}, relative-entropy weight automatic" in methods
    implicit = methods[f"{form}, implicit, log-densities bounded"].hyperparameters_on("Hopper-v4")
    assert implicit["relative_entropy_form"] == "implicit"
    two = methods["CSAC, periodic 1000, two references"].hyperparameters_on("Hopper-v4")
    assert (two["relative_entropy_form"], two["critic_reference"]) == ("explicit", "earlier")


def test_nothing_is_chosen_before_every_cell_has_run(folder):
    source = MadeRecords(lambda cell, step: None if cell.seed == 1 else returns(cell, step))
    with pytest.raises(InputError, match=r"SAC, 0.2 on Hopper-v4, seed 1, has not run: run it first"):
        EVIDENCE.write("chosen", folder, source)


def test_where_nothing_differs_few_are_told_apart():
    # By chance: of 100 pairs on one task about 11 are, as PROTOCOL.md has it, half of them as better.
    shares = EVIDENCE.false_verdicts(tasks=1, seeds=5, trials=50)
    assert 0.03 <= shares.apart <= 0.25
    assert 0 < shares.better < shares.apart
    assert shares.better <= shares.either_better <= 2 * shares.better
    assert EVIDENCE.false_verdicts(tasks=1, seeds=4, trials=3) == (0.0, 0.0, 0.0)  # four seeds have no interval
