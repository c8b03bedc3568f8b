"""Fill in the tables of the pages in results/ and of docs/results.md, and draw their pictures: `make results`.

A page describes each table in a comment above it: `<!-- table`, lines of TOML, `-->`; the table ends with
`<!-- end -->`. In the TOML, `kind` names a function in KINDS; the other keys are its arguments. Each folder has
`runs.csv` (a row per run), `evaluations.csv` (a row per evaluation, the mean over its episodes) and `configs.json` (the
settings that the column `config` names). Runs that differ only in their seed form an arm.
"""

from __future__ import annotations

import csv
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from pictures import draw_equal_time, draw_mechanism
from tables import (
    LAST_SHARE,
    Finals,
    boundary_tables,
    comma,
    compared,
    measure,
    overall_table,
    plus_minus,
    recovery_table,
    returns_table,
    stacked,
    study_tables,
    table,
)

from csac.record.plots import learning_curve
from csac.record.rendering import number
from csac.record.statistics import evaluation_matrix, maximum_average_return, mean_and_interval
from csac.studies.paper import RETURNS

TABLE = re.compile(r"(<!-- table\n(.*?)-->\n).*?(<!-- end -->)", re.DOTALL)
COLUMNS = [("seed", int), ("step", int), ("return", float), ("success", float)]
TOLD_SHARES = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the total time, columns of the equal-time table
Rows = list[dict[str, str]]


class Page:
    """A page with access to all runs and to the files in its folder."""

    def __init__(self, path: Path, runs: dict[tuple[str, str, str], np.ndarray], has_pictures: bool = True) -> None:
        self.path, self.runs, self.has_pictures = path, runs, has_pictures

    def fill_in(self) -> None:
        """Write every table of the page."""
        before = self.path.read_text(encoding="utf-8")
        after = TABLE.sub(lambda found: f"{found[1]}{self._made(tomllib.loads(found[2]))}\n{found[3]}", before)
        self.path.write_text(after, encoding="utf-8")

    def _made(self, told: dict[str, Any]) -> str:
        return KINDS[told.pop("kind")](self, **told)

    def file(self, name: str) -> Path:
        """Return a file by its path relative to the page."""
        return self.path.parent / name

    def arms(
        self,
        arms: list[str] | dict[str, str],
        task: str = "",
        seeds: list[int] | None = None,
        until: float = np.inf,
        changed: str = "",
    ) -> dict[str, np.ndarray]:
        """Return the evaluations of arms by displayed name; `task` may be omitted for arms with a single task."""
        shown = arms if isinstance(arms, dict) else {arm: arm for arm in arms}
        found = {}
        for label, arm in shown.items():
            parts = [rows for key, rows in self.runs.items() if key == (arm, task or key[1], changed)]
            if len(parts) != 1:
                raise ValueError(f"{self.path}: {arm!r} is {len(parts)} arms ({task or 'any task'}, {changed})")
            wanted = (parts[0]["step"] <= until) & (np.isin(parts[0]["seed"], seeds or ()) | (not seeds))
            found[label] = parts[0][wanted]
        return found


