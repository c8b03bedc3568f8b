"""The figures of a report as data, and how they are drawn as PNG and SVG; `interactive` draws the same in a page."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.ticker import FuncFormatter, NullLocator

from csac.record.curves import DEVIATION, NEXT, SHARE
from csac.record.plots import (
    NO_LOOKS,
    RETURN,
    Format,
    Panel,
    draw_legend,
    grouped,
    head,
    learning_curves,
    looks_of,
    picture,
    save,
)
from csac.record.rendering import short
from csac.record.statistics import FEWEST_FOR_INTERVAL, is_case
from csac.studies.profiles import Profiles

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from csac.record.curves import Limits, Spread
    from csac.record.plots import Look
    from csac.record.summaries import OverSeeds

FORMATS: tuple[Format, ...] = ("png", "svg")
NOT_REACHED = "not reached"
PUBLISHED = "the paper"
LABEL_CHARACTERS = 56  # that fit side by side below bars, each label in lines of its share
TO_EITHER_SIDE, RANGE = "± one standard deviation over seeds", "range of the seeds that reach it"


class Curves(NamedTuple):
    """Learning curves, panel by panel on one scale; the band is the paper's: a standard deviation to either side."""

    panels: tuple[Panel, ...]
    quantity: str = RETURN
    spread: Spread = DEVIATION
    within: Limits | None = None
    looks: Mapping[str, Look] = NO_LOOKS
    """Those of the whole report."""

    def save(self, path: Path, title: str) -> None:
        """Draw it, in each format."""
        learning_curves(
            self.panels, path, title, FORMATS, self.quantity, self.spread, within=self.within, looks=self.looks
        )


class Bar(NamedTuple):
    """One bar: its height, NaN where there is none, how far it reaches down and up, and what the paper has."""

    label: str
    height: float
    low: float
    high: float
    published: float = np.nan


class BarPanel(NamedTuple):
    """Bars that stand side by side."""

    bars: tuple[Bar, ...]
    title: str = ""


class Bars(NamedTuple):
    """Bars with their reach, a mark where the paper's number is, and words where there is no bar."""

    panels: tuple[BarPanel, ...]
    quantity: str
    missing: str = ""
    """What is written where there is no bar."""
    note: str = ""
    """What is to be known to read it."""
    looks: Mapping[str, Look] = NO_LOOKS
    """Those of the whole report."""

    @property
    def labels(self) -> list[str]:
        """What its bars stand for."""
        return list(dict.fromkeys(bar.label for panel in self.panels for bar in panel.bars))

    @property
    def needs_legend(self) -> bool:
        """Whether there is no room for the labels below the bars."""
        words = [word for label in self.labels for word in label.split()]
        return len(self.panels) > 1 or max(map(len, words), default=0) > self._label_width

    @property
    def _label_width(self) -> int:
        return LABEL_CHARACTERS // max(1, len(self.labels))

    def save(self, path: Path, title: str) -> None:
        """Draw it, in each format."""
        looks = looks_of(self.labels, self.looks)
        with picture(2.9, len(self.panels), sharey=False) as figure:
            published: list[Artist] = []
            for axes, panel in zip(figure.axes, self.panels, strict=True):
                for position, bar in enumerate(panel.bars):
                    _draw_bar(axes, position, bar, looks[bar.label][0], self.missing)
                published += _draw_published(axes, panel.bars)
                labels = [textwrap.fill(bar.label, self._label_width, break_long_words=False) for bar in panel.bars]
                axes.set_xticks(range(len(panel.bars)), labels)
                if self.needs_legend:
                    axes.xaxis.set_major_locator(NullLocator())
                axes.set_xlim(-0.6, len(panel.bars) - 0.4)
                axes.set_ylim(bottom=0)
                axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
                axes.grid(visible=False, axis="x")
            figure.axes[0].set_ylabel(self.quantity)
            solid: dict[str, Look] = {label: (colour, "-") for label, (colour, _) in looks.items()}
            draw_legend(figure, solid if self.needs_legend else {}, published[:1])
            head(figure, title, [panel.title for panel in self.panels], self.note)
            save(figure, path, FORMATS)


