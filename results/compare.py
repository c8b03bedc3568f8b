"""Draw several runs in one picture and print their table: the figure and the numbers of a results folder.

    python results/compare.py --title HalfCheetah-v4 --out results/halfcheetah-100k/curve.png \
        "SAC=results/halfcheetah-100k/sac.csv" "SB3 SAC=results/halfcheetah-100k/sb3.csv"

Each argument is a label and a file in the format of evaluations.csv. The others are compared with the first.
"""

import argparse
from pathlib import Path

import numpy as np

from csac.record.plots import learning_curve
from csac.record.statistics import (
    FEWEST_SEEDS,
    evaluation_matrix,
    interquartile_mean,
    is_case,
    last_evaluations,
    maximum_average_return,
    mean_and_interval,
    mean_told,
    stratified_bootstrap_interval,
)
from csac.record.tables import read_rows


def up_to(rows: np.ndarray, step: int | None) -> np.ndarray:
    """Return the rows of the evaluations until `step`, or all."""
    return rows if step is None else rows[rows["step"] <= step]


def table(runs: list[tuple[str, np.ndarray]]) -> str:
    """Return a Markdown table: each run's last three evaluations, maximum average return, and success if it is told.

    Where a run has seeds enough for a bootstrap there is the interquartile mean as well.
    """
    tells = any(is_case(rows["success"]) for _, rows in runs)
    has_many = any(len(np.unique(rows["seed"])) >= FEWEST_SEEDS for _, rows in runs)
    lines = [
        "| run | seeds | steps | last three evaluations, mean ± std over seeds | 95 % t-interval | to the first "
        "| maximum average return |"
        + " IQM, 95 % bootstrap interval |" * has_many
        + " success, last three evaluations |" * tells,
        "|---|---|---|---|---|---|---|" + "---|" * (has_many + tells),
    ]
    first = None
    for label, rows in runs:
        last = np.array(list(last_evaluations(rows).values()))
        mean, low, high = mean_and_interval(last)
        first = mean if first is None else first
        best, step = maximum_average_return(rows)
        spread = last.std(ddof=1) if len(last) > 1 else float("nan")
        form = ".0f" if abs(mean) >= 20 else ".2f"
        ratio = f"{mean / first:.2f}" if first > 0 else ""  # of costs, it would be the larger the worse
        lines.append(
            f"| {label} | {len(last)} | {rows['step'].max():,} | {mean:{form}} ± {spread:{form}} "
            f"| {low:{form}} to {high:{form}} | {ratio} | {best:{form}} at {step:,} |"
            + f" {middle(rows, form)} |" * has_many
            + f" {success(rows)} |" * tells
        )
    return "\n".join(lines)


def middle(rows: np.ndarray, form: str, points: int = 3) -> str:
    """Return the interquartile mean of the last evaluations of all seeds, and its interval where there are enough."""
    returns = evaluation_matrix(rows)[2][:, -points:]
    interval = stratified_bootstrap_interval(returns, interquartile_mean)
    told = f"{interquartile_mean(returns):{form}}"
    return told + (f" ({interval[0]:{form}} to {interval[1]:{form}})" if interval else "")


def success(rows: np.ndarray, points: int = 3) -> str:
    """Return the share of successful episodes in the last evaluations, mean ± standard deviation over seeds."""
    last = rows[np.isin(rows["step"], np.unique(rows["step"])[-points:])]
    shares = np.array([mean_told(last["success"][last["seed"] == seed], True) for seed in np.unique(last["seed"])])
    return f"{shares.mean():.0%}" + (f" ± {shares.std(ddof=1):.0%}" if len(shares) > 1 else "")


def main() -> None:
    """Write the picture, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="LABEL=CSV")
    parser.add_argument("--title", default="")
    parser.add_argument("--mark", action="append", default=[], metavar="STEP=TEXT", help="draw a line at a step")
    parser.add_argument("--until", type=int, help="leave out evaluations after this step")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    pairs = [argument.partition("=")[::2] for argument in arguments.runs]
    runs = [(label, up_to(read_rows(path), arguments.until)) for label, path in pairs]
    if wrong := [text for text in arguments.mark if not text.partition("=")[0].isdecimal()]:
        parser.error(f"write --mark STEP=TEXT, not {wrong[0]}")
    marks = [(int(step), text) for step, _, text in (mark.partition("=") for mark in arguments.mark)]
    learning_curve(runs, arguments.out, title=arguments.title, marks=marks)
    print(table(runs))


if __name__ == "__main__":
    main()
