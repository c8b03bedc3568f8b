"""What a console has shown, and a run to show."""

import io

from rich.console import Console

from csac.record.manifest import Manifest, State
from csac.record.run import RunDirectory


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


def shown_on(console):
    return console.file.getvalue()


def lines(console):
    return shown_on(console).splitlines()


def make_run(path, returns, failures=(), state: State = "finished"):
    """A run whose evaluations at 10, 20, ... have one episode each, with `returns` [seed][point], and two episodes."""
    steps_done = 10 * max(len(line) for line in returns)
    run = RunDirectory.create(
        path,
        Manifest(
            task="Hopper-v4",
            algorithm="csac",
            seeds=tuple(range(len(returns))),
            steps=1000,
            steps_done=steps_done,
            state=state,
            failures=dict.fromkeys(failures, "step 20: reward is nan"),
        ),
    )
    rows = [
        {"seed": seed, "step": 10 * (point + 1), "episode": 0, "return": value, "length": 7, "success": None}
        for seed, line in enumerate(returns)
        for point, value in enumerate(line)
    ]
    run.append("evaluations", rows)
    run.append("episodes", [{"seed": 0, "step": step, "return": 1.0, "length": 5} for step in (5, 10)])
    return run
