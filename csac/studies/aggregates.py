"""What methods do over all tasks: interquartile means of normalised scores, probabilities of improvement, profiles.

After Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice". Compared are methods
that have the same seeds on the same tasks, and nothing else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from csac.record.rendering import EMPTY, Cell, Row, Table
from csac.record.statistics import (
    FEWEST_FOR_BOOTSTRAP,
    improvement_interval,
    interquartile_mean,
    last_evaluations,
    performance_profile,
    probability_of_improvement,
    profile_interval,
    stratified_bootstrap_interval,
)
from csac.record.summary_tables import no_interval
from csac.studies import paper
from csac.studies.parts import Heading, Paragraph
from csac.studies.profiles import Profile, Profiles
from csac.studies.sections import described

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from csac.studies.arms import Arm
    from csac.studies.parts import Part
    from csac.studies.sections import Scope

FEWEST_TASKS = 2
REFERENCE = "SAC"  # the paper's column that scores are a share of
_Item = TypeVar("_Item")
_SHARES = "share of the reference return"
MOST_SETS = 4_096  # beyond, no more intersections are made: of n sets there may be 2^n


class Block(NamedTuple):
    """Methods, tasks and seeds of which every combination was measured to its end."""

    labels: tuple[str, ...]
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]

    @property
    def size(self) -> int:
        """How many runs it holds."""
        return len(self.labels) * len(self.tasks) * len(self.seeds)


class Reference(NamedTuple):
    """The return that is 1 on each task, and whose it is."""

    name: str
    returns: Mapping[str, float]


def over_tasks(arms: Sequence[Arm], scope: Scope) -> Iterator[Part]:
    """The methods over all tasks, for each condition; nothing where there is one task alone.

    `arms` are all that are wanted, those without rows too, so that it can be said which are missing.
    """
    groups = [[arm for arm in arms if arm.condition == one] for one in dict.fromkeys(arm.condition for arm in arms)]
    groups = [own for own in groups if len({arm.task for arm in own}) >= FEWEST_TASKS]
    if groups:
        yield Heading(scope.titled("Over all tasks"))
    for own in groups:
        yield from _over_tasks(own, scope)


def largest_block(complete: Mapping[tuple[str, str], frozenset[int]]) -> Block | None:
    """Return the most runs that can be compared: of two tasks or more, with the same seeds of each method on each.

    `complete` are the seeds of each method and task. Of equals, one with methods to compare, then with more tasks, then
    with more seeds.
    """
    labels, tasks = (list(dict.fromkeys(names)) for names in zip(*complete, strict=True))
    seeds = sorted(set().union(*complete.values()))
    has = {(label, task): complete.get((label, task), frozenset()) for label in labels for task in tasks}
    choices = _with_intersections(
        frozenset(task for task in tasks if seed in has[label, task]) for label in labels for seed in seeds
    )
    blocks = []
    for chosen in (choice for choice in choices if len(choice) >= FEWEST_TASKS):
        common = {label: frozenset.intersection(*(has[label, task] for task in chosen)) for label in labels}
        for some in _with_intersections(common.values()):
            able = tuple(label for label in labels if some <= common[label])
            blocks.append(Block(able, tuple(task for task in tasks if task in chosen), tuple(sorted(some))))
    blocks = [block for block in blocks if block.size]
    return max(blocks, key=lambda it: (it.size, len(it.labels) > 1, len(it.tasks), len(it.seeds)), default=None)


def _over_tasks(arms: Sequence[Arm], scope: Scope) -> Iterator[Part]:
    changes = described("", arms[0].condition)
    scores = {(arm.label, arm.task): _scores(arm, _end(arms, arm.task)) for arm in arms}
    block = largest_block({key: frozenset(own) for key, own in scores.items()})
    if block is None:
        yield Paragraph("No method has the same seed on two tasks yet.", changes)
        return
    yield Paragraph(_comparable(arms, block), changes)
    reference = _reference(arms, scores, block)
    tasks = tuple(task for task in block.tasks if reference.returns[task] > 0)
    yield Paragraph(_told(reference, block, tasks))
    if len(tasks) < FEWEST_TASKS:
        return
    shares = {
        label: np.array(
            [[scores[label, task][seed] / reference.returns[task] for task in tasks] for seed in block.seeds]
        )
        for label in block.labels
    }  # [seed, task]
    title = scope.titled(", ".join(filter(None, ("Over all tasks", changes))))
    yield means_table(shares, title)
    if table := improvements_table(shares, _baselines(arms, block)):
        yield table
    title = ", ".join(filter(None, ("Performance profile", changes)))
    yield scope.figure("performance-profile", changes, profiles(shares), title)


def means_table(shares: Mapping[str, np.ndarray], title: str) -> Table:
    """Return the interquartile mean of each method's scores [seed, task], with its interval."""
    rows = []
    for label, own in shares.items():
        middle, bounds = interquartile_mean(own), stratified_bootstrap_interval(own, interquartile_mean)
        between = Cell(f"{bounds[0]:.3f} to {bounds[1]:.3f}", middle) if bounds else Cell(no_interval(len(own)), np.nan)
        rows.append(Row((Cell(label), Cell(f"{middle:.3f}", middle), between, Cell(str(own.size), own.size))))
    headings = ("method", f"IQM, {_SHARES}", "95 % bootstrap interval", "runs")
    return Table(headings, tuple(rows), title)


