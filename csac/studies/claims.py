"""What the paper claims, held against what was measured: reproduced, not reproduced, or not yet decidable."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from csac.record.curve_measures import recovery, steps_to_reach
from csac.record.statistics import (
    FEWEST_FOR_BOOTSTRAP,
    evaluation_matrix,
    improvement_interval,
    probability_of_improvement,
)
from csac.record.summaries import cases
from csac.studies import paper
from csac.studies.arms import tasks_of, with_rows
from csac.tasks.perturbations import by_step, perturbations_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from csac.studies.arms import Arm

Verdict = Literal["reproduced", "not reproduced", "not yet decidable"]
EVEN = 0.5  # the probability at which neither of two methods is better


class Comparison(NamedTuple):
    """That one arm is better than another: a number for each of its seeds, and of the other's; more is better."""

    claim: str
    ours: np.ndarray
    others: np.ndarray


class Decision(NamedTuple):
    """How a claim stands, and the interval that says so."""

    claim: str
    verdict: Verdict
    why: str


def decide(comparison: Comparison, is_whole: bool = True) -> Decision:
    """Return what the seeds say of a claim.

    It is reproduced where the 95 % interval of the probability that a seed of ours is above one of the others lies
    above one half, not reproduced where it lies below, and else not yet decidable; below five seeds there is none. Runs
    that are not whole decide nothing, and it is only said what holds of them.
    """
    ours, others = comparison.ours, comparison.others
    fewest = min(len(ours), len(others))
    if not fewest:
        return Decision(comparison.claim, "not yet decidable", "not measured")
    probability, bounds = probability_of_improvement(ours, others), improvement_interval(ours, others)
    told = f"better in {probability:.0%} of the pairs of seeds"
    if bounds is None:
        few = f"{fewest} seed{'s' * (fewest > 1)}: no interval below {FEWEST_FOR_BOOTSTRAP}"
        return Decision(comparison.claim, "not yet decidable", f"{told}; {few}")
    low, high = bounds
    verdict: Verdict = "reproduced" if low > EVEN else "not reproduced" if high < EVEN else "not yet decidable"
    told += f", 95 % interval {low:.0%} to {high:.0%}"
    if not is_whole:
        words = {"reproduced": "it holds", "not reproduced": "it does not hold", "not yet decidable": "it is open"}
        return Decision(comparison.claim, "not yet decidable", f"of the shortened runs {words[verdict]}: {told}")
    return Decision(comparison.claim, verdict, told)


def comparisons(name: str, analyses: Sequence[str], arms: Sequence[Arm]) -> list[Comparison]:
    """Return what the paper claims of a study: of each variant of CSAC that was run."""
    found: list[Comparison] = []
    for kind in analyses:
        if kind in _KINDS and name != "reference":
            found += _KINDS[kind](arms)
    return found


def lower_boundary(arms: Sequence[Arm]) -> float:
    """Return the lowest maximum average return of the arms that the paper has too; NaN where there is none."""
    maxima = [arm.maximum().mean for arm in with_rows(arms) if arm.published]
    return min(maxima, default=np.nan)


def interactions(arm: Arm, threshold: float) -> np.ndarray:
    """Return the steps at which each seed first reaches a return, infinite where it does not."""
    steps, _, returns = evaluation_matrix(arm.rows)
    return np.array([steps_to_reach(steps, line, threshold) for line in returns])


def _returns(arms: Sequence[Arm]) -> Iterator[Comparison]:
    for task, own in tasks_of(arms).items():
        if any(arm.published and arm.published.startswith("tau") for arm in own):
            yield from _weights(own)
            continue
        published = paper.RETURNS.get(task, {})
        for arm, other in _pairs(own):
            name = other.published or ""
            if name in published and published["CSAC"].mean > published[name].mean:
                claim = f"{task}: {arm.label} has a higher maximum average return than {name}"
                yield Comparison(claim, arm.best()[0], other.best()[0])


