"""The picture of a controller's time: how many calls take how long, and how late they begin."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from csac.record.plots import COLOURS, STYLE, Figure, FigureCanvasAgg, FuncFormatter, matplotlib, save
from csac.record.rendering import short

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes


class Calls(NamedTuple):
    """Calls of one artefact: nanoseconds that each took [calls], those that each began late, and calls a second."""

    label: str
    durations: np.ndarray
    lateness: np.ndarray | None
    rate: float | None


def jitter(several: Sequence[Calls], path: Path) -> None:
    """Draw and save, as PNG, the share of calls that took longer than a time, and lateness against time at a rate."""
    timed = [calls for calls in several if calls.lateness is not None]
    labels = list(dict.fromkeys(calls.label for calls in several))
    colours = {label: COLOURS[index % len(COLOURS)] for index, label in enumerate(labels)}
    with matplotlib.style.context(["default", STYLE]):
        figure = Figure(figsize=(7.5, 4.4), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(1, 1 + bool(timed), squeeze=False)[0]
        _draw_tails(panels[0], several, colours)
        if timed:
            _draw_lateness(panels[1], timed, colours)
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
        save(figure, path, ("png",))


def _draw_tails(axes: Axes, several: Sequence[Calls], colours: dict[str, str]) -> None:
    for calls in several:
        durations = np.sort(calls.durations) / 1e3
        share = 1.0 - np.arange(len(durations)) / len(durations)
        # A point for each percent, and each call of the last: 100,000 points in a line are seen as no more.
        keep = np.unique(np.r_[np.linspace(0, len(durations) - 1, 100).astype(int), np.arange(len(durations))[-1000:]])
        name = calls.label + ("" if calls.rate is None else f", {calls.rate:g} Hz")
        style = "-" if calls.rate is None else "--"
        axes.plot(durations[keep], share[keep], style, color=colours[calls.label], linewidth=1.8, label=name)
    axes.set(xscale="log", yscale="log", xlabel="μs for one action", ylabel="share of calls that took longer")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:.10g} %"))
    axes.set_title("How long", fontsize=11)


def _draw_lateness(axes: Axes, timed: Sequence[Calls], colours: dict[str, str]) -> None:
    for calls in timed:
        assert calls.lateness is not None
        assert calls.rate is not None
        seconds = np.arange(len(calls.lateness)) / calls.rate
        axes.plot(seconds, calls.lateness / 1e3, ".", color=colours[calls.label], markersize=2.5, alpha=0.6)
    axes.set(xlabel="seconds", ylabel="μs late", yscale="log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
    axes.set_title("How late each begins", fontsize=11)