def improvements_table(shares: Mapping[str, np.ndarray], baselines: Sequence[str]) -> Table | None:
    """Return how probably a seed of each method scores higher than one of each baseline; None of one method alone."""
    others = [label for label in baselines if any(label != other for other in shares)]
    if not others:
        return None
    rows = [
        Row((Cell(label), *(EMPTY if label == other else _improvement(own, shares[other]) for other in others)))
        for label, own in shares.items()
        if [label] != others
    ]
    seeds = len(next(iter(shares.values())))
    note = "" if seeds >= FEWEST_FOR_BOOTSTRAP else no_interval(seeds)
    told = "Probability of improvement: that a seed scores higher, 95 % bootstrap interval"
    return Table(("method", *(f"above {label}" for label in others)), tuple(rows), told, note)


def profiles(shares: Mapping[str, np.ndarray]) -> Profiles:
    """Return the performance profile of each method's scores [seed, task], exact at every score that there is."""
    every = np.concatenate([own.ravel() for own in shares.values()])
    known = np.unique(every)
    margin = 0.03 * max(float(known[-1] - min(known[0], 0.0)), 1e-9)
    thresholds = np.array([min(known[0] - margin, 0.0), *known, known[-1] + margin])
    drawn = []
    for label, own in shares.items():
        bounds = profile_interval(own, thresholds)
        reach = [tuple(bound.tolist()) for bound in bounds] if bounds else []
        drawn.append(Profile(label, tuple(performance_profile(own, thresholds).tolist()), *reach))
    return Profiles(tuple(drawn), tuple(thresholds.tolist()), _SHARES)


def _scores(arm: Arm, end: int) -> dict[int, float]:
    """Return the score of each seed whose evaluations go to the end: others have learnt for less long."""
    whole = {int(seed) for seed in arm.rows["seed"][arm.rows["step"] == end]}
    return {seed: score for seed, score in last_evaluations(arm.rows).items() if seed in whole}


def _end(arms: Iterable[Arm], task: str) -> int:
    return max(int(arm.rows["step"].max(initial=0)) for arm in arms if arm.task == task)


def _reference(arms: Sequence[Arm], scores: Mapping[tuple[str, str], Mapping[int, float]], block: Block) -> Reference:
    """Return the paper's SAC where the study has its columns: a scale that does not hang on what was run."""
    if any(arm.published for arm in arms) and all(task in paper.RETURNS for task in block.tasks):
        returns = {task: paper.RETURNS[task][REFERENCE].mean for task in block.tasks}
        return Reference(f"maximum average return of the paper's {REFERENCE}", returns)
    first = _baselines(arms, block)[0]
    returns = {task: float(np.mean([scores[first, task][seed] for seed in block.seeds])) for task in block.tasks}
    return Reference(f"mean score of {first} as measured here, taken as exact", returns)


def _baselines(arms: Sequence[Arm], block: Block) -> list[str]:
    """Return the methods that are not CSAC, or else the first."""
    ours = {arm.label for arm in arms if arm.algorithm == "csac"}
    return [label for label in block.labels if label not in ours] or [block.labels[0]]


def _told(reference: Reference, block: Block, tasks: Sequence[str]) -> str:
    values = ", ".join(f"{task} {reference.returns[task]:,.2f}" for task in block.tasks)
    told = f"A score is the mean of a seed's last three evaluations, here as a share of the {reference.name}: {values}."
    if lost := [task for task in block.tasks if task not in tasks]:
        told += f" Left out, as there is no share of a return that is not positive: {', '.join(lost)}."
    return told


def _comparable(arms: Sequence[Arm], block: Block) -> str:
    """Say what is compared, and what is not for want of which cells."""
    tasks, labels = (list(dict.fromkeys(names)) for names in ((a.task for a in arms), (a.label for a in arms)))
    seeds = sorted({seed for arm in arms for seed in _wanted(arm)})
    told = (
        f"Compared are runs with the same seeds on the same tasks: {len(block.labels)} of {len(labels)} methods, "
        f"{len(block.tasks)} of {len(tasks)} tasks, {len(block.seeds)} of {len(seeds)} seeds."
    )
    lacking = [f"{label} ({_holes(arms, block, label)})" for label in labels if label not in block.labels]
    told += f" Not complete on these: {'; '.join(lacking)}." * bool(lacking)
    aside = [task for task in tasks if task not in block.tasks]
    lost = [str(seed) for seed in seeds if seed not in block.seeds]
    aside += [f"seed{'s' * (len(lost) > 1)} {', '.join(lost)}"] * bool(lost)
    return told + f" Not complete for these methods: {', '.join(aside)}." * bool(aside)


def _holes(arms: Sequence[Arm], block: Block, label: str) -> str:
    """Say which runs of a method are missing in a block."""
    found = {}
    for task in block.tasks:
        end = _end(arms, task)
        there = {seed for arm in arms if (arm.label, arm.task) == (label, task) for seed in _scores(arm, end)}
        found[task] = [str(seed) for seed in block.seeds if seed not in there]
    if all(len(missing) == len(block.seeds) for missing in found.values()):
        return "without any"
    lacking = [
        f"{task} seed{'s' * (len(missing) > 1)} {', '.join(missing)}" for task, missing in found.items() if missing
    ]
    return f"without {', '.join(lacking)}"


def _wanted(arm: Arm) -> set[int]:
    return {*map(int, arm.rows["seed"]), *arm.missing, *arm.failures}


def _improvement(own: np.ndarray, others: np.ndarray) -> Cell:
    probability, bounds = probability_of_improvement(own, others), improvement_interval(own, others)
    return Cell(f"{probability:.2f}" + (f" ({bounds[0]:.2f} to {bounds[1]:.2f})" if bounds else ""), probability)


def _with_intersections(sets: Iterable[frozenset[_Item]]) -> list[frozenset[_Item]]:
    """Return these sets and what any of them have in common, each once; of very many sets not all that is common."""
    found: dict[frozenset[_Item], None] = {}
    for one in sets:
        common = [one & other for other in found] if len(found) < MOST_SETS else []
        found |= dict.fromkeys([one, *common])
    return list(found)
