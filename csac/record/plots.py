"""Learning curves as pictures: PNG for the screen, PDF and SVG for a paper. Equal rows give equal files.

Few seeds are shown as few: one or two as themselves, three and four with their range, an interval from five on.
"""

from __future__ import annotations

import io
import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from csac.record.atomic import write_atomically
from csac.record.rendering import short
from csac.record.statistics import evaluation_matrix, mean_and_interval

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from matplotlib.axes import Axes


@contextmanager
def _without_a_backend() -> Iterator[None]:
    """Hide a choice of window that these pictures have no use for: a wrong one would stop matplotlib's import."""
    name = "MPLBACKEND"
    chosen = os.environ.pop(name, None)
    try:
        yield
    finally:
        if chosen is not None:
            os.environ[name] = chosen


with _without_a_backend():
    import matplotlib.style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import FuncFormatter, MaxNLocator

# Okabe and Ito's colours, distinct to colour-blind eyes; yellow is left out, too pale for a line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#444444")
LINE_STYLES: tuple[Literal["-", "--", "-.", ":"], ...] = ("-", "--", "-.", ":")
FEWEST_FOR_BAND = 3  # seeds: two have no range that their lines do not show
FEWEST_FOR_INTERVAL_BAND = 5  # seeds: of three, a t-interval is so high that nothing else is seen
LEGEND_CHARACTERS = 100  # that fit side by side below the axes
Format = Literal["png", "pdf", "svg"]
STYLE = {
    "font.size": 10.0,
    "axes.titlesize": 13.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.labelcolor": "#333333",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.8,
    "xtick.color": "#888888",
    "ytick.color": "#888888",
    "xtick.labelcolor": "#333333",
    "ytick.labelcolor": "#333333",
    "text.parse_math": False,
    "lines.markersize": 4.0,
    "lines.solid_capstyle": "round",
    "figure.constrained_layout.h_pad": 0.1,
    "figure.constrained_layout.w_pad": 0.1,
    "pdf.fonttype": 42,
    "svg.hashsalt": "csac",
}


def learning_curve(
    runs: Sequence[tuple[str, np.ndarray]],
    path: str | Path,
    title: str = "",
    marks: Sequence[tuple[int, str]] = (),
    formats: Sequence[Format] = ("png",),
    quantity: str = "return per evaluation episode",
) -> None:
    """Draw evaluation returns against environment steps per seed and save them, whole or not at all, as `path`.

    Each run is `(label, rows of evaluations.csv)`: a thick line for the mean over seeds; with it, thin lines for single
    seeds below five of them, a band for the range of three or four, and for the 95 % t-interval from five seeds on.
    `marks` are `(step, text)`: vertical lines, for what changed there. The suffix of `path` is replaced by each of
    `formats`; `quantity` is what the column `return` holds.
    """
    with matplotlib.style.context(["default", STYLE]):
        figure = Figure(figsize=(7.5, 4.8), layout="constrained")
        FigureCanvasAgg(figure)  # drawn by it whatever window the user has chosen
        axes = figure.add_subplot()
        evaluated = [(label, rows) for label, rows in runs if not np.isnan(rows["return"]).all()]
        returns = draw_curves(axes, evaluated)
        _dress(axes, title, returns, quantity)
        _draw_marks(axes, marks)
        _draw_legend(figure, [(label, len(seeds)) for (label, _), seeds in zip(evaluated, returns, strict=True)])
        save(figure, path, formats)


def save(figure: Figure, path: str | Path, formats: Sequence[Format]) -> None:
    """Save a figure in each format, whole or not at all, equal figures in equal files."""
    for kind in formats:
        _write(figure, Path(path).with_suffix(f".{kind}"), kind)


def draw_curves(axes: Axes, runs: Sequence[tuple[str, np.ndarray]]) -> list[np.ndarray]:
    """Draw the curves of runs, given as to `learning_curve`, and return the returns [seed, t] of each."""
    return [_draw_run(axes, index, rows) for index, (_, rows) in enumerate(runs)]