def read_csv(path: Path) -> Rows:
    """Return the rows of a CSV."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def read_runs(directory: Path) -> dict[tuple[str, str, str], np.ndarray]:
    """Return the evaluations of all runs in the folders of a directory, by arm, task and perturbation."""
    found: dict[tuple[str, str, str], list[tuple[Any, ...]]] = {}
    for path in sorted(directory.glob("*/runs.csv")):
        runs = {row["run"]: row for row in read_csv(path)}
        for row in read_csv(path.with_name("evaluations.csv")):
            run = runs[row["run"]]
            values = int(run["seed"]), int(row["step"]), float(row["return"]), float(row["success"] or "nan")
            found.setdefault((run["arm"], run["task"], run["perturbation"]), []).append(values)
    return {key: np.array(rows, COLUMNS) for key, rows in found.items()}


# The kinds of tables.


def returns(page: Page, arms: Any, picture: str = "", title: str = "", **chosen: Any) -> str:
    """Return a table of the returns of arms, and draw their curves."""
    found = page.arms(arms, **chosen)
    if picture and page.has_pictures:
        learning_curve(list(found.items()), page.file(picture), title)
    return returns_table(found)


def boundary(
    page: Page, arms: Any, boundary: float, steps: int, picture: str = "", title: str = "", **chosen: Any
) -> str:
    """Return tables of when each seed first reached the boundary, and draw the curves."""
    found = page.arms(arms, **chosen)
    if picture and page.has_pictures:
        learning_curve(list(found.items()), page.file(picture), title)
    return boundary_tables(found, boundary, steps)


def finals(page: Page, tasks: list[str], steps: int, **chosen: Any) -> str:
    """Return a table of the final returns of arms on several tasks."""
    found = {task: page.arms(task=task, until=steps, **chosen) for task in tasks}
    lines = [[task, *(plus_minus(measure(rows, steps).final) for rows in found[task].values())] for task in tasks]
    return table(["final return, mean ± std", *found[tasks[0]]], lines)


def growth(page: Page, arm: str, tasks: list[str], at: list[int], picture: str, title: str) -> str:
    """Return an arm's mean returns at some steps and the final return of each seed; draw its curve on each task."""
    found = {task: page.arms([arm], task)[arm] for task in tasks}
    if page.has_pictures:
        learning_curve(list(found.items()), page.file(picture), title)
    lines = []
    for task, rows in found.items():
        steps, _, values = evaluation_matrix(rows)
        means = [f"{values[:, steps == step].mean():,.0f}" for step in at]
        lines.append([task, *means, ", ".join(f"{final:,.0f}" for final in measure(rows, at[-1]).final)])
    return table(["task", *(f"mean at {step:,}" for step in at), "final return of each seed"], lines)


def paired(page: Page, arms: dict[str, str], tasks: list[str], steps: int, seeds: list[int]) -> str:
    """Return the gain of a second arm over the first on the same seeds, as a share of the first's mean return."""
    first, second = arms
    lines, gains = [], []
    for task in tasks:
        one, other = (measure(rows, steps) for rows in page.arms(arms, task, seeds, steps).values())
        gain = (other.final - one.final) / one.final.mean()
        means = [f"{values.mean():,.0f}" for values in (one.final, other.final, one.drawdown, other.drawdown)]
        lines.append([task, *means[:2], f"{gain.mean():+.1%}", *means[2:]])
        gains.extend(gain)
    told = mean_and_interval(np.array(gains))
    lines.append(["all", "", "", f"{told.mean:+.1%} ({told.low:+.1%} to {told.high:+.1%})", "", ""])
    headings = [f"final return, {first}", second, "difference", f"drawdown, {first}", second]
    return table([f"seeds {comma(seeds)}", *headings], lines)


def published(page: Page, steps: dict[str, int], ours: str, others: str, seeds: list[int]) -> str:
    """Return the maximum average returns of CSAC and SAC in the paper and of two arms after some steps."""
    lines, finals = [], []
    for task, until in steps.items():
        arms = page.arms([ours, others], task, seeds, until)
        told = [f"{cell.mean:,.0f} ± {cell.std:,.0f}" for cell in (RETURNS[task]["CSAC"], RETURNS[task]["SAC"])]
        best = [f"{maximum_average_return(rows)[0]:,.0f}" for rows in arms.values()]
        final = [measure(rows, until).final for rows in arms.values()]
        lines.append([task, *told, f"{until:,}", *best, compared(final[0], final[1])[0]])
        finals.append(final)
    lines.append(["all", *[""] * 5, compared(*np.stack(finals, axis=-1))[0]])
    headings = ["task", "paper: CSAC", "paper: SAC", "steps here", ours, others]
    return table([*headings, "P(higher final return)"], lines)


