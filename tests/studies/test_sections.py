"""The sections of a report: which arms are in which picture, and how they look."""

import pytest
from made import MadeRecords

from csac.studies.arms import Arm, gather
from csac.studies.figures import Curves
from csac.studies.named import NAMED
from csac.studies.parts import Figure
from csac.studies.sections import Scope, curves, report_looks


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
    assert list(shown) == ["Walker2d-v4, CSAC (paper)", "Walker2d-v4, CSAC (default)"]
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
