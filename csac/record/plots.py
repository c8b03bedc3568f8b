"""Learning curves as pictures: PNG for the screen, PDF and SVG for a paper. Equal rows give equal files.

`curves` says what is shown of how many seeds.
"""

from __future__ import annotations

import io
import itertools
import math
import os
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from csac.record.curves import INTERVAL, NEXT, curves_of, last_step, limits, note
from csac.record.files import write_atomically
from csac.record.rendering import short

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from csac.record.curves import Curve, Limits, Spread


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
PADDING = 0.1  # inches around everything
WIDTH, PANELS_WIDTH = 5.0, 7.5  # inches of one panel, and of several: in a column of 3.4 inches text is still 7 points
PIXELS = 1200  # from side to side
LINE = 0.2  # inches from line to line of a legend or a title
TITLE_FONT: Mapping[str, Any] = MappingProxyType({"fontsize": 13, "fontweight": "bold"})
LEGEND: Mapping[str, Any] = MappingProxyType({"frameon": False, "borderpad": 0.1, "columnspacing": 1.2})
NOTE_FONT: Mapping[str, Any] = MappingProxyType({"fontsize": 9, "color": "#777777", "linespacing": 1.2})
RETURN = "return per evaluation episode"
Format = Literal["png", "pdf", "svg"]
LineStyle = Literal["-", "--", "-.", ":"]
Look = tuple[str, LineStyle]
LINE_STYLES: tuple[LineStyle, ...] = ("-", "--", "-.", ":")
LOOKS: tuple[Look, ...] = tuple((colour, style) for style in LINE_STYLES for colour in COLOURS)
NO_LOOKS: Mapping[str, Look] = MappingProxyType({})
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
    "figure.constrained_layout.h_pad": PADDING,
    "figure.constrained_layout.w_pad": PADDING,
    "pdf.fonttype": 42,
    "svg.hashsalt": "csac",
}


class Panel(NamedTuple):
    """What one pair of axes shows: runs as `(label, rows of evaluations.csv)`, and `(step, what changed there)`."""

    runs: Sequence[tuple[str, np.ndarray]]
    title: str = ""
    marks: Sequence[tuple[int, str]] = ()


def learning_curve(
    runs: Sequence[tuple[str, np.ndarray]],
    path: str | Path,
    title: str = "",
    marks: Sequence[tuple[int, str]] = (),
    formats: Sequence[Format] = ("png",),
    quantity: str = RETURN,
    spread: Spread = INTERVAL,
) -> None:
    """Draw evaluation returns against environment steps per seed and save them, whole or not at all, as `path`.

    Each run is `(label, rows of evaluations.csv)`: a thick line for the mean over seeds; with it, thin lines for single
    seeds below five of them, a band for the range of three or four, and for `spread` from five seeds on.
    `marks` are `(step, text)`: vertical lines, for what changed there. The suffix of `path` is replaced by each of
    `formats`; `quantity` is what the column `return` holds.
    """
    learning_curves([Panel(runs, marks=marks)], path, title, formats, quantity, spread)


def learning_curves(
    panels: Sequence[Panel],
    path: str | Path,
    title: str = "",
    formats: Sequence[Format] = ("png",),
    quantity: str = RETURN,
    spread: Spread = INTERVAL,
    within: Limits | None = None,
    looks: Mapping[str, Look] = NO_LOOKS,
) -> None:
    """Draw a `learning_curve` in each panel, side by side on one scale; a label looks the same in all of them.

    No band leaves the limits `within` which every value lies. `looks` are those that labels have elsewhere.
    """
    shown = [curves_of(panel.runs, spread, within) for panel in panels]
    found = [curve for curves in shown for curve in curves]
    looks = looks_of([label for panel in panels for label, _ in panel.runs], looks)
    with picture(3.2 if len(panels) == 1 else 3.5, columns=len(panels)) as figure:
        for axes, curves in zip(figure.axes, shown, strict=True):
            for curve in curves:
                _draw_curve(axes, curve, looks[curve.label])
            _dress(axes, curves, ticks=6 if len(panels) == 1 else 4)
        figure.axes[0].set_ylabel(quantity)
        if found:
            figure.axes[0].set_ylim(*limits(found, within))
        draw_legend(figure, {curve.legend: looks[curve.label] for curve in found})
        head(figure, title, [panel.title for panel in panels], note(found))
        for axes, panel in zip(figure.axes, panels, strict=True):
            _draw_marks(axes, panel.marks)
        save(figure, path, formats)


@contextmanager
def picture(height: float, columns: int = 1, sharey: bool = True) -> Iterator[Figure]:
    """Give a figure with axes side by side, in the style of all pictures, whatever the user's own.

    It is `height` inches high; its title, the words below it and its legend make it higher.
    """
    with matplotlib.style.context(["default", STYLE]):
        width = WIDTH if columns == 1 else PANELS_WIDTH
        figure = Figure(figsize=(width, height), dpi=PIXELS / width, layout="constrained")
        FigureCanvasAgg(figure)  # drawn by it whatever window the user has chosen
        figure.subplots(1, columns, sharey=sharey)
        yield figure


def looks_of(labels: Iterable[str], known: Mapping[str, Look] = NO_LOOKS) -> dict[str, Look]:
    """Return the colour and the line style of each label: the look it has already, or the first that is free.

    The style changes once the colours are used up.
    """
    labels = dict.fromkeys(labels)
    taken = {known[label] for label in labels if label in known}
    free = itertools.chain((look for look in LOOKS if look not in taken), itertools.cycle(LOOKS))
    return {label: known[label] if label in known else next(free) for label in labels}