class Line(NamedTuple):
    """A quantity over another, with its reach: NaN where it has none."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]


class Trend(NamedTuple):
    """Lines over a positive quantity of many magnitudes."""

    lines: tuple[Line, ...]
    name: str
    quantity: str
    note: str = ""
    """What is to be known to read it."""
    looks: Mapping[str, Look] = NO_LOOKS
    """Those of the whole report."""

    def save(self, path: Path, title: str) -> None:
        """Draw it, in each format."""
        looks = looks_of([line.label for line in self.lines], self.looks)
        with picture(3.0) as figure:
            axes = figure.axes[0]
            for index, line in enumerate(self.lines):
                colour, style = looks[line.label]
                x = np.array(line.x) * nudge(index, len(self.lines))
                axes.plot(x, line.y, color=colour, linestyle=style, linewidth=2.2, marker="o", markersize=6)
                axes.vlines(x, line.low, line.high, color=colour, linewidth=1.4)
            axes.set_xscale("log")
            values = sorted({value for line in self.lines for value in line.x})
            axes.set_xticks(values, [f"{value:g}" for value in values])
            axes.xaxis.set_minor_locator(NullLocator())
            axes.set_xlabel(self.name)
            axes.set_ylabel(self.quantity)
            axes.yaxis.set_major_formatter(grouped)
            draw_legend(figure, looks)
            head(figure, title, text=self.note)
            save(figure, path, FORMATS)


Drawing = Curves | Bars | Trend | Profiles


def nudge(index: int, lines: int) -> float:
    """Return the factor by which a line is moved aside on a logarithmic axis, so that no bar hides another."""
    return 1.06 ** (index - (lines - 1) / 2)


def success_curves(runs: Sequence[tuple[str, np.ndarray]], marks: Sequence[tuple[int, str]] = ()) -> Curves:
    """Return the curves of the share of successful episodes; one that says nothing of success had none."""
    panel = Panel([(label, _as_success(rows)) for label, rows in runs if tells_of_success(rows)], marks=marks)
    return Curves((panel,), "share of episodes with success", within=SHARE)


def tells_of_success(rows: np.ndarray) -> bool:
    """Return whether the task says which episodes succeed."""
    return is_case(rows["success"])


def bar_over_seeds(label: str, over: OverSeeds, published: float, factor: float = 1.0) -> Bar:
    """Return a bar for a mean and the standard deviation to either side, as far down as 0."""
    mean, std = factor * over.mean, factor * over.std
    return Bar(label, mean, max(mean - std, 0.0) if np.isfinite(std) else np.nan, mean + std, published)


def seeds_note(lines: str, seeds: Sequence[int]) -> str:
    """Say what the vertical lines of a picture are, and how many seeds each of its methods has; one has no line."""
    fewest, most = min(seeds, default=0), max(seeds, default=0)
    told = f"{most} seed{'s' * (most != 1)}" if fewest == most else f"{fewest} to {most} seeds"
    return NEXT.join([f"lines: {lines}"] * (most > 1) + [told])


def reach(values: np.ndarray) -> tuple[float, float]:
    """Return the lowest and the highest of the seeds that are finite, NaN where there are too few to show."""
    finite = values[np.isfinite(values)]
    if len(finite) < max(2, min(len(values), FEWEST_FOR_INTERVAL)):
        return np.nan, np.nan
    return float(finite.min()), float(finite.max())


def _draw_bar(axes: Axes, position: int, bar: Bar, colour: str, missing: str) -> None:
    if np.isfinite(bar.height):
        axes.bar(position, bar.height, width=0.6, color=colour)
    else:
        axes.annotate(
            missing, (position, 0), (0, 3), textcoords="offset points", rotation=90, ha="center", color=colour
        )
    if np.isfinite([bar.low, bar.high]).all():
        axes.plot([position, position], [bar.low, bar.high], color="#333333", linewidth=1.2)


def _draw_published(axes: Axes, bars: Sequence[Bar]) -> list[Artist]:
    """Mark the published numbers, and return what the legend shows of them: nothing where there is none."""
    published = np.array([bar.published for bar in bars])
    if not np.isfinite(published).any():
        return []
    place = np.arange(len(bars))
    points = axes.scatter(place, published, marker="D", s=28, color="#000000", edgecolors="white", zorder=4)
    points.set_label(PUBLISHED)
    return [points]


def _as_success(rows: np.ndarray) -> np.ndarray:
    told = rows.copy()
    told["return"] = np.nan_to_num(rows["success"], nan=0.0)
    return told