def recoveries(
    page: Page, arms: Any, step: int, friction: str = "", picture: str = "", title: str = "", **chosen: Any
) -> str:
    """Return the cost of a change of friction after a step, and draw the curves."""
    found = page.arms(arms, changed=f"friction={friction}@{step}" if friction else "", **chosen)
    if picture and page.has_pictures:
        learning_curve(list(found.items()), page.file(picture), title, [(step, f"friction x {friction}")])
    return recovery_table(found, step)


def study(
    page: Page,
    file: str,
    methods: tuple[str, ...] = (),
    tasks: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (),
    same: dict[str, str] | None = None,
    title: str = "",
) -> str:
    """Return all tables of a study, or of some methods, tasks or seeds; `same` maps labels to arms named otherwise."""
    told = tomllib.loads(page.file(file).read_text(encoding="utf-8"))
    title = title or told["title"]
    labels = methods or [method["label"] for method in told["methods"]]
    first = told.get("first_seed", 0)
    of_study = seeds or range(first, first + told["seeds"])
    changed = "".join(told.get("conditions", [[""]])[0])
    changed_at = int(changed.partition("@")[2]) if changed else None
    found = {}
    for task in tasks or told["tasks"]:
        steps = told.get("steps_on", {}).get(task, told["steps"])
        arms = page.arms({label: (same or {}).get(label, label) for label in labels}, task, [*of_study], steps, changed)
        found[task] = {label: measure(rows, steps, changed_at) for label, rows in arms.items()}
    part = [f"seeds {comma(seeds)}"] * bool(seeds) + [f"on {comma(tasks)}"] * bool(tasks)
    heading = f"## {title}" + (f": {comma(part)} alone" if part else "")
    return "\n\n".join([heading, *study_tables(title, found, of_study, bool(changed))])


def cases(page: Page, data: str) -> str:
    """Return the frequency of each event in 1,000 fresh rollouts per seed; returns and waypoints are means."""
    rows = read_csv(page.file(data))
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    lines = []
    for name in list(rows[0])[3:]:
        is_mean, form = name in ("return", "num_targets_reached"), ".3f" if name == "num_targets_reached" else ",.1f"
        cells = [f"{name} (mean)" if is_mean else name]
        for arm in arms:
            values = np.array([float(row[name]) for row in rows if row["arm"] == arm]) * (1 if is_mean else 1_000)
            cells.append(f"{values.mean():{form}} ± {values.std(ddof=1):{form}}")
        lines.append(cells)
    return table(["per 1,000 rollouts", *arms], lines)


def equal_time(page: Page, data: str, peers: list[str], own: dict[str, str], seeds: list[int], picture: str) -> str:
    """Return and draw the returns of arms in the same time T; `own` maps csac's names in `data` to its arms."""
    plan, speeds, parts = read_csv(page.file(data)), [], []
    finals: Finals = {}
    drawn: dict[str, dict[str, np.ndarray]] = {}  # [seed, share], by task and arm
    for task in dict.fromkeys(row["task"] for row in plan):
        finals[task], drawn[task], lines = {}, {}, []
        for label, rows in page.arms({**dict(zip(peers, peers, strict=True)), **own}, task, seeds).items():
            told = [row for row in plan if (row["arm"], row["task"]) == (label, task)]
            reached, final = _in_time(rows, told, label in own)
            rate, seconds, steps = (float(told[-1][name]) for name in ("steps_per_second", "seconds", "steps"))
            speeds.append([task, label, f"{rate:.1f}", f"{seconds:.0f}", f"{steps:,.0f}"])
            means = [number(values.mean()) for share, values in reached.items() if share in TOLD_SHARES]
            lines.append([label, plus_minus(final), number(final.min()), *means])
            finals[task][label], drawn[task][label] = final, np.stack([*reached.values()], axis=1)
        headings = ["method", "return at equal time, mean ± std", "worst seed", *(f"at {x:g} T" for x in TOLD_SHARES)]
        parts.append(table(headings, lines, f"{task}: seeds {comma(seeds)}"))
    if page.has_pictures:
        times = {
            task: sorted({float(r["share"]) * float(r["seconds"]) for r in plan if r["task"] == task}) for task in drawn
        }
        draw_equal_time(page.file(picture), drawn, times)
    speed = table(["task", "method", "steps per second", "T, s", "steps in T"], speeds, "How fast each is")
    compared_with_peers = [_against(finals, label, peers) for label in own]
    return "\n\n".join([speed, *parts, overall_table("Equal time", finals), *compared_with_peers])