def _weights(arms: Sequence[Arm]) -> Iterator[Comparison]:
    """The weight that the paper finds best against each other weight, within each variant."""
    values = [(arm, arm.hyperparameters["relative_entropy_weight"]) for arm in arms]
    for best in (arm for arm, value in values if value == paper.BEST_TAU):
        variant = best.label.partition(", ")[0]
        for other, value in values:
            if other.label.partition(", ")[0] == variant and value != paper.BEST_TAU:
                claim = f"{variant}: tau {paper.BEST_TAU:g} has a higher maximum average return than tau {value:g}"
                yield Comparison(claim, best.best()[0], other.best()[0])


def _efficiency(arms: Sequence[Arm]) -> Iterator[Comparison]:
    for task, own in tasks_of(arms).items():
        published, threshold = paper.INTERACTIONS.get(task, {}), lower_boundary(own)
        for arm, other in _pairs(own):
            name = other.published or ""
            if name in published and published["CSAC"] < published[name]:
                claim = f"{task}: {arm.label} needs fewer interactions than {name} to reach the lower boundary"
                yield Comparison(claim, *(_sooner(one, threshold) for one in (arm, other)))


def _sooner(arm: Arm, threshold: float) -> np.ndarray:
    """Steps with a minus, so that more is better; seeds that do not get there are all alike, behind all that do."""
    if not len(arm.rows):
        return np.zeros(0)
    steps = interactions(arm, threshold)
    return -np.where(np.isinf(steps), arm.rows["step"].max() + 1, steps)


def _robustness(arms: Sequence[Arm]) -> Iterator[Comparison]:
    measures: tuple[tuple[str, Callable], ...] = (
        ("loses less of its return", lambda one: -one.relative_drop),
        ("comes back sooner", lambda one: -min(one.steps_to_regain, 1e12)),
        ("ends higher", lambda one: one.final),
    )
    for condition in dict.fromkeys(arm.condition for arm in arms):
        for arm, other in _pairs([arm for arm in arms if arm.condition == condition]):
            for words, value in measures:
                ours, others = ([value(one) for one in _recoveries(each)] for each in (arm, other))
                claim = f"{', '.join(condition)}: {arm.label} {words} than {other.label}"
                yield Comparison(claim, np.array(ours), np.array(others))


def _recoveries(arm: Arm) -> list:
    (step, _), *_ = by_step(perturbations_of(arm.condition))
    return [one for one in recovery(arm.rows, step).values() if not np.isnan(one.drop)] if len(arm.rows) else []


def _cases(arms: Sequence[Arm]) -> Iterator[Comparison]:
    for arm, other in _pairs(arms):
        if other.published is None:
            continue
        for name, published in paper.CASES.items():
            fewer = name != "env_complete"
            ours, theirs = published["CSAC"].mean, published[other.published].mean
            if (ours < theirs) == fewer:
                words = f"{'fewer' if fewer else 'more'} rollouts with {name}"
                samples = (-_shares(each, name) if fewer else _shares(each, name) for each in (arm, other))
                yield Comparison(f"{arm.label} has {words} than {other.label}", *samples)


def _shares(arm: Arm, name: str) -> np.ndarray:
    rows = arm.rollouts
    found = [case for case in cases(rows) if case.name == name] if len(rows) else []
    return np.array(list(found[0].by_seed.values())) if found else np.zeros(0)


def _pairs(arms: Sequence[Arm]) -> Iterator[tuple[Arm, Arm]]:
    """Each variant of CSAC beside each other method."""
    for arm in (arm for arm in arms if arm.algorithm == "csac"):
        for other in (other for other in arms if other.algorithm != "csac"):
            yield arm, other


_KINDS: dict[str, Callable[[Sequence[Arm]], Iterator[Comparison]]] = {
    "returns": _returns,
    "efficiency": _efficiency,
    "robustness": _robustness,
    "cases": _cases,
}
