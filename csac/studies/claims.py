"""What the paper claims, held against what was measured: reproduced, not reproduced, or not yet decidable."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np

from csac.record.curve_measures import drawdown, recovery, steps_to_reach
from csac.record.statistics import (
    FEWEST_FOR_BOOTSTRAP,
    evaluation_matrix,
    improvement_interval,
    probability_of_improvement,
)
from csac.record.summaries import cases
from csac.record.summary_tables import no_interval
from csac.studies import paper
from csac.studies.arms import tasks_of, variant_of, with_rows
from csac.tasks.perturbations import by_step, perturbations_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from csac.record.curve_measures import Recovery
    from csac.studies.arms import Arm
    from csac.studies.study import Study

Verdict = Literal["reproduced", "not reproduced", "not yet decidable"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
NEARLY_ALL = 0.95  # of an evaluation's episodes: the paper's "nearly 100 %"
EVEN = 0.5  # the probability at which neither of two methods is better


class Comparison(NamedTuple):
    """That one arm is better than another: a number for each of its seeds, and of the other's; more is better."""

    claim: str
    ours: np.ndarray
    others: np.ndarray
    variant: str = ""
    """The variant of CSAC that it is about."""
    is_whole: bool = True
    """Whether the runs of both are as long as the paper's."""
    failed: tuple[str, ...] = ()
    """Which seeds of either are not counted, in words."""
    lacking: str = ""
    """What is not there yet that it hangs on, in words."""


class Decision(NamedTuple):
    """How a claim stands, and the interval that says so."""

    claim: str
    verdict: Verdict
    why: str


def decide(comparison: Comparison) -> Decision:
    """Return what the seeds say of a claim of which both sides were measured.

    It is reproduced where the 95 % interval of the probability that a seed of ours is above one of the others lies
    above one half, not reproduced where it lies below, and else not yet decidable; below five seeds there is none. Runs
    that are not whole decide nothing, and it is only said what holds of them; nor is anything decided while runs lack.
    """
    verdict, why = _verdict(comparison)
    told = "; ".join(filter(None, (why, comparison.lacking, *comparison.failed)))
    return Decision(comparison.claim, "not yet decidable" if comparison.lacking else verdict, told)


def _verdict(comparison: Comparison) -> tuple[Verdict, str]:
    ours, others = comparison.ours, comparison.others
    fewest = min(len(ours), len(others))
    probability, bounds = probability_of_improvement(ours, others), improvement_interval(ours, others)
    told = f"better in {probability:.0%} of the pairs of seeds"
    if bounds is None:
        return "not yet decidable", f"{told}; {no_interval(fewest)} below {FEWEST_FOR_BOOTSTRAP}"
    low, high = bounds
    verdict: Verdict = "reproduced" if low > EVEN else "not reproduced" if high < EVEN else "not yet decidable"
    told += f", 95 % interval {low:.0%} to {high:.0%}"
    if not comparison.is_whole:
        words = {"reproduced": "it holds", "not reproduced": "it does not hold", "not yet decidable": "it is open"}
        return "not yet decidable", f"of the shortened runs {words[verdict]}: {told}"
    return verdict, told


def comparisons(study: Study, arms: Sequence[Arm]) -> list[Comparison]:
    """Return what the paper claims of a study, held against each variant of CSAC that was run.

    Of perturbed tasks the paper claims robustness alone.
    """
    kinds = [kind for kind in study.analyses if kind in _KINDS] if study.claims else []
    plain = [arm for arm in arms if not arm.condition]
    return [one for kind in kinds for one in _KINDS[kind](arms if kind == "robustness" else plain)]


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
        if any(map(_is_weighed, own)):
            yield from _weights(own)
        published = paper.RETURNS.get(task, {})
        for arm, other in _pairs([arm for arm in own if not _is_weighed(arm)]):
            name = other.published or ""
            if name in published and published["CSAC"].mean > published[name].mean:
                yield _better(f"{task}: a higher maximum average return than {name}", arm, other, _best)
            if name == "SAC" and name in published:
                yield from _stability(task, arm, other)


