"""The sections of a report: which arms are in which picture, and how they look."""

from dataclasses import replace

import numpy as np
import pytest
from made import MadeRecords

from csac.record.rendering import Table
from csac.studies.arms import Arm, gather
from csac.studies.figures import Bars, Curves, Trend
from csac.studies.named import NAMED
from csac.studies.parts import Figure, Paragraph
from csac.studies.sections import Scope, cases, curves, efficiency, report_looks, returns, robustness, success
from csac.studies.study import Method


def pictures(arms):
    """The labels in each picture of curves, by the picture's title."""
    shown = {part.title: part.drawing for part in curves(arms, Scope("it")) if isinstance(part, Figure)}
    return {
        title: [label for label, _ in drawing.panels[0].runs]
        for title, drawing in shown.items()
        if isinstance(drawing, Curves)
    }


def study_of(name):
    (study,) = NAMED[name]
    return gather(study.narrowed(tasks=study.tasks[:1], seeds=1), MadeRecords(lambda *_: 1.0))


def arms(*labels):
    return [Arm(label, "Hopper-v4", algorithm=label.partition(" ")[0].lower()) for label in labels]


def test_too_many_arms_are_in_several_pictures_each_with_csac_beside_sac():
    baselines = ["SAC, 0.2", "SAC, automatic"]
    shown = pictures(study_of("reference"))
    assert list(shown) == ["Hopper-v4, CSAC 1 of 2", "Hopper-v4, CSAC 2 of 2"]
    first, second = shown.values()
    assert first == ["CSAC, paper", "CSAC, previous", "CSAC, periodic 100", *baselines]
    assert second == ["CSAC, periodic 1000", "CSAC, average 0.005", "CSAC, average 0.05", *baselines]


def test_variants_of_csac_that_are_swept_have_a_picture_each():
    shown = pictures(study_of("ablation"))
    assert list(shown) == ["Walker2d-v4, CSAC (paper)", "Walker2d-v4, CSAC (periodic)"]
    assert [len(labels) for labels in shown.values()] == [5, 5]


@pytest.mark.parametrize(
    ("labels", "wanted"),
    [
        ([f"csac {k}" for k in range(6)] + ["sac 0"], {"Hopper-v4": 7}),
        ([f"csac {k}" for k in range(7)] + ["sac 0"], {"Hopper-v4, 1 of 2": 5, "Hopper-v4, 2 of 2": 4}),
        ([f"sac {k}" for k in range(8)], {"Hopper-v4, 1 of 2": 4, "Hopper-v4, 2 of 2": 4}),
        (["csac 0", *(f"sac {k}" for k in range(7))], {"Hopper-v4": 8}),  # no room beside so many
    ],
)
def test_how_many_are_in_a_picture(labels, wanted):
    shown = pictures(arms(*labels))
    assert {title: len(own) for title, own in shown.items()} == wanted
    assert {label for own in shown.values() for label in own} == set(labels)


def test_what_stands_before_the_comma_has_a_look_of_its_own():
    looks = report_looks(["CSAC, tau 5", "CSAC, tau 50", "SAC"])
    assert [looks[label] for label in ("CSAC, tau 5", "CSAC, tau 50", "SAC")] == list(dict.fromkeys(looks.values()))
    assert looks["CSAC"] != looks["SAC"]
    later = report_looks(["SAC, slow", "SAC"], looks)
    assert later.items() >= looks.items()
    assert later["SAC, slow"] != later["SAC"]


# A task that is perturbed too.

CONDITIONS = ((), ("friction=2@500000",))
WHERE = ("{}", "{}, friction x 2 after step 500,000")


def perturbed(name, **narrow):
    """The arms of a study that has a condition more: twice the steps to each return, and half of the returns."""
    (study,) = NAMED[name]
    study = replace(study.narrowed(tasks=study.tasks[:1], **narrow), conditions=CONDITIONS)

    def value(cell, step):
        height = 1_000 if cell.algorithm == "ppo" else 5_000 + cell.hyperparameters.get("relative_entropy_weight", 0.0)
        return height * step / cell.steps / (2 if cell.perturbations else 1)

    return gather(study, MadeRecords(value))


def drawn(parts, kind):
    return {part.title: part for part in parts if isinstance(part, Figure) and isinstance(part.drawing, kind)}


def bars_of(parts):
    """The bars of the first panel of each picture."""
    return [
        part.drawing.panels[0].bars for part in parts if isinstance(part, Figure) and isinstance(part.drawing, Bars)
    ]


def headings(parts):
    return [(part.title, part.headings) for part in parts if isinstance(part, Table) and part.headings[0] == "method"]


