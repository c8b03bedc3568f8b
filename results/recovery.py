"""Say what a change in mid-training cost several methods, and draw them: the robustness experiment's table and figure.

    python results/recovery.py --step 300000 --mark "friction x 1.5" --title HalfCheetah-v4 --out recovery.png \
        CSAC=runs/csac-1.5/evaluations.csv SAC=runs/sac-1.5/evaluations.csv

Each argument is a label and a file in the format of evaluations.csv. The metrics are defined in docs/perturbations.md.
"""

import argparse
from pathlib import Path

from csac.record.csv_tables import read_rows
from csac.record.plots import learning_curve
from csac.record.rendering import markdown
from csac.record.summaries import recoveries
from csac.record.summary_tables import recovery_table


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
    costs = [recoveries(label, rows, arguments.step, arguments.until) for label, rows in runs]
    print(markdown(recovery_table(costs)))


if __name__ == "__main__":
    main()