def _stability(task: str, arm: Arm, other: Arm) -> Iterator[Comparison]:
    """What "more stable" is taken to be: less of a fall while learning, and less between seeds."""
    yield _better(f"{task}: a smaller largest fall of a learning curve than {other.published}", arm, other, _steadiness)
    published = paper.RETURNS[task]
    if published["CSAC"].std < published["SAC"].std:
        claim = f"{task}: maximum average returns of the seeds nearer to their mean than {other.published}'s"
        yield _better(claim, arm, other, _closeness)


def _closeness(arm: Arm) -> np.ndarray:
    """Return minus each seed's distance from the mean of the seeds; none where there is one alone.

    Not from their median, which one of an odd number of seeds is: so that none could ever be nearer.
    """
    best = _best(arm)
    return -np.abs(best - best.mean()) if len(best) > 1 else np.zeros(0)


def _weights(arms: Sequence[Arm]) -> Iterator[Comparison]:
    """The weight that the paper finds best against each other weight, within each variant."""
    values = [(arm, value) for arm in arms if (value := _weight(arm)) is not None]
    for best in (arm for arm, value in values if value == paper.BEST_TAU):
        for other, value in values:
            if variant_of(other.label) == variant_of(best.label) and value != paper.BEST_TAU:
                yield _better(
                    f"tau {paper.BEST_TAU:g}: a higher maximum average return than {value:g}", best, other, _best
                )


def _is_weighed(arm: Arm) -> bool:
    """Return whether it stands beside one of the paper's weights, and not beside one of its methods."""
    return (arm.published or "").startswith("tau")


def _weight(arm: Arm) -> float | None:
    """Return the weight that an arm stands for: the paper's, or, of one without a column, the number it was given."""
    if _is_weighed(arm):
        return float((arm.published or "").removeprefix("tau "))
    given = None if arm.published else arm.hyperparameters.get("relative_entropy_weight")
    return given if isinstance(given, int | float) else None


def _efficiency(arms: Sequence[Arm]) -> Iterator[Comparison]:
    for task, own in tasks_of(arms).items():
        published, threshold = paper.INTERACTIONS.get(task, {}), lower_boundary(own)
        lacking = _lacking_boundary(own) if published else ""
        for arm, other in _pairs(own):
            name = other.published or ""
            if name in published and published["CSAC"] < published[name]:
                claim = f"{task}: fewer interactions than {name} to reach the lower boundary"
                comparison = _better(claim, arm, other, partial(_sooner, threshold=threshold))
                yield comparison._replace(lacking=lacking)


def _lacking_boundary(arms: Sequence[Arm]) -> str:
    """Say what the lower boundary of a task of the paper's lacks: seeds of its methods, or the one that sets it."""
    returns = paper.RETURNS[arms[0].task]
    lowest = min(returns, key=lambda name: returns[name].mean)
    lacking = [arm.label for arm in arms if arm.published and (arm.missing or not len(arm.rows))]
    lacking += [lowest] * all(arm.published != lowest for arm in arms)
    return f"the boundary lacks runs of {', '.join(lacking)}" if lacking else ""


def _robustness(arms: Sequence[Arm]) -> Iterator[Comparison]:
    measures: tuple[tuple[str, Callable[[Recovery], float]], ...] = (
        ("loses less of its return", lambda one: -one.relative_drop),
        ("comes back sooner", lambda one: -min(one.steps_to_regain, 1e12)),
        ("ends higher", lambda one: one.final),
    )
    arms = [arm for arm in arms if _is_of_the_paper(arm)]
    for condition in dict.fromkeys(arm.condition for arm in arms):
        for arm, other in _pairs([arm for arm in arms if arm.condition == condition]):
            if other.published == "SAC":
                for words, value in measures:
                    claim = f"{', '.join(condition)}: {words} than {other.published}"
                    yield _better(claim, arm, other, lambda one, value=value: _of_recoveries(one, value))


