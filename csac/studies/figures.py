"""The pictures of a study: curves, bars and success, as PNG and SVG."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import matplotlib.style
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from csac.record.plots import COLOURS, STYLE, Format, learning_curve, save
from csac.record.rendering import short
from csac.record.statistics import FEWEST_FOR_INTERVAL, is_case

if TYPE_CHECKING:
    from collections.abc import Sequence

FORMATS: tuple[Format, ...] = ("png", "svg")
NOT_REACHED = "not reached"


class Bar(NamedTuple):
    """One bar: its height, NaN where there is none, how far it reaches down and up, and what the paper has."""

    label: str
    height: float
    low: float
    high: float
    published: float


def curves(
    path: Path, title: str, runs: Sequence[tuple[str, np.ndarray]], marks: Sequence[tuple[int, str]] = ()
) -> None:
    """Draw learning curves, given as `(label, rows)`."""
    learning_curve(runs, path, title=title, marks=marks, formats=FORMATS)


def success_curves(path: Path, title: str, runs: Sequence[tuple[str, np.ndarray]]) -> None:
    """Draw the share of successful evaluation episodes; an episode that says nothing of success had none."""
    told = [(label, _as_success(rows)) for label, rows in runs if is_case(rows["success"])]
    learning_curve(told, path, title=title, formats=FORMATS, quantity="share of episodes with success")


def bars(path: Path, title: str, quantity: str, several: Sequence[Bar]) -> None:
    """Draw bars with their reach, a mark where the paper's number is, and words where there is no bar."""
    with matplotlib.style.context(["default", STYLE]):
        figure = Figure(figsize=(7.5, 3.6), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        positions = np.arange(len(several))
        for position, bar in zip(positions, several, strict=True):
            colour = COLOURS[position % len(COLOURS)]
            if np.isfinite(bar.height):
                axes.bar(position, bar.height, width=0.6, color=colour)
            else:
                axes.annotate(NOT_REACHED, (position, 0), rotation=90, ha="center", va="bottom", color=colour)
            if np.isfinite([bar.low, bar.high]).all():
                axes.plot([position, position], [bar.low, bar.high], color="#333333", linewidth=1.2)
        published = np.array([bar.published for bar in several])
        if np.isfinite(published).any():
            axes.scatter(positions, published, marker="D", s=28, color="#000000", zorder=4, label="the paper")
            axes.legend(frameon=False)
        axes.set_xticks(positions, [bar.label for bar in several])
        axes.set_ylabel(quantity)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
        axes.set_title(title, pad=12)
        axes.grid(visible=False, axis="x")
        save(figure, path, FORMATS)


def reach(values: np.ndarray) -> tuple[float, float]:
    """Return the lowest and the highest of the seeds, NaN where there are too few to show."""
    finite = values[np.isfinite(values)]
    if len(finite) < max(2, min(len(values), FEWEST_FOR_INTERVAL)):
        return np.nan, np.nan
    return float(finite.min()), float(finite.max())


def _as_success(rows: np.ndarray) -> np.ndarray:
    told = rows.copy()
    told["return"] = np.nan_to_num(rows["success"], nan=0.0)
    return told
