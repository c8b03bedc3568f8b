"""Train SB3 or SBX at csac's presets `paper` until killed: `python -m benchmarks peers` times it by its stamps."""

import argparse
from functools import partial

import gymnasium
import torch
from models import make_model
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from benchmarks.stamps import TASK

WARMUP = 250


def fill(replay):
    """Touch every page of the replay, so that the peak memory is that of a run long enough to fill it."""
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        getattr(replay, name).fill(0)


def make_one(task, monitored=False):
    """Return one environment."""
    environment = gymnasium.make(task, disable_env_checker=True)
    return Monitor(environment) if monitored else environment


def main():
    """Train."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--library", choices=("sb3", "sbx"), required=True)
    parser.add_argument("--algorithm", choices=("sac", "td3", "ppo"), default="sac")
    parser.add_argument("--threads", type=int, default=1, help="of PyTorch")
    parser.add_argument("--task", default=TASK)
    parser.add_argument("--environments", type=int, default=1)
    parser.add_argument("--processes", type=int, default=0, help="0, or one for each environment")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    environment = make_one(arguments.task)
    if arguments.environments > 1:
        kind = SubprocVecEnv if arguments.processes else DummyVecEnv
        environment = kind([partial(make_one, arguments.task, monitored=True)] * arguments.environments)
    model = make_model(arguments.library, arguments.algorithm, environment, seed=0, learning_starts=WARMUP - 1)
    if arguments.algorithm != "ppo":
        fill(model.replay_buffer)
    model.learn(1_000_000)


if __name__ == "__main__":
    main()