def _is_of_the_paper(arm: Arm) -> bool:
    changes = perturbations_of(arm.condition)
    return (
        arm.task == paper.FRICTION_TASK
        and len(changes) == 1
        and changes[0].kind == "friction"
        and changes[0].value in paper.FRICTION_FACTORS
    )


def _cases(arms: Sequence[Arm]) -> Iterator[Comparison]:
    for arm, other in _pairs([arm for arm in arms if arm.task == paper.CASES_TASK]):
        for name, published in paper.CASES.items():
            told = published.get(other.published or "")
            if told is None:
                continue
            fewer = name != "env_complete"
            if (published["CSAC"].mean < told.mean) == fewer:
                claim = f"{'fewer' if fewer else 'more'} rollouts with {name} than {other.published}"
                yield _better(claim, arm, other, partial(_shares, name=name, sign=-1 if fewer else 1))


def _success(arms: Sequence[Arm]) -> Iterator[Comparison]:
    for arm, other in _pairs([arm for arm in arms if arm.task == paper.SUCCESS_TASK]):
        if other.published in paper.SUCCESS_STEPS:
            claim = f"{arm.task}: success in {NEARLY_ALL:.0%} of an evaluation's episodes sooner than {other.published}"
            yield _better(claim, arm, other, _sooner_success)


def _better(claim: str, arm: Arm, other: Arm, value: Callable[[Arm], np.ndarray]) -> Comparison:
    """Return a claim of `value` [seed] of two arms; of an arm without rows there is none."""
    ours, others = (value(one) if len(one.rows) else np.zeros(0) for one in (arm, other))
    steps = paper.STEPS.get(arm.task, np.inf)
    is_whole = all(manifest.config.steps >= steps for one in (arm, other) for manifest in one.manifests)
    in_time = all(change.step == paper.FRICTION_STEP for change in perturbations_of(arm.condition))
    failed = tuple(_lost(one) for one in (arm, other) if one.failures)
    return Comparison(claim, ours, others, variant_of(arm.label), is_whole and in_time, failed)


def _lost(arm: Arm) -> str:
    count = len(arm.failures)
    return f"{count} seed{'s' * (count > 1)} of {arm.label} failed and {'are' if count > 1 else 'is'} not counted"


def _best(arm: Arm) -> np.ndarray:
    return arm.best()[0]


def _steadiness(arm: Arm) -> np.ndarray:
    _, _, returns = evaluation_matrix(arm.rows)
    return np.array([-drawdown(line) for line in returns])


def _sooner(arm: Arm, threshold: float) -> np.ndarray:
    """Steps with a minus, so that more is better; seeds that do not get there are all alike, behind all that do."""
    steps = interactions(arm, threshold)
    return -np.where(np.isinf(steps), arm.rows["step"].max() + 1, steps)


def _sooner_success(arm: Arm) -> np.ndarray:
    rows = arm.rows.copy()
    rows["return"] = np.nan_to_num(rows["success"], nan=0.0)
    return _sooner(replace(arm, evaluations=[rows]), NEARLY_ALL)


def _of_recoveries(arm: Arm, value: Callable[[Recovery], float]) -> np.ndarray:
    (step, _), *_ = by_step(perturbations_of(arm.condition))
    return np.array([value(one) for one in recovery(arm.rows, step).values() if not np.isnan(one.drop)])


def _shares(arm: Arm, name: str, sign: int) -> np.ndarray:
    rows = arm.rollouts
    found = [case for case in cases(rows) if case.name == name] if len(rows) else []
    return sign * np.array(list(found[0].by_seed.values())) if found else np.zeros(0)


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
    "success": _success,
}
