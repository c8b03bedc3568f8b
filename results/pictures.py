"""Pictures of the pages in results/ other than learning curves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from csac.record.plots import COLOURS

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_equal_time(path: Path, reached: dict[str, dict[str, np.ndarray]], times: dict[str, list[float]]) -> None:
    """Draw the mean and range over seeds against the seconds of training."""
    figure = _figure(7.5, 4.2)
    for axes, (task, arms) in zip(figure.subplots(1, len(reached), sharey=True), reached.items(), strict=True):
        for colour, (label, values) in zip(COLOURS[-len(arms) :], arms.items(), strict=True):
            axes.fill_between(times[task], values.min(axis=0), values.max(axis=0), color=colour, alpha=0.1, linewidth=0)
            axes.plot(times[task], values.mean(axis=0), color=colour, linewidth=2.2, label=label)
        _dress(axes, task, "seconds of training on two cores")
        axes.set_xlim(0, times[task][-1])
    figure.axes[0].set_ylabel("return per evaluation episode")
    _save(figure, path, columns=4)


FIGURES = (
    ("relative_entropy", "KL to the reference, nats", True),
    ("kl_gradient", "gradient of the KL part", True),
    ("kl_noise", "noise of the KL part, batch of 256", True),
    ("q_gradient", "gradient of the Q part", True),
    ("cosine", "cosine of KL gradient and last update", False),
    ("update", "length of the actor's last update", True),
    ("churn", "KL of one update, held-out states", True),
    ("critic_bias", "critic minus Monte-Carlo return", False),
)


def draw_mechanism(path: Path, arms: dict[str, dict[str, np.ndarray]]) -> None:
    """Draw the effect of the relative entropy during the runs: a colour per reference, dotted for the sampled KL."""
    figure = _figure(16, 7.5)
    colours = dict(zip(dict.fromkeys(name.partition(", ")[0] for name in arms), COLOURS, strict=False))
    for axes, (column, title, is_log) in zip(figure.subplots(2, 4).flat, FIGURES, strict=True):
        for name, rows in arms.items():
            policy, _, estimator = name.partition(", ")
            known = rows[column] > 1e-12 if is_log else ~np.isnan(rows[column])
            style = "-" if estimator == "closed_form" else ":"
            axes.plot(rows["step"][known], rows[column][known], style, color=colours[policy], label=name)
        axes.set_yscale("log" if is_log else "linear")
        _dress(axes, title, "environment steps")
    _save(figure, path, columns=4)


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _dress(axes: Axes, title: str, quantity: str) -> None:
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlabel(quantity)
    axes.grid(color="#E4E4E4")
    axes.spines[["top", "right"]].set_visible(False)


def _save(figure: Figure, path: Path, columns: int) -> None:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
    figure.savefig(path, dpi=1200 / figure.get_figwidth(), metadata={"Software": None})