def head(figure: Figure, title: str, titles: Sequence[str] = ("",), text: str = "") -> None:
    """Put a title above all axes, one above each, and small below the first what is to be known to read them."""
    figure.draw_without_rendering()  # which lays the axes out
    room = figure.get_figwidth() - 2 * PADDING
    if len(titles) == 1:
        room = figure.axes[0].get_position().width * figure.get_figwidth()
    title = _broken(figure, title, " ", room, TITLE_FONT)
    text = _broken(figure, text, NEXT, room, NOTE_FONT)
    lines = text.count("\n") + 1 if text else 0
    _make_higher(figure, LINE * (title.count("\n") + lines))
    if len(titles) == 1:
        axes = figure.axes[0]
        axes.set_title(title, pad=12 + 12 * lines)
        if text:
            axes.annotate(text, (0, 1), (0, 6), xycoords="axes fraction", textcoords="offset points", **NOTE_FONT)
        return
    for axes, panel in zip(figure.axes, titles, strict=True):
        axes.set_title(panel, fontsize=10, pad=6)
    left = 0.012
    figure.suptitle(title + "\n" * lines, x=left, ha="left", **TITLE_FONT)
    if text:
        above = PADDING + (20 + 16 * title.count("\n")) / 72  # where the layout puts the last line of the title
        figure.text(left, 1 - above / figure.get_figheight(), text, va="top", **NOTE_FONT)


def grouped(value: float, _position: float | None = None) -> str:
    """Return the words of a tick on the axis of a quantity: thousands apart, and a minus instead of a hyphen."""
    return f"{value:,.10g}".replace("-", "−")


def draw_legend(figure: Figure, looks: Mapping[str, Look], more: Sequence[Artist] = ()) -> None:
    """Put the legend below the axes, where it covers no curve, in as few lines as it fits into.

    The picture grows by its lines.
    """
    handles = [
        Line2D([], [], color=colour, linestyle=line_style, linewidth=2.2, label=text)
        for text, (colour, line_style) in looks.items()
    ]
    handles = [*handles, *more]
    for lines in range(1, len(handles) + 1):
        columns = math.ceil(len(handles) / lines)
        legend = figure.legend(handles=handles, loc="outside lower center", ncols=columns, **LEGEND)
        if columns == 1 or legend.get_window_extent().width <= (figure.get_figwidth() - 2 * PADDING) * figure.dpi:
            _make_higher(figure, LINE * lines)
            return
        legend.remove()


def save(figure: Figure, path: str | Path, formats: Sequence[Format]) -> None:
    """Save a figure in each format, whole or not at all, equal figures in equal files."""
    for kind in formats:
        _write(figure, Path(path).with_suffix(f".{kind}"), kind)


def _draw_curve(axes: Axes, curve: Curve, look: Look) -> None:
    colour, line_style = look
    marker = "o" if len(curve.steps) == 1 else None
    if curve.has_band:
        axes.fill_between(curve.steps, curve.low, curve.high, color=colour, alpha=0.15, linewidth=0, zorder=1)
    if curve.shows_seeds:
        for line in curve.returns:
            there = ~np.isnan(line)
            axes.plot(curve.steps[there], line[there], color=colour, alpha=0.4, linewidth=0.7, marker=marker, zorder=2)
    axes.plot(curve.steps, curve.mean, color=colour, linestyle=line_style, linewidth=2.2, marker=marker, zorder=3)


def _dress(axes: Axes, curves: Sequence[Curve], ticks: int) -> None:
    axes.set_xlabel("environment steps per seed")
    axes.xaxis.set_major_locator(MaxNLocator(ticks, steps=[1, 2, 2.5, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda step, _: short(step)))
    axes.yaxis.set_major_formatter(grouped)
    if not curves:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "no evaluations yet", transform=axes.transAxes, ha="center", color="#777777")
        return
    axes.set_xlim(0, last_step(curves))


def _make_higher(figure: Figure, inches: float) -> None:
    figure.set_figheight(figure.get_figheight() + inches)


def _broken(figure: Figure, text: str, between: str, inches: float, font: Mapping[str, Any]) -> str:
    """Return a text in as few lines as fit into so many inches, none much longer than another."""
    narrowest: dict[int, str] = {}
    for characters in range(len(text) + 1):
        lines = _lines(text, between, characters)
        narrowest.setdefault(len(lines), "\n".join(lines))
    texts = [narrowest[count] for count in sorted(narrowest)]
    return next((each for each in texts if _width(figure, each, font) <= inches), texts[-1])


def _width(figure: Figure, text: str, font: Mapping[str, Any]) -> float:
    """Return how many inches a text takes."""
    artist = figure.text(0, 0, text, **font)
    width = artist.get_window_extent().width
    artist.remove()
    return width / figure.dpi


def _lines(text: str, between: str, characters: float) -> list[str]:
    """Return the lines of a text; one ends only where `between` stands."""
    lines: list[str] = []
    for part in text.split(between):
        if lines and len(lines[-1] + between + part) <= characters:
            lines[-1] += between + part
        else:
            lines.append(part)
    return lines


def _draw_marks(axes: Axes, marks: Sequence[tuple[int, str]]) -> None:
    for step, text in marks:
        axes.axvline(step, color="#555555", linewidth=1, linestyle=(0, (4, 3)))
        place = {"xycoords": ("data", "axes fraction"), "xytext": (4, -4), "textcoords": "offset points", "va": "top"}
        axes.annotate(text, (step, 1), fontsize=9, color="#333333", **place)


def _write(figure: Figure, path: Path, kind: Format) -> None:
    data = io.BytesIO()
    nothing = {"png": "Software", "pdf": "CreationDate", "svg": "Date"}[kind]  # that would differ from file to file
    figure.savefig(data, format=kind, dpi=PIXELS / figure.get_figwidth(), metadata={nothing: None})
    write_atomically(path, data.getvalue())
