r"""Train one peer with one seed, to learn how fast it is on a task or what it has learnt after so many steps.

    .venv-peers/bin/python benchmarks/peers/equal_time.py --peer sbx-tqc --task Ant-v4 --seed 7 --seconds 60
    .venv-peers/bin/python benchmarks/peers/equal_time.py --peer sbx-tqc --task Ant-v4 --seed 7 --out a.csv \
        --steps 900 1800

With `--seconds` nothing is evaluated: a line of JSON has how many steps and updates were over after two thirds of the
seconds and at their end, which are those since the process was started: imports and compilation count. With `--steps`
it is evaluated after each of them, in 10 deterministic episodes, and training ends with the last, or where it fails:
the evaluations that are left are NaN then. The peers and their settings are in models.py;
`python -m benchmarks.equal_time` runs all of them.
"""

import argparse
import csv
import json
import math
import os
import time
import warnings
from importlib.util import find_spec
from pathlib import Path

from evaluation import evaluate
from models import PEERS, make_peer

IMPORTED = time.monotonic()  # what is imported above takes no time that could be seen; what does comes later
COLUMNS = ("peer", "task", "seed", "step", "updates", "episode", "return", "length")
SHARES = (2 / 3, 1.0)  # of the seconds: when steps are counted
EPISODES = 10
LARGEST_SEED = 2**32 - 1  # NumPy's


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
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--seconds", type=float, help="count the steps of so many, from the start of the process")
    what.add_argument("--steps", type=int, nargs="+", help="evaluate after each of these environment steps")
    parser.add_argument("--launched", type=float, default=IMPORTED, help="time.monotonic() when it was started")
    parser.add_argument("--out", type=Path, help="the CSV file, with --steps; it appears complete or not at all")
    arguments = parser.parse_args(given)
    if not 0 <= arguments.seed <= LARGEST_SEED:
        parser.error(f"--seed must be from 0 to {LARGEST_SEED}, not {arguments.seed}")
    if arguments.seconds is None:
        _check_steps(parser, arguments)
    elif not (math.isfinite(arguments.seconds) and arguments.seconds > 0):
        parser.error(f"--seconds must be a number above 0, not {arguments.seconds}")
    elif arguments.out:
        parser.error("--out is for --steps: with --seconds nothing is evaluated")
    if not arguments.launched <= time.monotonic():
        parser.error(f"--launched is no reading of time.monotonic() from before this process: {arguments.launched}")
    if problem := unusable(arguments.peer, arguments.task):
        parser.error(problem)
    return arguments


def _check_steps(parser, arguments):
    if arguments.steps[0] < 1 or sorted(set(arguments.steps)) != arguments.steps:
        parser.error(f"--steps must be whole numbers from 1 on that rise, not {' '.join(map(str, arguments.steps))}")
    if not arguments.out:
        parser.error("--steps needs --out FILE.csv")
    if not arguments.out.parent.is_dir() or arguments.out.is_dir():
        parser.error(f"--out must be a file in a folder that exists, not {arguments.out}")


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


def train(model, steps, look):
    """Train for so many steps, or until `look` returns true: asked before each step, after the updates of the last."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Callback(BaseCallback):
        is_over = False

        def _on_rollout_start(self):
            # A rollout is one step; the updates that belong to the one before are over by now.
            self.is_over = self.is_over or look()

        def _on_step(self):
            return not self.is_over

    model.learn(steps, callback=Callback())


def count_steps(model, seconds, launched, now=time.monotonic):
    """Return the seconds since `launched`, the steps and the updates at two thirds of `seconds` and at their end."""
    marks, left = [], [share * seconds for share in SHARES]

    def look():
        passed = now() - launched
        while left and passed >= left[0]:
            marks.append((passed, model.num_timesteps, model._n_updates))
            del left[0]
        return not left

    train(model, 10**9, look)
    return marks


def learn(model, environment, steps):
    """Return the step, the updates, and the returns and lengths of ten episodes, after each of `steps`.

    Once the actor is not finite, returns are NaN and lengths 0, whatever its actions would still be worth.
    """
    found = []

    def look():
        if model.num_timesteps >= steps[len(found)]:
            if has_failed(model):
                return True
            found.append((model.num_timesteps, model._n_updates, evaluate(model, environment, EPISODES)))
        return len(found) == len(steps)

    try:
        train(model, steps[-1] + 1, look)  # one more than wanted: what ends training is `look`
    except Exception:  # PyTorch refuses a distribution that is not finite by a ValueError, where JAX goes on
        if not has_failed(model):
            raise
    left = steps[len(found) :] if has_failed(model) else []
    return found + [(step, model._n_updates, [(math.nan, 0)] * EPISODES) for step in left]


def has_failed(model):
    """Return whether a parameter of the actor is not finite, which it will never be again."""
    import numpy

    return not all(numpy.isfinite(values).all() for values in _parameters(model.policy))


def _parameters(policy):
    """Return the arrays of the actor, of SBX or of SB3."""
    if hasattr(policy, "actor_state"):
        import jax

        return jax.tree.leaves(policy.actor_state.params)
    return [parameter.detach().cpu().numpy() for parameter in policy.actor.parameters()]


def main(given=None):
    """Train, and print how far it came as one line of JSON; with `--steps` the rows are written first."""
    arguments = read_arguments(given)
    model = make_peer(arguments.peer, arguments.task, arguments.seed)
    if arguments.seconds is not None:
        print(json.dumps({"marks": count_steps(model, arguments.seconds, arguments.launched)}), flush=True)
        return
    import gymnasium

    found = learn(model, gymnasium.make(arguments.task), arguments.steps)
    partial = arguments.out.with_suffix(".partial")
    with partial.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for *reached, episodes in found:
            for episode, told in enumerate(episodes):
                writer.writerow((arguments.peer, arguments.task, arguments.seed, *reached, episode, *told))
    os.replace(partial, arguments.out)
    step, updates, ((last, _), *_) = found[-1]
    print(json.dumps({"step": step, "updates": updates, "failed": math.isnan(last)}), flush=True)


if __name__ == "__main__":
    main()
