"""Plot learning curves: PNG for the screen, SVG for a page, PDF for a paper. Equal rows give equal files.

One or two seeds are drawn as single lines, three or four with their range, more with a confidence interval.
"""

from __future__ import annotations

import io
import itertools
import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from csac.record.files import write_atomically
from csac.record.rendering import short
from csac.record.statistics import evaluation_matrix, mean_and_interval

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from matplotlib.axes import Axes

# Okabe and Ito's palette for colour-blind readers, without yellow, which is too pale for a line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#444444")
LineStyle = Literal["-", "--", "-.", ":"]
Look = tuple[str, LineStyle]  # a colour and a line style
LINE_STYLES: tuple[LineStyle, ...] = get_args(LineStyle)
FEWEST_FOR_BAND = 3  # seeds: the lines of two already show their range
FEWEST_FOR_INTERVAL_BAND = 5  # seeds: with three, a t-interval is so wide that it dwarfs everything else
WIDTH, HEIGHT = 5.0, 3.5  # inches: scaled down to a column of 3.4 inches, text is still 6 points
PIXELS = 1200  # width of an image
CHARACTERS = 13  # of legend text per inch
LINE = 0.2  # inches per line of a legend or a title
RETURN = "return per evaluation episode"
STYLE: Mapping[str, Any] = {
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.labelcolor": "#333333",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E4E4",
    "xtick.color": "#888888",
    "ytick.color": "#888888",
    "xtick.labelcolor": "#333333",
    "ytick.labelcolor": "#333333",
    "text.parse_math": False,
    "lines.markersize": 4.0,
    "pdf.fonttype": 42,
    "svg.hashsalt": "csac",
}


class Curve(NamedTuple):
    """One run's evaluations: `returns` [seed, t] at `steps` [t], their `mean` [t], and a band from `low` to `high`."""

    label: str
    steps: np.ndarray
    returns: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, label: str, rows: np.ndarray) -> Curve:
        """Return the curve for rows of evaluations.csv."""
        steps, seeds, returns = evaluation_matrix(rows)
        mean, low, high = mean_and_interval(returns)
        if len(seeds) < FEWEST_FOR_INTERVAL_BAND:
            low, high = np.fmin.reduce(returns), np.fmax.reduce(returns)
        else:  # of two seeds that go on alone, the interval is ± 9 standard deviations
            few = np.isfinite(returns).sum(axis=0) < FEWEST_FOR_INTERVAL_BAND
            low, high = (np.where(few, np.nan, limit) for limit in (low, high))
        return cls(label, steps, returns, mean, low, high)


def learning_curve(
    runs: Sequence[tuple[str, np.ndarray]], path: str | Path, title: str = "", marks: Sequence[tuple[int, str]] = ()
) -> None:
    """Plot evaluation returns against environment steps per seed and save them as `path`, a .png, .svg or .pdf file."""
    path = Path(path)
    write_atomically(path, encoded(figure_of(runs, title, marks), path.suffix[1:]))


def figure_of(
    runs: Sequence[tuple[str, np.ndarray]],
    title: str = "",
    marks: Sequence[tuple[int, str]] = (),
    quantity: str = RETURN,
    limits: tuple[float, float] | None = None,
    looks: Mapping[str, Look] | None = None,
) -> Figure:
    """Return a figure with the curve of each run, given as `(label, rows of evaluations.csv)`.

    `marks` are `(step, what changed there)`; `quantity` names what the column `return` holds, and `limits` are those of
    its axis; `looks` sets the looks of some labels, to match other figures.
    """
    curves = [Curve.of(*run) for run in runs]
    looks = {**looks_of(label for label, _ in runs), **(looks or {})}
    with matplotlib.style.context(["default", dict(STYLE)]):
        figure = Figure(figsize=(WIDTH, HEIGHT), dpi=PIXELS / WIDTH, layout="constrained")
        axes = figure.subplots()
        for curve in curves:
            _draw_curve(axes, curve, looks[curve.label])
        _dress(axes, curves, marks)
        axes.set(ylabel=quantity, ylim=limits)
        _draw_legend(figure, curves, looks)
        if title:
            lines = textwrap.wrap(title, int(0.68 * CHARACTERS * WIDTH))
            figure.suptitle("\n".join(lines), x=0.02, ha="left", fontsize=13, fontweight="bold")
            figure.set_figheight(figure.get_figheight() + LINE * len(lines))
    return figure


