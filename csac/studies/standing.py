"""Grids of methods and tasks: which cells are over, which failed, and how long they took."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from csac.console.tables import duration
from csac.record.rendering import EMPTY, Cell, Row, Table
from csac.studies.arms import by_condition
from csac.studies.parts import Heading, Items, Paragraph
from csac.studies.sections import described

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from csac.studies.arms import Arm, Time
    from csac.studies.parts import Part

DISTURBED = 2.0  # times as long as the others: something else was at work, and no longer the method
_MEDIANS = "Median over runs, of those that were never interrupted as far as that is known."


def cells_so_far(arms: Sequence[Arm]) -> Iterator[Part]:
    """How many cells there are, where some are missing, and why others failed."""
    done = sum(len(arm.manifests) for arm in arms)
    failed = sum(len(arm.failures) for arm in arms)
    missing = sum(len(arm.missing) for arm in arms)
    total = done + failed + missing
    text = f"{done} of {total} {'cell is' if total == 1 else 'cells are'} complete"
    unfinished = f", {missing} {'is' if missing == 1 else 'are'} not over"
    yield Paragraph(text + f", {failed} failed" * bool(failed) + unfinished * bool(missing) + ".")
    if failed or missing:
        yield _grid(arms, _complete)
    if reasons := [
        f"{', '.join([f'{arm.label} on {arm.task}', *arm.condition])}, seed {seed} failed: {reason}"
        for arm in arms
        for seed, reason in arm.failures.items()
    ]:
        yield Items(tuple(reasons))


def wall_times(arms: Sequence[Arm]) -> Iterator[Part]:
    """The median time of each method on each task, and runs that took so long that something must have been in the way.

    Nothing where no time is known.
    """
    known = [arm for arm in arms if arm.times]
    if not known:
        return
    yield Heading("Wall time")
    yield _grid(known, _median)
    yield Paragraph(_MEDIANS)
    if lines := [line for arm in known for line in _disturbed(arm, known)]:
        yield Paragraph("Another process had the machine too, or that task or seed is slower.", "These stand out.")
        yield Items(tuple(lines))


def _grid(arms: Sequence[Arm], cell: Callable[[Arm], Cell]) -> Table:
    """Return a row for each method and a column for each task and condition."""
    columns = by_condition(arms)
    rows = []
    for label in dict.fromkeys(arm.label for arm in arms):
        own = ([arm for arm in some if arm.label == label] for some in columns.values())
        rows.append(Row((Cell(label), *(cell(found[0]) if found else EMPTY for found in own))))
    return Table(("method", *(described(*column) or "runs" for column in columns)), tuple(rows))


def _complete(arm: Arm) -> Cell:
    done, failed = len(arm.manifests), len(arm.failures)
    if not done and not failed:
        return Cell("–", 0)
    wanted = done + failed + len(arm.missing)
    return Cell(f"{done} of {wanted}" + f", {failed} failed" * bool(failed), done)


def _median(arm: Arm) -> Cell:
    if not arm.times:
        return EMPTY
    whole = [time.seconds for time in arm.times if not time.interrupted]
    if not whole:
        seconds = float(np.median([time.seconds for time in arm.times]))
        return Cell(f"{duration(seconds)} (interrupted)", seconds)
    seconds = float(np.median(whole))
    runs = f" ({len(whole)} runs)" if len(whole) > 1 else ""
    return Cell(duration(seconds) + runs, seconds)


def _disturbed(arm: Arm, arms: Sequence[Arm]) -> Iterator[str]:
    """Tell of runs that took far longer for a step than the others: of that task, or where it has no two, of all."""
    for time in arm.times:
        beside = [other for other in arm.times if other is not time]
        elsewhere = [other for one in arms if one.label == arm.label for other in one.times if other is not time]
        others = beside if len(beside) > 1 else elsewhere
        usual = float(np.median([_for_a_step(other) for other in others])) if others else math.nan
        if _for_a_step(time) > DISTURBED * usual:
            where = ", ".join(filter(None, (arm.label, described(arm.task, arm.condition))))
            seeds = f"seed{'s' * (len(time.seeds) > 1)} {', '.join(map(str, time.seeds))}"
            factor, which = _for_a_step(time) / usual, "there" if others is beside else "anywhere"
            yield (
                f"{where}, {seeds}: {duration(time.seconds)}, for each step {factor:.1f} times the median of the "
                f"method's other runs {which}"
            )


def _for_a_step(time: Time) -> float:
    return time.seconds / (time.steps * len(time.seeds))
