"""Train SB3 or SBX at csac's presets `paper` until killed: `python -m benchmarks peers` times it by its stamps."""

import argparse

import torch
from models import make_model

from benchmarks.stamps import make

WARMUP = 250


def fill(replay):
    """Touch every page of the replay, so that the peak memory is that of a run long enough to fill it."""
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        getattr(replay, name).fill(0)


def main():
    """Train."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--library", choices=("sb3", "sbx"), required=True)
    parser.add_argument("--algorithm", choices=("sac", "td3", "ppo"), default="sac")
    parser.add_argument("--threads", type=int, default=1, help="of PyTorch")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    model = make_model(arguments.library, arguments.algorithm, make(), seed=0, learning_starts=WARMUP - 1)
    if arguments.algorithm != "ppo":
        fill(model.replay_buffer)
    model.learn(1_000_000)


if __name__ == "__main__":
    main()
