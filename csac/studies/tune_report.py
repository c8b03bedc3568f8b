"""What a search leaves for people: the best configuration as a command, a table of trials, pictures, caveats."""

from __future__ import annotations

import csv
import io
import json
import math
import shlex
from typing import TYPE_CHECKING, Any

import matplotlib.style
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from csac.record.files import write_atomically
from csac.record.plots import COLOURS, STYLE, grouped, save
from csac.record.rendering import EMPTY, Cell, Row, Table, markdown, number, numeric
from csac.studies.cells import complete
from csac.studies.command_words import changed
from csac.studies.figures import FORMATS
from csac.studies.shared_study import OBJECTIVE
from csac.training.options import Options

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from csac.studies.shared_study import Question, Result, SharedStudy

FEWEST_FOR_IMPORTANCES = 50  # complete trials: the best tenth, which they rest on, has five of them then
REPORT_SEEDS = 5  # of the command for the best configuration
SHOWN = 10  # trials in the table on the terminal
_EVALUATION = ("evaluation_interval", "evaluation_episodes")


def write_report(study: SharedStudy, command: str) -> list[Path]:
    """Write `report.md`, `trials.csv`, `best.sh` and the pictures beside the study, and return their paths."""
    folder, results, best = study.directory, study.results(), study.best()
    written = {"trials.csv": _csv(study.question, results)}
    if best:
        written["best.sh"] = f"{best_command(study.question, best.values)}\n"
    complete = [result for result in results if result.state == "complete"]
    pictures = []
    if complete:
        history(folder / "history", study.question, results)
        pictures.append("history")
    shares = study.importances() if len(complete) > 1 and len(study.question.space) > 1 else {}
    if shares:
        importances(folder / "importances", shares, len(complete))
        pictures.append("importances")
    written["report.md"] = "\n\n".join(_paragraphs(study, results, best, pictures, command)) + "\n"
    for name, text in written.items():
        write_atomically(folder / name, text.encode())
    return [folder / name for name in (*sorted(written), *(f"{name}.png" for name in pictures))]


def best_command(question: Question, values: Mapping[str, Any]) -> str:
    """Return the line that trains a configuration with fresh seeds, none of which the search has used."""
    algorithm = question.algorithm.name
    first_seed = 0 if question.first_seed >= REPORT_SEEDS else question.labels[-1] + 1
    words = ["csac", "train", question.task, "--algorithm", algorithm, "--steps", str(question.steps)]
    words += ["--seeds", str(REPORT_SEEDS)] + (["--first-seed", str(first_seed)] if first_seed else [])
    words += changed({name: getattr(question, name) for name in _EVALUATION}, vars(Options()))
    if question.environment_arguments:
        words += ["--env-kwargs", json.dumps(question.environment_arguments)]
    own = complete(algorithm, {**question.hyperparameters, **values})
    return shlex.join(words + changed(own, complete(algorithm, {})))


def trials_table(question: Question, results: Sequence[Result], most: int | None = None) -> Table:
    """Return the trials as a table, best first; those that were pruned below the complete ones, then the others."""
    order = {"complete": 0, "pruned": 1, "failed": 2, "running": 3, "waiting": 4}

    def place(result: Result) -> tuple[int, float]:
        return order[result.state], -result.objective if result.state == "complete" else -result.step

    ordered = sorted(results, key=place)
    largest = max((abs(result.objective) for result in results if math.isfinite(result.objective)), default=0.0)
    rows = []
    for result in ordered[:most]:
        cells = [Cell(str(result.label), result.label), Cell(result.state)]
        cells.append(numeric(result.objective, number(result.objective, largest)))
        cells.append(Cell(f"{result.step:,}", result.step))
        cells += [_value_cell(result.values.get(name)) for name in question.space]
        rows.append(Row(tuple(cells), "failed" if result.state == "failed" else "plain"))
    left = len(ordered) - len(rows)
    note = f"and {left} more in trials.csv" if left else ""
    return Table(("trial", "state", "objective", "steps", *question.space), tuple(rows), note=note)


def caveat(complete: int) -> str:
    """Return what is to be said of importances that rest on so many complete trials."""
    if complete < FEWEST_FOR_IMPORTANCES:
        return f"not reliable: {complete} complete trials; from {FEWEST_FOR_IMPORTANCES} on, five make the best tenth"
    return f"of {complete} complete trials"


