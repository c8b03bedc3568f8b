"""Train a Stable-Baselines3 agent by our evaluation protocol and write its rows in our `evaluations.csv` format.

Run it with the peers' own Python (`make peers`), one seed per process, so that seeds can share the machine's cores:

    .venv-peers/bin/python benchmarks/peers/sb3_learning.py --seed 0 --steps 100000 --out sb3_seed0.csv
"""

import argparse
import csv
import os
import warnings
from pathlib import Path

import gymnasium
import torch
from stable_baselines3 import SAC

warnings.filterwarnings("ignore", category=DeprecationWarning)

# Episode j of every evaluation is reset with this seed + j: the same starts that csac's own evaluation uses.
EVALUATION_SEED = 1_000_000


def evaluate(model, environment, episodes):
    """Return (return, length) of each deterministic episode."""
    results = []
    for episode in range(episodes):
        observation, _ = environment.reset(seed=EVALUATION_SEED + episode)
        total, length, ended = 0.0, 0, False
        while not ended:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = environment.step(action)
            total, length, ended = total + float(reward), length + 1, terminated or truncated
        results.append((total, length))
    return results


def main():
    """Train one seed; the file appears complete or not at all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="HalfCheetah-v4")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--evaluation-interval", type=int, default=5_000)
    parser.add_argument("--evaluation-episodes", type=int, default=10)
    parser.add_argument("--entropy-weight", default="0.2", help="SB3's ent_coef: a number, or 'auto'")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()

    torch.set_num_threads(arguments.threads)
    entropy_weight = arguments.entropy_weight if arguments.entropy_weight == "auto" else float(arguments.entropy_weight)
    model = SAC(
        "MlpPolicy",
        gymnasium.make(arguments.task),
        learning_rate=3e-4,
        buffer_size=1_000_000,
        learning_starts=10_000,
        batch_size=256,
        tau=0.005,
        gamma=0.99,
        train_freq=1,
        gradient_steps=1,
        ent_coef=entropy_weight,
        policy_kwargs={"net_arch": [256, 256]},
        seed=arguments.seed,
        device="cpu",
    )
    environment = gymnasium.make(arguments.task)
    partial = arguments.out.with_suffix(".partial")
    with partial.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["seed", "step", "episode", "return", "length", "success"])
        for step in range(0, arguments.steps, arguments.evaluation_interval):
            model.learn(min(arguments.evaluation_interval, arguments.steps - step), reset_num_timesteps=step == 0)
            for episode, (total, length) in enumerate(evaluate(model, environment, arguments.evaluation_episodes)):
                writer.writerow([arguments.seed, model.num_timesteps, episode, total, length, ""])
            file.flush()
    os.replace(partial, arguments.out)


if __name__ == "__main__":
    main()
