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
import numpy as np
import torch
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

warnings.filterwarnings("ignore", category=DeprecationWarning)

# Episode j of every evaluation is reset with this seed + j: the same starts that csac's own evaluation uses.
EVALUATION_SEED = 1_000_000

OFF_POLICY = {
    "learning_rate": 3e-4,
    "buffer_size": 1_000_000,
    "learning_starts": 10_000,
    "batch_size": 256,
    "tau": 0.005,
    "gamma": 0.99,
    "train_freq": 1,
    "gradient_steps": 1,
    "policy_kwargs": {"net_arch": [256, 256]},
}


def make_sac(arguments):
    """Return SAC; an automatic temperature begins at 1."""
    weight = arguments.entropy_weight
    return SAC(
        "MlpPolicy",
        gymnasium.make(arguments.task),
        ent_coef=weight if weight == "auto" else float(weight),
        seed=arguments.seed,
        device="cpu",
        **OFF_POLICY,
    )


def make_td3(arguments):
    """Return TD3. Its noise is also added to the random actions of the warm-up, which then are not quite uniform."""
    environment = gymnasium.make(arguments.task)
    shape = environment.action_space.shape
    return TD3(
        "MlpPolicy",
        environment,
        policy_delay=2,
        target_policy_noise=0.2,
        target_noise_clip=0.5,
        action_noise=NormalActionNoise(np.zeros(shape), np.full(shape, 0.1)),
        seed=arguments.seed,
        device="cpu",
        **OFF_POLICY,
    )


def make_ppo(arguments):
    """Return PPO with PARL's settings, observations and rewards on running scales."""
    environment = DummyVecEnv([lambda: Monitor(gymnasium.make(arguments.task))])
    return PPO(
        "MlpPolicy",
        VecNormalize(environment, clip_obs=10.0, clip_reward=10.0, gamma=0.99),
        # The last rollout ends after the last step, where the line would be below zero.
        learning_rate=lambda progress_remaining: 3e-4 * max(progress_remaining, 0.0),
        n_steps=2048,
        batch_size=64,
        n_epochs=10,
        gamma=0.99,
        gae_lambda=0.95,
        clip_range=0.2,
        clip_range_vf=0.2,
        ent_coef=0.0,
        vf_coef=0.5,
        max_grad_norm=0.5,
        policy_kwargs={"net_arch": {"pi": [64, 64], "vf": [64, 64]}},
        seed=arguments.seed,
        device="cpu",
    )


MAKERS = {"sac": make_sac, "td3": make_td3, "ppo": make_ppo}


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
                total, length = self._episode(EVALUATION_SEED + episode)
                self.writer.writerow([self.arguments.seed, self.num_timesteps, episode, total, length, ""])
            self.file.flush()
        return self.num_timesteps < self.arguments.steps

    def _episode(self, seed):
        """Return the return and the length of one episode of deterministic actions, which draw no random numbers."""
        observation, _ = self.environment.reset(seed=seed)
        total, length, ended = 0.0, 0, False
        while not ended:
            action, _ = self.model.predict(self._scaled(observation), deterministic=True)
            observation, reward, terminated, truncated, _ = self.environment.step(action)
            total, length, ended = total + float(reward), length + 1, terminated or truncated
        return total, length

    def _scaled(self, observation):
        normaliser = self.model.get_vec_normalize_env()
        return observation if normaliser is None else normaliser.normalize_obs(observation)


def main():
    """Train one seed; the file appears complete or not at all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithm", choices=MAKERS, default="sac")
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
    model = MAKERS[arguments.algorithm](arguments)
    partial = arguments.out.with_suffix(".partial")
    with partial.open("w", newline="") as file:
        # One call for the whole run, because the schedule of PPO's learning rate spans what one call is asked for.
        model.learn(arguments.steps, callback=Evaluations(arguments, file))
    os.replace(partial, arguments.out)


if __name__ == "__main__":
    main()