def _draw_run(axes: Axes, index: int, rows: np.ndarray) -> np.ndarray:
    colour, line_style = _look(index)
    steps, seeds, returns = evaluation_matrix(rows)
    mean, low, high = mean_and_interval(returns)
    marker = "o" if len(steps) == 1 else None
    if len(seeds) < FEWEST_FOR_INTERVAL_BAND:
        low, high = np.fmin.reduce(returns), np.fmax.reduce(returns)
    if len(seeds) >= FEWEST_FOR_BAND:
        axes.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0, zorder=1)
    if 1 < len(seeds) < FEWEST_FOR_INTERVAL_BAND:
        for line in returns:
            there = ~np.isnan(line)
            axes.plot(steps[there], line[there], color=colour, alpha=0.4, linewidth=0.7, marker=marker, zorder=2)
    axes.plot(steps, mean, color=colour, linestyle=line_style, linewidth=2.2, marker=marker, zorder=3)
    return returns


def _look(index: int) -> tuple[str, Literal["-", "--", "-.", ":"]]:
    """Colour and line style: the style changes once the colours are used up."""
    return COLOURS[index % len(COLOURS)], LINE_STYLES[index // len(COLOURS) % len(LINE_STYLES)]


def _dress(axes: Axes, title: str, returns: list[np.ndarray], quantity: str) -> None:
    several = any(len(seeds) > 1 for seeds in returns)
    axes.set_title(title, pad=24 if several else 12)
    axes.set_xlabel("environment steps per seed")
    axes.set_ylabel(quantity)
    axes.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 2.5, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda step, _: short(step)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}".replace("-", "−")))
    if not returns:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "no evaluations yet", transform=axes.transAxes, ha="center", color="#777777")
        return
    axes.set_xlim(0, max(axes.dataLim.x1, 1) * 1.015)
    axes.set_ylim(*_limits(axes, returns))
    if several:
        axes.text(
            0, 1.025, _note([len(seeds) for seeds in returns]), transform=axes.transAxes, fontsize=9, color="#777777"
        )


def _note(counts: list[int]) -> str:
    """Say what the lines and bands mean, of runs with so many seeds."""
    parts = ["line: mean over seeds"]
    if any(1 < count < FEWEST_FOR_INTERVAL_BAND for count in counts):
        parts.append("thin: single seeds")
    bands = []
    if any(FEWEST_FOR_BAND <= count < FEWEST_FOR_INTERVAL_BAND for count in counts):
        bands.append("their range")
    if any(count >= FEWEST_FOR_INTERVAL_BAND for count in counts):
        bands.append("95 % t-interval")
    if bands:
        parts.append("band: " + f", from {FEWEST_FOR_INTERVAL_BAND} seeds ".join(bands))
    return " · ".join(parts)


def _limits(axes: Axes, returns: list[np.ndarray]) -> tuple[float, float]:
    """Show all seeds, and of the bands no more than a quarter beyond."""
    lowest = min(float(np.nanmin(line)) for line in returns)
    highest = max(float(np.nanmax(line)) for line in returns)
    reach = 0.25 * (highest - lowest) or 1.0
    low, high = axes.get_ylim()
    return max(low, lowest - reach), min(high, highest + reach)


def _draw_marks(axes: Axes, marks: Sequence[tuple[int, str]]) -> None:
    for step, text in marks:
        axes.axvline(step, color="#555555", linewidth=1, linestyle=(0, (4, 3)))
        place = {"xycoords": ("data", "axes fraction"), "xytext": (4, -4), "textcoords": "offset points", "va": "top"}
        axes.annotate(text, (step, 1), fontsize=9, color="#333333", **place)


def _draw_legend(figure: Figure, entries: list[tuple[str, int]]) -> None:
    """Put the legend below the axes, where it covers no curve, in as many columns as the longest label allows."""
    if not entries:
        return
    handles = []
    for index, (label, seeds) in enumerate(entries):
        colour, line_style = _look(index)
        text = f"{label} ({seeds} seed{'s' * (seeds > 1)})"
        handles.append(Line2D([], [], color=colour, linestyle=line_style, linewidth=2.2, label=text))
    longest = max(len(handle.get_label()) for handle in handles)
    columns = min(len(handles), max(1, LEGEND_CHARACTERS // (longest + 6)))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False)


def _write(figure: Figure, path: Path, kind: Format) -> None:
    data = io.BytesIO()
    nothing = {"png": "Software", "pdf": "CreationDate", "svg": "Date"}[kind]  # that would differ from file to file
    figure.savefig(data, format=kind, dpi=160, metadata={nothing: None})
    write_atomically(path, data.getvalue())
