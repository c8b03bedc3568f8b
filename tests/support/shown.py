"""What a console has shown, and runs to show."""

import io

from manifests import manifest
from rich.console import Console

from csac.record.run import RunDirectory
from csac.record.sets import RunSet


class Clock:
    """Stands still until told."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def text_of(renderable):
    file = io.StringIO()
    Console(file=file, width=500).print(renderable)
    return [" ".join(line.split()) for line in file.getvalue().splitlines() if line.strip(" ─")]


def lines(console):
    return console.file.getvalue().splitlines()


def make_set(path, returns, failures=(), **values):
    """Runs whose evaluations at 10, 20, ... have one episode each, with `returns` [seed][point], and two episodes."""
    for seed, line in enumerate(returns):
        failed = {"state": "failed", "failure": "step 20: reward is nan"} if seed in failures else {}
        given = {"algorithm": "csac", "steps": 1000, "steps_done": 10 * len(line), **values, **failed}
        run = RunDirectory.create(path / f"seed-{seed}", manifest(seed=seed, **given))
        points = [{"seed": seed, "step": 10 * (point + 1), "return": value} for point, value in enumerate(line)]
        run.append("evaluations", [{**point, "episode": 0, "length": 7, "success": None} for point in points])
        run.append("episodes", [{"seed": seed, "step": step, "return": 1.0, "length": 5} for step in (5, 10)])
    return RunSet.open(path)
