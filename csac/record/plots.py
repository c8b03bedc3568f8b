"""Learning curves as pictures: PNG for the screen, PDF for a paper. Equal rows give equal files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from csac.record.files import write_atomically
from csac.record.statistics import evaluation_matrix, mean_and_interval

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

# Okabe and Ito's colours, distinct to colour-blind eyes; yellow is left out, too pale for a line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#444444")
LINE_STYLES: tuple[Literal["-", "--", "-.", ":"], ...] = ("-", "--", "-.", ":")
LEGEND_CHARACTERS = 100  # that fit side by side below the axes
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
}


def learning_curve(
    runs: Sequence[tuple[str, np.ndarray]],
    path: str | Path,
    title: str = "",
    marks: Sequence[tuple[int, str]] = (),
    pdf: bool = False,
) -> None:
    """Draw evaluation returns against environment steps per seed and save them, whole or not at all, as `path` (PNG).

    Each run is `(label, rows of evaluations.csv)`: a thick line for the mean over seeds, a band for its 95 %
    t-interval, thin lines for single seeds. `marks` are `(step, text)`: vertical lines, for what changed there. `pdf`
    writes `path` with the suffix .pdf as well.
    """
    with matplotlib.style.context(["default", STYLE]):
        figure = Figure(figsize=(7.5, 4.8), layout="constrained")
        axes = figure.add_subplot()
        evaluated = [(label, rows) for label, rows in runs if not np.isnan(rows["return"]).all()]
        returns = [_draw_run(axes, index, rows) for index, (_, rows) in enumerate(evaluated)]
        _dress(axes, title, returns)
        _draw_marks(axes, marks)
        _draw_legend(figure, [(label, len(seeds)) for (label, _), seeds in zip(evaluated, returns, strict=True)])
        _save(figure, Path(path), pdf)


def _draw_run(axes: Axes, index: int, rows: np.ndarray) -> np.ndarray:
    """Draw one run and return its returns [seed, t]."""
    colour, line_style = _look(index)
    steps, seeds, returns = evaluation_matrix(rows)
    mean, low, high = mean_and_interval(returns)
    marker = "o" if len(steps) == 1 else None
    if len(seeds) > 1:
        axes.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0, zorder=1)
        for line in returns:
            there = ~np.isnan(line)
            axes.plot(steps[there], line[there], color=colour, alpha=0.4, linewidth=0.7, marker=marker, zorder=2)
    axes.plot(steps, mean, color=colour, linestyle=line_style, linewidth=2.2, marker=marker, zorder=3)
    return returns


def _look(index: int) -> tuple[str, Literal["-", "--", "-.", ":"]]:
    """Colour and line style: the style changes once the colours are used up."""
    return COLOURS[index % len(COLOURS)], LINE_STYLES[index // len(COLOURS) % len(LINE_STYLES)]


def _dress(axes: Axes, title: str, returns: list[np.ndarray]) -> None:
    several = any(len(seeds) > 1 for seeds in returns)
    axes.set_title(title, pad=24 if several else 12)
    axes.set_xlabel("environment steps per seed")
    axes.set_ylabel("return per evaluation episode")
    axes.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 2.5, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda step, _: _short(step)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}".replace("-", "−")))
    if not returns:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "no evaluations yet", transform=axes.transAxes, ha="center", color="#777777")
        return
    axes.set_xlim(0, max(axes.dataLim.x1, 1) * 1.015)
    axes.set_ylim(*_limits(axes, returns))
    if several:
        note = "line: mean over seeds · band: 95 % t-interval · thin: single seeds"
        axes.text(0, 1.025, note, transform=axes.transAxes, fontsize=9, color="#777777")


def _limits(axes: Axes, returns: list[np.ndarray]) -> tuple[float, float]:
    """Show all seeds, and of the bands no more than a quarter beyond: with two seeds they dwarf everything."""
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


def _short(step: float) -> str:
    """Return a step count as people say it: 0, 500, 20k, 1.5M."""
    for size, suffix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(step) >= size:
            return f"{step / size:.4g}{suffix}"
    return f"{step:.4g}"


def _save(figure: Figure, path: Path, pdf: bool) -> None:
    _write(figure, path, "png", {"Software": None})
    if pdf:
        _write(figure, path.with_suffix(".pdf"), "pdf", {"CreationDate": None})


def _write(figure: Figure, path: Path, kind: str, metadata: dict[str, None]) -> None:
    data = io.BytesIO()
    figure.savefig(data, format=kind, dpi=160, metadata=metadata)
    write_atomically(path, data.getvalue())
