"""Methods over all tasks, worked by hand: what is comparable, on which scale, and what comes out."""

import json
import re

import numpy as np
import plotly.graph_objects
import pytest

from csac.record.tables import COLUMNS, structured
from csac.record.rendering import Table, markdown
from csac.studies.aggregates import Block, largest_block, over_tasks, profiles
from csac.studies.arms import Arm
from csac.studies.interactive import plots
from csac.studies.parts import Figure, Heading, Paragraph, write
from csac.studies.sections import Scope


def arm(label, task, scores, steps=10, **told):
    """An arm with one evaluation: `scores` by seed."""
    rows = [[str(seed), str(steps), "0", str(score), "5", ""] for seed, score in scores.items()]
    algorithm = "csac" if label.startswith("CSAC") else label.lower()
    return Arm(label, task, algorithm=algorithm, evaluations=[structured(COLUMNS["evaluations"], rows)], **told)


def rows_of(parts):
    return [line for part in parts if isinstance(part, Table) for line in markdown(part).splitlines() if "|" in line]


def told(parts):
    return " ".join(part.text for part in parts if isinstance(part, Paragraph))


def two_tasks(seeds, **told):
    """CSAC and SAC on a task with returns around 10 and one with returns around 1,000."""
    return [
        arm("CSAC", "Small", {seed: 12 + seed for seed in range(seeds)}, **told),
        arm("SAC", "Small", {seed: 8 + 2 * seed for seed in range(seeds)}, **told),
        arm("CSAC", "Large", dict.fromkeys(range(seeds), 2000), **told),
        arm("SAC", "Large", dict.fromkeys(range(seeds), 1000), **told),
    ]


# What is comparable.


def test_the_largest_block_is_what_is_complete():
    both, one = frozenset({0, 1}), frozenset({0})
    complete = {("A", "x"): both, ("A", "y"): both, ("B", "x"): both, ("B", "y"): one}
    assert largest_block(complete) == Block(("A", "B"), ("x", "y"), (0,))  # four runs, as of A alone with both seeds
    complete["C", "x"] = complete["C", "y"] = one
    assert largest_block(complete) == Block(("A", "B", "C"), ("x", "y"), (0,))  # six


def test_a_task_that_has_only_begun_does_not_spoil_the_others():
    done, begun, none = frozenset({0, 1, 2}), frozenset({0}), frozenset()
    complete = {(label, task): done for label in "AB" for task in "xy"}
    complete |= {("A", "z"): begun, ("B", "z"): none}
    assert largest_block(complete) == Block(("A", "B"), ("x", "y"), (0, 1, 2))


def test_tasks_that_two_methods_have_in_common():
    seeds = frozenset({0})
    complete = {("A", task): seeds for task in "xyz"} | {("B", task): seeds for task in "yzw"}
    assert largest_block(complete) == Block(("A", "B"), ("y", "z"), (0,))


def test_methods_that_each_lack_another_seed_are_compared_on_those_that_all_have():
    """36 runs; of any two methods, which have four seeds in common, there are but 32."""
    complete = {(label, task): frozenset(range(6)) - {lost} for lost, label in enumerate("ABC") for task in "wxyz"}
    assert largest_block(complete) == Block(("A", "B", "C"), ("w", "x", "y", "z"), (3, 4, 5))


def test_methods_that_each_lack_another_task_are_compared_on_those_that_all_have():
    """Nine runs; of any two methods, which have four tasks in common, there are but eight."""
    lacks = dict(zip("ABC", "xyz", strict=True))
    complete = {(label, task): frozenset({0}) for label in lacks for task in "uvwxyz" if task != lacks[label]}
    assert largest_block(complete) == Block(("A", "B", "C"), ("u", "v", "w"), (0,))


def test_one_task_of_each_method_is_no_block():
    assert largest_block({("A", "x"): frozenset({0}), ("B", "y"): frozenset({0})}) is None
    assert largest_block({("A", "x"): frozenset(), ("A", "y"): frozenset()}) is None


def test_a_seed_that_was_not_trained_to_the_end_is_not_compared():
    arms = [*two_tasks(2), arm("TD3", "Small", {0: 5}, steps=9), arm("TD3", "Large", {0: 5, 1: 5})]
    text = told(over_tasks(arms, Scope("it")))
    assert "2 of 3 methods, 2 of 2 tasks, 2 of 2 seeds." in text
    assert "Not complete on these: TD3 (without Small seeds 0, 1)." in text


def test_what_is_missing_is_told():
    arms = two_tasks(2)
    arms[1].missing, arms[3].failures = [2], {2: "critic is not finite"}
    arms += [arm("SD3", task, {}, missing=[0, 1, 2]) for task in ("Small", "Large")]
    arms += [arm("SAC", "Third", {}, missing=[0, 1, 2])]
    text = told(over_tasks(arms, Scope("it")))
    assert "2 of 3 methods, 2 of 3 tasks, 2 of 3 seeds." in text
    assert "Not complete on these: SD3 (without any). Not complete for these methods: Third, seed 2." in text


# The numbers.