def test_interactions_are_told_of_each_condition_by_itself():
    """Of each to its own boundary, which PPO sets at its last step; the paper has nothing that is perturbed."""
    parts = list(efficiency(perturbed("efficiency", seeds=2), Scope("it")))
    plainly, pushed = (where.format("HalfCheetah-v4") for where in WHERE)
    boundaries = [f"{plainly}, return 1,000.0", f"{pushed}, return 500.0"]
    assert headings(parts) == [
        (boundaries[0], ("method", "the paper", "measured, median seed", "reached")),
        (boundaries[1], ("method", "measured, median seed", "reached")),
    ]
    figures = drawn(parts, Bars)
    assert list(figures) == boundaries
    assert len({figure.name for figure in figures.values()}) == 2
    bars = bars_of(parts)
    assert [len({bar.label for bar in some}) for some in bars] == [len(some) for some in bars] == [6, 6]
    assert [bar.height for bar in bars[0]] == [bar.height for bar in bars[1]]
    assert [np.isfinite([bar.published for bar in some]).sum() for some in bars] == [5, 0]


def test_rollouts_end_in_each_condition_for_itself():
    parts = list(cases(perturbed("quadx", seeds=2), Scope("it")))
    told = ", out of bounds, collision, env complete"
    assert list(drawn(parts, Bars)) == [where.format("PyFlyt/QuadX-Waypoints-v1") + told for where in WHERE]
    bars = bars_of(parts)
    assert [np.isfinite([bar.published for bar in some]).sum() for some in bars] == [5, 0]
    tables = [part for part in parts if isinstance(part, Table)]
    assert [table.title for table in tables] == [
        *(where.format("PyFlyt/QuadX-Waypoints-v1") for where in WHERE),
        "The paper",
    ]
    assert [len(set(table.headings)) for table in tables] == [len(table.headings) for table in tables]


def test_the_papers_numbers_stand_beside_its_own_task_alone():
    elsewhere = [replace(arm, task="Hopper-v4") for arm in perturbed("quadx", seeds=2)]
    parts = list(cases(elsewhere, Scope("it")))
    assert not any(np.isfinite(bar.published) for some in bars_of(parts) for bar in some)
    assert "The paper" not in [part.title for part in parts if isinstance(part, Table)]
    assert not any(isinstance(part, Paragraph) for part in success(elsewhere, Scope("it")))
    assert any(isinstance(part, Paragraph) for part in success(study_of("panda"), Scope("it")))


def test_the_paper_s_returns_do_not_stand_beside_perturbed_ones():
    parts = list(returns(perturbed("mujoco", seeds=1), Scope("it")))
    maxima = [(title, "the paper" in told) for title, told in headings(parts) if "measured" in told]
    assert maxima == [(where.format("HalfCheetah-v4"), where == "{}") for where in WHERE]


def test_a_sweep_has_a_picture_for_each_condition():
    figures = drawn(returns(perturbed("ablation", seeds=1), Scope("it")), Trend)
    assert list(figures) == [f"{where.format('Walker2d-v4')}, over tau" for where in WHERE]
    assert len({figure.name for figure in figures.values()}) == 2


# Sweeps.


@pytest.mark.parametrize("others", [{}, {"preset": "paper"}, {"algorithm": "sac"}])
def test_a_sweep_is_of_methods_that_differ_in_that_number_alone(others):
    (study,) = NAMED["ablation"]
    first, second = (
        Method(f"mine, {weight:g}", "csac", hyperparameters={"entropy_weight": weight}) for weight in (0.1, 0.2)
    )
    study = replace(study.narrowed(seeds=1), methods=(first, replace(second, **others)))
    arms = gather(study, MadeRecords(lambda *_: 1.0))
    assert len(drawn(returns(arms, Scope("it")), Trend)) == (not others)


def test_two_conditions_that_begin_alike_have_a_title_each():
    conditions = ("friction=2@200000",), ("friction=2@200000", "friction=3@400000")
    (study,) = NAMED["efficiency"]
    study = replace(study.narrowed(tasks=["Hopper-v4"], algorithms=["sac"], seeds=1), conditions=conditions)
    some = gather(study, MadeRecords(lambda *_: 1.0))
    titles = [part.title for part in robustness(some, Scope("it")) if isinstance(part, Table)]
    both = "friction x 2 after step 200,000, friction x 3 after step 400,000"
    assert titles == [
        "Hopper-v4, friction x 2 after step 200,000",
        f"Hopper-v4, friction x 2 after step 200,000 (in {both})",
        "Hopper-v4, friction x 3 after step 400,000",
    ]


def test_the_name_of_a_picture_fits_into_a_folder_however_many_changes_it_is_of():
    changes = [f"friction x 1.{n} after step {n}00,000" for n in range(1, 10)]
    one, other = (Scope("ramp").file("curve", f"HalfCheetah-v4, {', '.join(some)}") for some in (changes, changes[:-1]))
    assert one != other
    assert max(map(len, (one, other))) < 255 - len(".png") - len("..12345678.1234567890")
    assert Scope("ramp").file("curve", "Hopper-v4") == "ramp-curve-hopper-v4"
    assert (
        Scope("ramp").file("curve", "gain = -.5")
        == "ramp-curve-gain-minus-.5"
        != Scope("ramp").file("curve", "gain = .5")
    )
