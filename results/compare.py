"""Draw several runs in one picture and print their table: the figure and the numbers of a results folder.

    python results/compare.py --title HalfCheetah-v4 --out results/halfcheetah-100k/curve.png \
        "SAC=results/halfcheetah-100k/sac.csv" "SB3 SAC=results/halfcheetah-100k/sb3.csv"

Each argument is a label and a file in the format of evaluations.csv. The others are compared with the first.
"""

import argparse
from pathlib import Path

from csac.record.csv_tables import read_rows
from csac.record.plots import learning_curve
from csac.record.rendering import markdown
from csac.record.summaries import compare
from csac.record.summary_tables import comparison_table


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
    if wrong := [label for label, path in pairs if not path]:
        parser.error(f"write LABEL=CSV, not {wrong[0]}")
    runs = [(label, read_rows(path)) for label, path in pairs]
    if arguments.until is not None:
        runs = [(label, rows[rows["step"] <= arguments.until]) for label, rows in runs]
    if wrong := [text for text in arguments.mark if not text.partition("=")[0].isdecimal()]:
        parser.error(f"write --mark STEP=TEXT, not {wrong[0]}")
    marks = [(int(step), text) for step, _, text in (mark.partition("=") for mark in arguments.mark)]
    learning_curve(runs, arguments.out, title=arguments.title, marks=marks)
    print(markdown(comparison_table(compare(runs))))


if __name__ == "__main__":
    main()