def test_means_and_probabilities_of_two_seeds():
    # SAC's means are 9 and 1,000. CSAC's shares are 12/9, 13/9, 2 and 2: the middle two are 13/9 and 2. SAC's are 8/9,
    # 10/9, 1 and 1. Every seed of CSAC is above every one of SAC.
    parts = list(over_tasks(two_tasks(2), Scope("it")))
    assert rows_of(parts)[2:4] == [
        "| CSAC | 1.722 | 2 seeds: no interval | 4 |",
        "| SAC | 1.000 | 2 seeds: no interval | 4 |",
    ]
    assert rows_of(parts)[-1] == "| CSAC | 1.00 |"
    assert "share of the mean score of SAC as measured here, taken as exact: Small 9.00, Large 1,000.00" in told(parts)


def test_five_seeds_have_intervals():
    # On Small SAC's 8, 10, ..., 16 stand against CSAC's 12, ..., 16: 5 + 5 + 4.5 + 2.5 + 0.5 of 25 pairs.
    parts = list(over_tasks(two_tasks(5), Scope("it")))
    above = rows_of(parts)[-1]
    found = re.fullmatch(r"\| CSAC \| 0\.85 \((0\.\d\d) to (\d\.\d\d)\) \|", above)  # (17.5 / 25 + 1) / 2
    assert found
    assert float(found[1]) < 0.85 < float(found[2]) <= 1
    # SAC's shares are 8/12, 10/12, 1, 14/12, 16/12 and five times 1: the middle six are all 1.
    assert rows_of(parts)[3].startswith("| SAC | 1.000 | ")
    assert "no interval" not in " ".join(rows_of(parts))


def test_the_paper_s_sac_is_the_reference_where_it_has_the_tasks():
    arms = [
        arm("SAC", "HalfCheetah-v4", {0: 5526.445}, published="SAC"),  # half of the paper's 11,052.89
        arm("SAC", "Hopper-v4", {0: 3037.19}, published="SAC"),  # the paper's
    ]
    parts = list(over_tasks(arms, Scope("it", 0.1)))
    assert parts[0] == Heading("Over all tasks (scale 0.1)")
    assert rows_of(parts)[2:] == ["| SAC | 0.750 | 1 seed: no interval | 2 |"]
    assert "the maximum average return of the paper's SAC: HalfCheetah-v4 11,052.89, Hopper-v4 3,037.19" in told(parts)


def test_returns_that_are_not_positive_have_no_share():
    costs = [arm(label, "Costs", {0: -2.0}) for label in ("CSAC", "SAC")]
    parts = list(over_tasks([*two_tasks(1), *costs], Scope("it")))
    assert "Left out, as there is no share of a return that is not positive: Costs." in told(parts)
    assert rows_of(parts)[2] == "| CSAC | 1.750 | 1 seed: no interval | 2 |"  # 12/8 and 2
    parts = list(over_tasks([one for one in [*two_tasks(1), *costs] if one.task != "Large"], Scope("it")))
    assert rows_of(parts) == []


def test_one_task_is_nothing_to_be_told_over():
    assert list(over_tasks(two_tasks(2)[:2], Scope("it"))) == []


def test_each_condition_stands_for_itself():
    arms = [*two_tasks(1), *two_tasks(1, condition=("friction=2@5",))]
    figures = [part for part in over_tasks(arms, Scope("it")) if isinstance(part, Figure)]
    assert [figure.title for figure in figures] == [
        "Performance profile",
        "Performance profile, friction x 2 after step 5",
    ]
    assert len({figure.name for figure in figures}) == 2


# The picture.


def test_the_profile_falls_at_every_score():
    drawing = profiles({"A": np.array([[1.0, 2.0]]), "B": np.array([[2.0, 4.0]])})
    assert drawing.scores == pytest.approx((0.0, 1.0, 2.0, 4.0, 4.12))
    assert [profile.share for profile in drawing.profiles] == [(1, 0.5, 0, 0, 0), (1, 1, 0.5, 0, 0)]
    assert all(profile.low == () for profile in drawing.profiles)
    assert drawing.note == ""


def test_the_page_and_the_picture_show_the_same_steps(tmp_path):
    scores = {"<A>": np.arange(10.0).reshape(5, 2), "B": np.ones((5, 2))}
    drawing = profiles(scores)
    (plot,) = plots(drawing)
    plotly.graph_objects.Figure({"data": plot.data, "layout": plot.layout})
    named = {trace["name"]: trace for trace in plot.data if "name" in trace}
    assert named["&lt;A&gt;"]["y"] == [1, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0, 0]
    assert named["B"]["y"] == [1, 1, *[0] * 10]
    assert {trace["line"]["shape"] for trace in plot.data} == {"hv"}
    low, high, *_ = plot.data
    assert all(
        under <= share <= over for under, share, over in zip(low["y"], named["&lt;A&gt;"]["y"], high["y"], strict=True)
    )
    assert named["B"]["text"][1] == " (1.00 to 1.00)"
    write(tmp_path / "it.html", "It", [Figure("profile", "Profile", drawing)])
    assert (tmp_path / "profile.png").stat().st_size > 10_000
    assert "band: 95 % bootstrap interval" in (tmp_path / "it.html").read_text()
    assert json.dumps(plot.data[0]["x"], separators=(",", ":")) in (tmp_path / "it.html").read_text()
