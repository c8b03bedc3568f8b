"""Train a Stable-Baselines3 agent by our evaluation protocol and write its rows in our `evaluations.csv` format.

Run it with the peers' own Python (`make peers`), one seed per process, so that seeds can share the machine's cores:

    .venv-peers/bin/python benchmarks/peers/sb3_learning.py --algorithm td3 --seed 0 --steps 100000 --out td3_seed0.csv

The settings are those of csac's presets `paper`; --entropy-weight auto makes SAC that of csac's defaults.
"""

import argparse
import csv
import os
import warnings
from pathlib import Path

import gymnasium
import torch
from models import make_model
from stable_baselines3.common.callbacks import BaseCallback

warnings.filterwarnings("ignore", category=DeprecationWarning)

# Episode j of every evaluation is reset with this seed + j: the same starts that csac's own evaluation uses.
EVALUATION_SEED = 1_000_000


def evaluate(model, environment, seed):
    """Return the return and the length of one episode of deterministic actions."""
    scales = model.get_vec_normalize_env()  # those that training has reached by now
    observation, _ = environment.reset(seed=seed)
    total, length, ended = 0.0, 0, False
    while not ended:
        action, _ = model.predict(scales.normalize_obs(observation) if scales else observation, deterministic=True)
        observation, reward, terminated, truncated, _ = environment.step(action)
        total, length, ended = total + float(reward), length + 1, terminated or truncated
    return total, length


class Evaluations(BaseCallback):
    """Evaluates at every multiple of the interval and writes the rows.

    SB3 calls it after a step of the environment and before the update that follows, where csac evaluates after it: the
    policies of SAC and TD3 have had one update fewer here. PPO's changes at the end of a rollout only; the one in force
    is evaluated, its observations on the scale reached by then.
    """

    def __init__(self, arguments, file):
        super().__init__()
        self.arguments, self.file, self.writer = arguments, file, csv.writer(file, lineterminator="\n")
        self.writer.writerow(["seed", "step", "episode", "return", "length", "success"])
        self.environment = gymnasium.make(arguments.task)

    def _on_step(self):
        if self.num_timesteps % self.arguments.evaluation_interval == 0 or self.num_timesteps == self.arguments.steps:
            for episode in range(self.arguments.evaluation_episodes):
                total, length = evaluate(self.model, self.environment, EVALUATION_SEED + episode)
                self.writer.writerow([self.arguments.seed, self.num_timesteps, episode, total, length, ""])
            self.file.flush()
        return self.num_timesteps < self.arguments.steps


def main():
    """Train one seed; the file appears complete or not at all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithm", choices=("sac", "td3", "ppo"), default="sac")
    parser.add_argument("--task", default="HalfCheetah-v4")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--evaluation-interval", type=int, default=5_000)
    parser.add_argument("--evaluation-episodes", type=int, default=10)
    parser.add_argument("--entropy-weight", default="0.2", help="SAC's ent_coef: a number, or 'auto'")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()

    torch.set_num_threads(arguments.threads)
    environment = gymnasium.make(arguments.task)
    model = make_model("sb3", arguments.algorithm, environment, arguments.seed, 10_000, arguments.entropy_weight)
    partial = arguments.out.with_suffix(".partial")
    with partial.open("w", newline="") as file:
        # One call for the whole run, because the schedule of PPO's learning rate spans what one call is asked for.
        model.learn(arguments.steps, callback=Evaluations(arguments, file))
    os.replace(partial, arguments.out)


if __name__ == "__main__":
    main()
