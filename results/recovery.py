"""Say what a change in mid-training cost several methods, and draw them: the robustness experiment's table and figure.

    python results/recovery.py --step 300000 --mark "friction x 1.5" --title HalfCheetah-v4 --out recovery.png \
        CSAC=runs/csac-1.5/evaluations.csv SAC=runs/sac-1.5/evaluations.csv

Each argument is a label and a file in the format of evaluations.csv. The metrics are defined in docs/perturbations.md.
"""

import argparse
from pathlib import Path

import numpy as np

from csac.record.plots import learning_curve
from csac.record.statistics import Recovery, recovery
from csac.record.tables import read_rows


def table(runs: list[tuple[str, np.ndarray]], step: int, until: int | None = None) -> str:
    """Return a Markdown table: for each run a row per seed, then the mean ± standard deviation over its seeds."""
    lines = [
        "| run | seed | return before | drop | relative | steps to 90 % | area lost, return x steps "
        "| final return | worst drawdown |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for label, rows in runs:
        recoveries = recovery(rows, step, until)
        lines += [_row(label, str(seed), _cells(one)) for seed, one in recoveries.items()]
        if len(recoveries) > 1:
            lines.append(_row(f"**{label}**", "mean ± std", _over_seeds(np.array(list(recoveries.values())))))
    return "\n".join(lines)


def _row(*parts: str | list[str]) -> str:
    cells = [cell for part in parts for cell in ([part] if isinstance(part, str) else part)]
    return f"| {' | '.join(cells)} |"


def _cells(one: Recovery) -> list[str]:
    return [_cell(name, value) for name, value in zip(Recovery._fields, one, strict=True)]


def _cell(name: str, value: float) -> str:
    if np.isnan(value):
        return ""
    if np.isinf(value):
        return "never"
    if name == "relative_drop":
        return f"{value:.0%}"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:,.2f}" if value % 1 else f"{value:.0f}"


def _over_seeds(values: np.ndarray) -> list[str]:
    """Return `mean ± std` of each column of `values` [seed, metric], over the seeds where something can be told.

    Seeds that never came back have no number of steps: the mean is that of the others, and says of how many.
    """
    cells = []
    for name, column in zip(Recovery._fields, values.T, strict=True):
        known, finite = column[~np.isnan(column)], column[np.isfinite(column)]
        if not len(finite):
            cells.append(_cell(name, np.inf) if len(known) else "")
            continue
        spread = f" ± {_cell(name, finite.std(ddof=1))}" if len(finite) > 1 else ""
        share = f" ({len(finite)} of {len(known)})" if len(finite) < len(known) else ""
        cells.append(_cell(name, finite.mean()) + spread + share)
    return cells


def main() -> None:
    """Print the table; draw the picture where one is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="LABEL=CSV")
    parser.add_argument("--step", type=int, required=True, help="environment steps before the change")
    parser.add_argument("--until", type=int, help="leave out evaluations after this step, where the next change is")
    parser.add_argument("--mark", default="perturbed", help="what to write at the line in the picture")
    parser.add_argument("--title", default="")
    parser.add_argument("--out", type=Path, help="a PNG file")
    arguments = parser.parse_args()
    pairs = [argument.partition("=")[::2] for argument in arguments.runs]
    if wrong := [label for label, path in pairs if not path]:
        parser.error(f"write LABEL=CSV, not {wrong[0]}")
    runs = [(label, read_rows(path)) for label, path in pairs]
    if arguments.out:
        marks = [(arguments.step, arguments.mark)]
        learning_curve(runs, arguments.out, title=arguments.title, marks=marks)
    print(table(runs, arguments.step, arguments.until))


if __name__ == "__main__":
    main()
