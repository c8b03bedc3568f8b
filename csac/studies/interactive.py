"""The figures of a report as plotly draws them in a browser: values under the pointer, curves that the legend toggles.

What is made here is plain data, as plotly.js takes it. Colours of text and axes are the page's, light or dark.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from csac.record.curves import curves_of, last_step, limits, note
from csac.record.plots import looks_of
from csac.record.rendering import number
from csac.studies.figures import PUBLISHED, Bars, Curves, nudge
from csac.studies.profiles import SHARE, Profiles

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from csac.record.curves import Curve
    from csac.record.plots import LineStyle, Look, Panel
    from csac.studies.figures import BarPanel, Drawing, Line, Trend

DASHES: dict[LineStyle, str] = {"-": "solid", "--": "dash", "-.": "dashdot", ":": "dot"}
DIGITS = 7  # of numbers in the page: more are not seen
CONTRAST = "#444444"  # the one colour that the page changes where it is dark


class Plot(NamedTuple):
    """One plot of a figure: `data` and `layout` as plotly.js takes them."""

    title: str
    data: list[dict[str, Any]]
    layout: dict[str, Any]


def plots(drawing: Drawing) -> list[Plot]:
    """Return the plots of a figure, one for each panel."""
    if isinstance(drawing, Curves):
        return _curves(drawing)
    if isinstance(drawing, Profiles):
        return [_profiles(drawing)]
    return _bars(drawing) if isinstance(drawing, Bars) else [_trend(drawing)]


def note_of(drawing: Drawing) -> str:
    """Return what is to be known to read a figure."""
    if not isinstance(drawing, Curves):
        return drawing.note
    return note([curve for curves in _shown(drawing) for curve in curves])


def _curves(drawing: Curves) -> list[Plot]:
    looks = looks_of([label for panel in drawing.panels for label, _ in panel.runs], drawing.looks)
    shown = _shown(drawing)
    found = [curve for curves in shown for curve in curves]
    scale = {"range": _plain(limits(found, drawing.within))} if found else {}
    return [
        Plot(
            panel.title,
            [trace for curve in curves for trace in _traces(curve, looks[curve.label])],
            {
                "hovermode": "x unified",
                "xaxis": {
                    "title": {"text": "environment steps per seed"},
                    "tickformat": "~s",
                    "range": _plain([0, last_step(curves)]),
                },
                "yaxis": {"title": {"text": drawing.quantity}, **scale},
                **_marks(panel),
            },
        )
        for panel, curves in zip(drawing.panels, shown, strict=True)
    ]


def _shown(drawing: Curves) -> list[list[Curve]]:
    return [curves_of(panel.runs, drawing.spread, drawing.within) for panel in drawing.panels]


def _traces(curve: Curve, look: Look) -> list[dict[str, Any]]:
    """Return the band of a curve, its seeds, and the mean, which alone is in the legend and under the pointer."""
    colour, style = look
    aside = {"type": "scatter", "mode": "lines", "legendgroup": curve.label, "showlegend": False, "hoverinfo": "skip"}
    traces: list[dict[str, Any]] = []
    if curve.has_band:
        known = ~np.isnan(curve.low)
        steps, low, high = (array[known] for array in (curve.steps, curve.low, curve.high))
        around = {"x": [*_plain(steps), *_plain(steps[::-1])], "y": [*_plain(high), *_plain(low[::-1])]}
        traces.append({**aside, **around, "fill": "toself", "fillcolor": _faint(colour), "line": {"width": 0}})
    if curve.shows_seeds:
        for line in curve.returns:
            there = ~np.isnan(line)
            thin = {"x": _plain(curve.steps[there]), "y": _plain(line[there]), "line": {"color": colour, "width": 0.8}}
            traces.append({**aside, **thin, "opacity": 0.5})
    mean = {
        "type": "scatter",
        "mode": "lines" if len(curve.steps) > 1 else "markers",
        "name": _text(curve.legend),
        "legendgroup": curve.label,
        "x": _plain(curve.steps),
        "y": _plain(curve.mean),
        "text": [_spread(curve, index) for index in range(len(curve.steps))],
        "hovertemplate": "%{y:,.5~g}%{text}",
        "line": {"color": colour, "width": 2.4, "dash": DASHES[style]},
        "marker": {"color": colour},
    }
    return [*traces, mean]


def _spread(curve: Curve, index: int) -> str:
    """Return what stands behind the mean at one step: the seeds, or the band."""
    if curve.shows_seeds:
        told = [number(value) for value in curve.returns[:, index] if not math.isnan(value)]
        return f" (seeds {', '.join(told)})"
    low, high = float(curve.low[index]), float(curve.high[index])
    if not curve.has_band or math.isnan(low):
        return ""
    return f" ({curve.band}: {number(low)} to {number(high)})"


def _marks(panel: Panel) -> dict[str, Any]:
    across = {
        "yref": "paper",
        "y0": 0,
        "y1": 1,
        "type": "line",
        "line": {"color": "#888888", "width": 1, "dash": "dash"},
    }
    words = {"yref": "paper", "y": 1, "yanchor": "top", "xanchor": "left", "showarrow": False}
    return {
        "shapes": [{**across, "x0": step, "x1": step} for step, _ in panel.marks],
        "annotations": [{**words, "x": step, "text": f" {_text(text)}"} for step, text in panel.marks],
    }


def _bars(drawing: Bars) -> list[Plot]:
    looks = looks_of(drawing.labels, drawing.looks)
    return [
        Plot(
            panel.title,
            _bar_traces(panel, looks),
            {
                "barmode": "overlay",
                "hovermode": "closest",
                "showlegend": drawing.needs_legend or _has_published(panel),
                "xaxis": {"type": "category", "showticklabels": not drawing.needs_legend, "showgrid": False},
                "yaxis": {"title": {"text": drawing.quantity}, "rangemode": "tozero", "tickformat": "~s"},
                "annotations": [
                    {"x": _text(bar.label), "y": 0, "yanchor": "bottom", "textangle": -90, "showarrow": False}
                    | {"text": drawing.missing}
                    for bar in panel.bars
                    if not math.isfinite(bar.height)
                ],
            },
        )
        for panel in drawing.panels
    ]


def _bar_traces(panel: BarPanel, looks: dict[str, Look]) -> list[dict[str, Any]]:
    traces = [
        {
            "type": "bar",
            "name": _text(bar.label),
            "x": [_text(bar.label)],
            "y": _plain([bar.height]),
            "width": 0.6,
            "marker": {"color": looks[bar.label][0]},
            "error_y": _errors([bar.height], [bar.low], [bar.high]),
            "hovertemplate": f"%{{x}}<br>%{{y:,.5~g}}{_between(bar.low, bar.high)}<extra></extra>",
        }
        for bar in panel.bars
    ]
    if _has_published(panel):
        told = [bar for bar in panel.bars if math.isfinite(bar.published)]
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": PUBLISHED,
                "x": [_text(bar.label) for bar in told],
                "y": _plain(bar.published for bar in told),
                "marker": {"symbol": "diamond", "size": 9, "color": CONTRAST, "line": {"color": "#ffffff", "width": 1}},
                "hovertemplate": f"%{{x}}, {PUBLISHED}<br>%{{y:,.5~g}}<extra></extra>",
            }
        )
    return traces


def _has_published(panel: BarPanel) -> bool:
    return any(math.isfinite(bar.published) for bar in panel.bars)


def _trend(drawing: Trend) -> Plot:
    lines = drawing.lines
    looks = looks_of([line.label for line in lines], drawing.looks)
    values = sorted({value for line in lines for value in line.x})
    axis = {"type": "log", "tickvals": values, "ticktext": [f"{value:g}" for value in values]}
    return Plot(
        "",
        [_line(line, looks[line.label], nudge(index, len(lines))) for index, line in enumerate(lines)],
        {
            "hovermode": "closest",
            "xaxis": {"title": {"text": _text(drawing.name)}, **axis},
            "yaxis": {"title": {"text": drawing.quantity}},
        },
    )


def _line(line: Line, look: Look, factor: float) -> dict[str, Any]:
    colour, style = look
    told = [f"{x:g}: {number(y)}{_between(*reach)}" for x, y, *reach in zip(*line[1:], strict=True)]
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": _text(line.label),
        "x": _plain(factor * x for x in line.x),
        "y": _plain(line.y),
        "error_y": _errors(line.y, line.low, line.high),
        "text": told,
        "hovertemplate": "%{text}",
        "line": {"color": colour, "width": 2.4, "dash": DASHES[style]},
        "marker": {"color": colour, "size": 8},
    }


def _profiles(drawing: Profiles) -> Plot:
    looks, traces = looks_of([profile.label for profile in drawing.profiles], drawing.looks), []
    scores = _plain(drawing.scores)
    for label, share, low, high in drawing.profiles:
        colour, style = looks[label]
        step = {"type": "scatter", "mode": "lines", "legendgroup": label, "x": scores}
        edge = {"showlegend": False, "hoverinfo": "skip"}
        if low:
            nothing = {"shape": "hv", "width": 0}
            traces.append({**step, **edge, "y": _plain(low), "line": nothing})
            traces.append({**step, **edge, "y": _plain(high), "line": nothing})
            traces[-1] |= {"fill": "tonexty", "fillcolor": _faint(colour)}
        line = {"shape": "hv", "color": colour, "width": 2.4, "dash": DASHES[style]}
        shown = {"name": _text(label), "y": _plain(share), "line": line}
        between = [_between(*reach) for reach in zip(low, high, strict=True)] or [""] * len(share)
        traces.append({**step, **shown, "text": between, "hovertemplate": "%{y:.0%}%{text}"})
    return Plot(
        "",
        traces,
        {
            "hovermode": "x unified",
            "xaxis": {"title": {"text": drawing.quantity}},
            "yaxis": {"title": {"text": SHARE}, "tickformat": ".0%", "range": [-0.03, 1.03]},
        },
    )


def _errors(middle: Sequence[float], low: Sequence[float], high: Sequence[float]) -> dict[str, Any]:
    up, down = np.subtract(high, middle), np.subtract(middle, low)
    return {"type": "data", "symmetric": False, "array": _plain(up), "arrayminus": _plain(down), "thickness": 1.4}


def _between(low: float, high: float) -> str:
    return f" ({number(low)} to {number(high)})" if math.isfinite(low) and math.isfinite(high) else ""


def _plain(values: Iterable[float]) -> list[float | None]:
    """Return numbers as JSON has them: nothing in place of what is none, and no more digits than are seen."""
    return [float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None for value in values]


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[start : start + 2], 16) for start in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.15)"


def _text(text: str) -> str:
    """Return a label as plotly shows it as it is: it would take angle brackets for its own."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
