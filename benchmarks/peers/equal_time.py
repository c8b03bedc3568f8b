"""Train one peer for so many seconds on one task with one seed, and write what it has learnt by then.

    .venv-peers/bin/python benchmarks/peers/equal_time.py --peer sbx-tqc --task Ant-v4 --seed 7 --seconds 60 --out a.csv

Seconds are those since the process was started: imports and compilation count, and an evaluation stops the clock. There
are two, at 0.9 of the seconds and at their end, each of 10 deterministic episodes; training ends with the second. The
peers and their settings are in models.py; `python -m benchmarks.equal_time` runs all of them, one after another.
"""

import argparse
import csv
import json
import math
import os
import time
import warnings
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from evaluation import evaluate
from models import PEERS, make_peer

IMPORTED = time.monotonic()  # what is imported above takes no time that could be seen; what does comes later
COLUMNS = ("peer", "task", "seed", "limit", "seconds", "step", "updates", "episode", "return", "length")
SHARES = (0.9, 1.0)  # of the seconds: when the peer is evaluated
EPISODES = 10
STEPS = 10**9  # what training is asked for, and never reaches: the clock ends it
LARGEST_SEED = 2**32 - 1  # NumPy's


class Clock:
    """Seconds since `launched`, a reading of `now`, without those for which it was stopped."""

    def __init__(self, launched, now=time.monotonic):
        self.began, self.now = launched, now

    def seconds(self):
        """Return what the clock shows."""
        return self.now() - self.began

    @contextmanager
    def stopped(self):
        """Let no time pass on the clock meanwhile."""
        since = self.now()
        yield
        self.began += self.now() - since


class Deadline:
    """Calls `evaluate` with the clock's seconds once the clock has reached each share of the limit.

    Ask `is_over` between an update and the environment's next step, so that the policy has had all of its updates.
    """

    def __init__(self, clock, limit, evaluate):
        self.clock, self.evaluate = clock, evaluate
        self.left = [share * limit for share in SHARES]

    def is_over(self):
        """Make the evaluations that are due, the clock stopped, and return whether the last of them is made."""
        while self.left and (seconds := self.clock.seconds()) >= self.left[0]:
            with self.clock.stopped():
                self.evaluate(seconds)
            del self.left[0]
        return not self.left


class Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in one line."""

    def error(self, message):
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {message}\n")


def read_arguments(given=None):
    """Return the arguments, those of this process unless `given`; what cannot be trained ends it in one line."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", choices=PEERS, required=True)
    parser.add_argument("--task", required=True, help="a Gymnasium id whose actions are numbers within bounds")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True, help="from the start of the process to the end")
    parser.add_argument("--launched", type=float, default=IMPORTED, help="time.monotonic() when it was started")
    parser.add_argument("--out", type=Path, required=True, help="the CSV file; it appears complete or not at all")
    arguments = parser.parse_args(given)
    if not (math.isfinite(arguments.seconds) and arguments.seconds > 0):
        parser.error(f"--seconds must be a number above 0, not {arguments.seconds}")
    if not 0 <= arguments.seed <= LARGEST_SEED:
        parser.error(f"--seed must be from 0 to {LARGEST_SEED}, not {arguments.seed}")
    if not arguments.launched <= time.monotonic():
        parser.error(f"--launched is no reading of time.monotonic() from before this process: {arguments.launched}")
    if not arguments.out.parent.is_dir() or arguments.out.is_dir():
        parser.error(f"--out must be a file in a folder that exists, not {arguments.out}")
    if problem := unusable(arguments.peer, arguments.task):
        parser.error(problem)
    return arguments


def unusable(peer, task):
    """Return why this peer cannot be trained on this task here, or nothing."""
    library = {"sb3": "stable_baselines3", "sbx": "sbx"}[peer.partition("-")[0]]
    if not find_spec(library):
        return f"{library} is not installed: `make peers`, then run this with .venv-peers/bin/python"
    import gymnasium

    warnings.filterwarnings("ignore")  # after Gymnasium's own filters
    try:
        environment = gymnasium.make(task)
    except Exception as error:  # whatever an environment's own code raises
        return f"--task {task} cannot be made: {' '.join(str(error).split())}"
    spaces = environment.observation_space, environment.action_space
    environment.close()
    if not all(isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1 for space in spaces):
        return f"--task {task} has other observations or actions than a row of numbers"
    return ""


def train(arguments, clock):
    """Train until the clock has reached the seconds; return the rows of both evaluations."""
    import gymnasium
    from stable_baselines3.common.callbacks import BaseCallback

    model, rows = make_peer(arguments.peer, arguments.task, arguments.seed), []
    environment = gymnasium.make(arguments.task)
    run = (arguments.peer, arguments.task, arguments.seed, arguments.seconds)

    def look(seconds):
        reached = (round(seconds, 3), model.num_timesteps, model._n_updates)
        for episode, (total, length) in enumerate(evaluate(model, environment, EPISODES)):
            rows.append((*run, *reached, episode, total, length))

    deadline = Deadline(clock, arguments.seconds, look)

    class Callback(BaseCallback):
        is_over = False

        def _on_rollout_start(self):
            # A rollout is one step; the updates that belong to the one before are over by now.
            self.is_over = deadline.is_over()

        def _on_step(self):
            return not self.is_over

    model.learn(STEPS, callback=Callback())
    return rows


def main(given=None):
    """Train and write the rows; print how far it came, as one line of JSON."""
    arguments = read_arguments(given)
    rows = train(arguments, Clock(arguments.launched))
    partial = arguments.out.with_suffix(".partial")
    with partial.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(rows)
    os.replace(partial, arguments.out)
    print(json.dumps(dict(zip(COLUMNS, rows[-1], strict=True))), flush=True)


if __name__ == "__main__":
    main()