def _in_time(rows: np.ndarray, told: Rows, is_own: bool) -> tuple[dict[float, np.ndarray], np.ndarray]:
    """Return each seed's last evaluation at each share of T, and its final return, the mean over the last fifth.

    For a peer this is the last fifth of the time, for an own arm that of its steps, as in the other stages.
    """
    at, _, values = evaluation_matrix(rows)
    reached = {float(row["share"]): values[:, at <= int(row["steps"])][:, -1] for row in told}
    late = [values for share, values in reached.items() if share > 1 - LAST_SHARE]
    within = min(int(told[-1]["steps"]), int(at[-1]))
    return reached, measure(rows[rows["step"] <= within], within).final if is_own else np.mean(late, axis=0)


def _against(finals: Finals, label: str, peers: list[str]) -> str:
    final, lines = stacked(finals), []
    for peer in peers:
        on_each = [compared(arms[label], arms[peer])[0] for arms in finals.values()]
        lines.append([peer, *compared(final[label], final[peer]), *on_each])
    headings = ["against", "P(higher return)", "so", *(f"P(higher return), {task}" for task in finals)]
    return table(headings, lines, f"{label}, against each peer")


def mechanism(page: Page, data: str, picture: str) -> str:
    """Return means over the second half of the runs with one weight, and draw these runs."""
    arms = {name: rows for name, rows in _columns(page.file(data)).items() if "tau" not in name}
    if page.has_pictures:
        draw_mechanism(page.file(picture), arms)
    names = list(next(iter(arms.values())))[3:]
    lines = [[name, *(f"{_late_mean(columns[name]):.3g}" for columns in arms.values())] for name in names]
    return table(["second half of the run", *arms], lines)


def weights(page: Page, data: str, columns: list[str]) -> str:
    """Return some of these means for runs with different weights, sorted by weight times lag."""
    lines = []
    for name, arm in _columns(page.file(data)).items():
        tau, product = arm["tau"][0], arm["tau"][0] * arm["lag"][0]
        if not name.endswith("sampled"):
            line = [name, f"{tau:g}", f"{product:,.4g}", *(f"{_late_mean(arm[column]):.3g}" for column in columns)]
            lines.append((product, line))
    return table(["arm", "τ", "τL", *columns], [line for _, line in sorted(lines, key=lambda pair: pair[0])])


def _columns(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Return the columns of a table by arm; its first column names the arm."""
    arms: dict[str, Rows] = {}
    for row in read_csv(path):
        arms.setdefault(row.pop("arm"), []).append(row)
    return {
        name: {column: np.array([float(row[column] or "nan") for row in rows]) for column in rows[0]}
        for name, rows in arms.items()
    }


def _late_mean(values: np.ndarray) -> float:
    return float(np.nanmean(values[len(values) // 2 :]))


KINDS = {
    "returns": returns,
    "boundary": boundary,
    "finals": finals,
    "growth": growth,
    "paired": paired,
    "published": published,
    "recoveries": recoveries,
    "study": study,
    "cases": cases,
    "equal_time": equal_time,
    "mechanism": mechanism,
    "weights": weights,
}


def main(root: Path = Path(__file__).parents[1], has_pictures: bool = True) -> None:
    """Fill in every page of a working copy."""
    runs = read_runs(root / "results")
    others = root / "results" / "reference" / "mechanism.md", root / "docs" / "results.md"
    for path in (*sorted(root.glob("results/*/README.md")), *others):
        Page(path, runs, has_pictures).fill_in()


if __name__ == "__main__":
    main()
