"""Performance profiles as pictures: the share of runs above a score, as exact steps; `interactive` draws the same."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from matplotlib.ticker import PercentFormatter

from csac.record.plots import NO_LOOKS, draw_legend, head, looks_of, picture, save

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from csac.record.plots import Look

SHARE = "share of runs above that score"
BAND = "band: 95 % bootstrap interval"


class Profile(NamedTuple):
    """Of one method, the share of its runs above each score; its interval `low` to `high`, empty where it has none."""

    label: str
    share: tuple[float, ...]
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()


class Profiles(NamedTuple):
    """Profiles over common scores in order: a share holds from its score on as far as the next."""

    profiles: tuple[Profile, ...]
    scores: tuple[float, ...]
    quantity: str
    looks: Mapping[str, Look] = NO_LOOKS

    @property
    def note(self) -> str:
        """What is to be known to read them."""
        return BAND if any(profile.low for profile in self.profiles) else ""

    def save(self, path: Path, title: str) -> None:
        """Draw them, as PNG and SVG."""
        looks = looks_of([profile.label for profile in self.profiles], self.looks)
        with picture(4.2) as figure:
            axes = figure.axes[0]
            for label, share, low, high in self.profiles:
                colour, style = looks[label]
                if low:
                    axes.fill_between(self.scores, low, high, step="post", color=colour, alpha=0.15, linewidth=0)
                axes.step(self.scores, share, where="post", color=colour, linestyle=style, linewidth=2.2)
            axes.set_xlim(self.scores[0], self.scores[-1])
            axes.set_ylim(-0.03, 1.03)
            axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
            axes.set_xlabel(self.quantity)
            axes.set_ylabel(SHARE)
            head(figure, title, text=self.note)
            draw_legend(figure, looks)
            save(figure, path, ("png", "svg"))
