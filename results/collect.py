"""Add finished runs to a folder of results: `python results/collect.py RUNS results/paper --arm "CSAC (paper)"`.

Runs whose arm, task, perturbation and seed are already in the folder are skipped.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.studies.arms import read_arms

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from csac.record.run import RunDirectory

RUNS = ("run", "arm", "task", "perturbation", "algorithm", "seed", "steps", "seconds", "commit", "config")
EVALUATIONS = ("run", "step", "return", "length", "success")
IDENTITY = (*RUNS[1:4], "seed")
SETTINGS = ("hyperparameters", "evaluation_interval", "evaluation_episodes", "evaluation_seed")
SETTINGS += ("perturbations", "environment_arguments", "events")
DIGITS = {"return": 3, "length": 1, "success": 3}


def add(folder: Path, rows: Mapping[str, Any], config: Mapping[str, Any], evaluations: np.ndarray) -> bool:
    """Append one run; return whether it was new.

    `rows` has the columns of runs.csv except `run` and `config`, `evaluations` a row per episode.
    """
    with (folder / "runs.csv").open(newline="", encoding="utf-8") as file:
        known = list(csv.DictReader(file))
    if any(all(row[name] == str(rows[name]) for name in IDENTITY) for row in known):
        return False
    name = _config_name(folder / "configs.json", rows["arm"], config)
    number = 1 + max((int(row["run"]) for row in known), default=0)
    _append(folder / "runs.csv", RUNS, [{"run": number, **rows, "config": name}])
    own = [evaluations[evaluations["step"] == step] for step in np.unique(evaluations["step"])]
    means = [{"run": number, "step": int(of["step"][0]), **{key: _mean(of, key) for key in DIGITS}} for of in own]
    _append(folder / "evaluations.csv", EVALUATIONS, means)
    return True


def add_run(folder: Path, arm: str, run: RunDirectory) -> bool:
    """Append one finished run of one seed; return whether it was new."""
    config, manifest = run.config, run.manifest
    rows = {"arm": arm, "task": config.task, "perturbation": " ".join(config.perturbations)}
    rows |= {"algorithm": config.algorithm, "seed": run.seed, "steps": config.steps}
    rows |= {"seconds": "", "commit": (manifest.commit or "")[:10]}
    told = {name: getattr(config, name) for name in SETTINGS if getattr(config, name) or name in SETTINGS[:4]}
    return add(folder, rows, told, run.evaluations)


def _config_name(path: Path, arm: str, config: Mapping[str, Any]) -> str:
    """Return the name of these settings in configs.json; add them if they are new."""
    configs = json.loads(path.read_text(encoding="utf-8"))
    plain = json.loads(json.dumps(config))
    if same := [name for name, known in configs.items() if known == plain]:
        return same[0]
    slug = "-".join("".join(c if c.isalnum() or c == "." else " " for c in arm.lower()).split())
    name = next(n for n in (slug, *(f"{slug}-{k}" for k in range(2, 1_000))) if n not in configs)
    lines = ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in {**configs, name: plain}.items())
    path.write_text("{\n" + lines + "\n}\n", encoding="utf-8")
    return name


def _append(path: Path, names: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(names), lineterminator="\n")
    writer.writerows(rows)
    with path.open("a", encoding="utf-8") as file:
        file.write(text.getvalue())


def _mean(rows: np.ndarray, name: str) -> str:
    values = rows[name] if name in (rows.dtype.names or ()) else np.array([np.nan])
    return "" if np.isnan(values).any() else f"{round(float(values.mean()), DIGITS[name]):.10g}"


def main() -> None:
    """Add the finished runs in and below the paths."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--arm", help="what the runs are called; by default as in a report")
    asked = parser.parse_args()
    for arm in read_arms(asked.runs):
        for run in arm.runs:
            if run.manifest.state == "finished":
                done = "added" if add_run(asked.folder, asked.arm or arm.label, run) else "there already"
                print(f"{done}: {asked.arm or arm.label} on {run.config.task}, seed {run.seed}")


if __name__ == "__main__":
    main()