def history(path: Path, question: Question, results: Sequence[Result]) -> None:
    """Draw the objective of each trial, and the best of the complete ones so far."""
    with matplotlib.style.context(["default", STYLE]):
        figure, axes = _figure(7.5, 4.2)
        complete = [result for result in results if result.state == "complete"]
        pruned = [result for result in results if result.state == "pruned" and math.isfinite(result.objective)]
        labels = [result.label for result in complete]
        values = np.array([result.objective for result in complete])
        best = np.maximum.accumulate(values)
        last = max(result.label for result in results)
        axes.step([*labels, last], [*best, best[-1]], where="post", color=COLOURS[0], linewidth=2, label="best so far")
        axes.scatter(labels, values, s=28, color=COLOURS[0], zorder=3, label="complete")
        if pruned:
            axes.scatter(
                [result.label for result in pruned],
                [result.objective for result in pruned],
                marker="x",
                s=28,
                color=COLOURS[1],
                zorder=3,
                label="pruned, as far as it got",
            )
        axes.set_title(f"{question.algorithm.name.upper()} on {question.task}", pad=12)
        axes.set_xlabel("trial")
        axes.set_ylabel(f"objective ({question.seeds} seed{'s' * (question.seeds > 1)})")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.yaxis.set_major_formatter(grouped)
        figure.legend(loc="outside lower center", ncols=3, frameon=False)
        save(figure, path, FORMATS)


def importances(path: Path, shares: Mapping[str, float], complete: int) -> None:
    """Draw the share of each hyperparameter in what makes a trial one of the best tenth, the largest on top."""
    ordered = sorted(shares.items(), key=lambda item: item[1])
    with matplotlib.style.context(["default", STYLE]):
        figure, axes = _figure(7.5, 1.4 + 0.36 * len(ordered))
        axes.barh([name for name, _ in ordered], [share for _, share in ordered], height=0.6, color=COLOURS[0])
        axes.set_title("What the best tenth of the trials have in common", pad=24)
        axes.text(0, 1.0, caveat(complete), transform=axes.transAxes, fontsize=9, color="#777777", va="bottom")
        axes.set_xlabel("share of the importance (PED-ANOVA)")
        axes.set_xlim(0, 1)
        axes.grid(visible=False, axis="y")
        save(figure, path, FORMATS)


def _figure(width: float, height: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)  # drawn by it whatever window the user has chosen
    return figure, figure.add_subplot()


def _paragraphs(
    study: SharedStudy, results: Sequence[Result], best: Result | None, pictures: Sequence[str], command: str
) -> list[str]:
    question = study.question
    labels = ", ".join(map(str, question.labels))
    counts = {
        state: sum(result.state == state for result in results) for state in dict.fromkeys(r.state for r in results)
    }
    parts = [
        f"# {question.algorithm.name.upper()} on {question.task}, tuned",
        f"Objective: {OBJECTIVE}; {question.steps:,} steps, seeds {labels}, evaluated every "
        f"{question.evaluation_interval:,} steps on {question.evaluation_episodes} episodes that no other run and no "
        f"report uses. {len(results)} trials: {', '.join(f'{count} {state}' for state, count in counts.items())}.",
    ]
    if best:
        parts += [
            f"## Best: trial {best.label}, {number(best.objective)}",
            "It is the highest of many, and so more than the same configuration will give again. With fresh seeds:",
            f"```\n{best_command(question, best.values)}\n```",
        ]
    else:
        parts.append("No trial is complete: there is no best configuration.")
    if "history" in pictures:
        parts.append("![Objective of each trial](history.png)")
    if "importances" in pictures:
        complete = sum(result.state == "complete" for result in results)
        parts += [
            "## Importances",
            "![Importance of each hyperparameter](importances.png)",
            f"Importances are {caveat(complete)}. They tell what distinguishes the best tenth of the complete trials "
            "from the others (PED-ANOVA): not which way to go, and nothing of trials that were pruned.",
        ]
    parts += ["## Trials", markdown(trials_table(question, results))]
    failed = [f"- trial {result.label}: {result.reason}" for result in results if result.state == "failed"]
    parts += ["Failed:\n" + "\n".join(failed)] if failed else []
    parts.append(f"`{command}` goes on with this search, and makes this page anew.")
    return parts


def _csv(question: Question, results: Sequence[Result]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["trial", "state", "objective", "step", *(f"seed_{k}" for k in question.labels), *question.space])
    for result in results:
        objective = "" if math.isnan(result.objective) else result.objective
        returns = [result.returns.get(seed, "") for seed in question.labels]
        values = [result.values.get(name, "") for name in question.space]
        writer.writerow([result.label, result.state, objective, result.step, *returns, *values])
    return text.getvalue()


def _value_cell(value: Any) -> Cell:
    if value is None:
        return EMPTY
    return Cell(f"{value:g}", float(value)) if isinstance(value, int | float) else Cell(str(value))