def encoded(figure: Figure, kind: str = "png") -> bytes:
    """Return the content of a png, svg or pdf file of a figure."""
    data = io.BytesIO()
    date = {"png": "Software", "pdf": "CreationDate", "svg": "Date"}[kind]  # would differ between equal figures
    with matplotlib.style.context(["default", dict(STYLE)]):
        figure.savefig(data, format=kind, dpi=figure.dpi, metadata={date: None})
    return data.getvalue()


def looks_of(labels: Iterable[str]) -> dict[str, Look]:
    """Return a colour and a line style for each label; the line style changes once all colours are used."""
    looks: Iterator[Look] = itertools.cycle((colour, style) for style in LINE_STYLES for colour in COLOURS)
    return dict(zip(dict.fromkeys(labels), looks, strict=False))


def _dress(axes: Axes, curves: Sequence[Curve], marks: Sequence[tuple[int, str]]) -> None:
    axes.set_xlabel("environment steps per seed")
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda step, _: short(step)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}".replace("-", "−")))
    axes.set_xlim(0, 1.015 * max(float(curve.steps.max()) for curve in curves) or 1.0)
    for step, text in [mark for mark in marks if mark[0] <= axes.get_xlim()[1]]:
        axes.axvline(step, color="#555555", linewidth=1, linestyle=(0, (4, 3)))
        axes.annotate(text, (step, 1), (4, -4), ("data", "axes fraction"), "offset points", va="top", fontsize=9)


def _draw_curve(axes: Axes, curve: Curve, look: Look) -> None:
    (colour, style), seeds = look, len(curve.returns)
    marker = "o" if len(curve.steps) == 1 else None
    if seeds >= FEWEST_FOR_BAND:
        axes.fill_between(curve.steps, curve.low, curve.high, color=colour, alpha=0.15, linewidth=0, zorder=1)
    if 1 < seeds < FEWEST_FOR_INTERVAL_BAND:
        for line in curve.returns:
            there = ~np.isnan(line)
            axes.plot(curve.steps[there], line[there], color=colour, alpha=0.4, linewidth=0.7, marker=marker, zorder=2)
    axes.plot(curve.steps, curve.mean, color=colour, linestyle=style, linewidth=2.2, marker=marker, zorder=3)


def _draw_legend(figure: Figure, curves: Sequence[Curve], looks: Mapping[str, Look]) -> None:
    """Draw the legend, and what lines and bands mean, below the axes; the figure grows by its height."""
    texts = {f"{c.label} ({len(c.returns)} seed{'s' * (len(c.returns) > 1)})": looks[c.label] for c in curves}
    wrapped = {text: textwrap.wrap(text, int(CHARACTERS * WIDTH) - 8) for text in texts}
    handles = [
        Line2D([], [], color=look[0], linestyle=look[1], linewidth=2.2, label="\n".join(wrapped[text]))
        for text, look in texts.items()
    ]
    columns = max(1, min(len(texts), int(CHARACTERS * WIDTH) // (max(map(len, texts)) + 5)))
    height = math.ceil(len(texts) / columns) if columns > 1 else sum(map(len, wrapped.values()))
    note = textwrap.wrap(_note(curves), int(1.1 * CHARACTERS * WIDTH))
    options = {"title": "\n".join(note), "title_fontsize": 9, "alignment": "left", "frameon": False}
    figure.legend(handles=handles, loc="outside lower left", ncols=columns, **options)
    figure.set_figheight(figure.get_figheight() + LINE * (height + len(note)))


def _note(curves: Sequence[Curve]) -> str:
    """Return what lines and bands mean in a plot of these curves; empty if all have a single seed."""
    counts = [len(curve.returns) for curve in curves]
    if max(counts) == 1:
        return ""
    few = [count for count in counts if 1 < count < FEWEST_FOR_INTERVAL_BAND]
    parts = ["line: mean over seeds", *["thin: single seeds"] * bool(few)]
    has_range = max(few, default=0) >= FEWEST_FOR_BAND
    parts += ["band: range of seeds"] * has_range
    if max(counts) >= FEWEST_FOR_INTERVAL_BAND:
        parts.append(f"band{' from 5 seeds' * has_range}: 95 % t-interval")
    return " · ".join(parts)
