"""One measurement of SB3 or SBX, in a process of its own; `benchmarks/speed.py` runs it with the peers' Python.

It prints one line of JSON. The two scripts that measure take the same arguments, and this one `--library`, `--threads`
and `--together` as well.
"""

import argparse
import json
import os
import resource
import sys
import time
import warnings

from models import make_model

TASK_SEED = 0


def parse():
    """Return the arguments that the driver gives."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--library", choices=("sb3", "sbx"), required=True)
    parser.add_argument("--algorithm", choices=("sac", "td3", "ppo"), required=True)
    parser.add_argument("--task", required=True)
    parser.add_argument("--seeds", type=int, choices=(1,), required=True)
    parser.add_argument("--cores", required=True)
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--launched", type=float, required=True)
    parser.add_argument("--warmup", type=int, required=True)
    parser.add_argument("--settled", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--evaluation-interval", type=int, required=True)
    parser.add_argument("--evaluation-episodes", type=int, required=True)
    parser.add_argument("--together", action="store_true", help="say `ready` and wait for a line before the window")
    return parser.parse_args()


def fill(replay):
    """Touch every page of the replay, so that the peak memory is that of a run long enough to fill it."""
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        getattr(replay, name).fill(0)


def make_clock(arguments):
    """Return a callback that notes the first update and the window, and ends training after it."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Clock(BaseCallback):
        start_seconds = begin = end = 0.0
        steps = 0
        is_over = False

        def _on_rollout_start(self):
            # A rollout is one step, of PPO 2048; the update that belongs to the rollout before is over by now.
            if not self.start_seconds and self.num_timesteps >= arguments.warmup:
                self.start_seconds = time.monotonic() - arguments.launched
            if self.num_timesteps < arguments.settled:
                return
            if not self.begin:
                self._begin()
            self.end, self.steps = time.monotonic(), self.num_timesteps - self.first
            self.is_over = self.end - self.begin >= arguments.seconds and self.steps >= arguments.steps

        def _begin(self):
            if arguments.together:
                print("ready", flush=True)
                sys.stdin.readline()
            self.begin, self.first = time.monotonic(), self.num_timesteps

        def _on_step(self):
            return not self.is_over

    return Clock()


def main():
    """Train until the window is over and print what was measured."""
    arguments = parse()
    os.sched_setaffinity(0, [int(core) for core in arguments.cores.split(",")])
    warnings.filterwarnings("ignore")

    import gymnasium
    import torch
    from stable_baselines3.common.callbacks import EvalCallback
    from stable_baselines3.common.monitor import Monitor

    torch.set_num_threads(arguments.threads)
    model = make_model(arguments.library, arguments.algorithm, arguments.task, TASK_SEED, arguments.warmup - 1)
    if arguments.algorithm != "ppo":
        fill(model.replay_buffer)
    clock = make_clock(arguments)
    callbacks = [clock]
    if arguments.evaluation_interval:
        evaluation = EvalCallback(
            Monitor(gymnasium.make(arguments.task)),
            n_eval_episodes=arguments.evaluation_episodes,
            eval_freq=arguments.evaluation_interval,
            verbose=0,
        )
        callbacks.append(evaluation)
    model.learn(1_000_000, callback=callbacks)
    result = {
        "start_seconds": clock.start_seconds,
        "steps": clock.steps,
        "seconds": clock.end - clock.begin,
        "steps_per_second": clock.steps / (clock.end - clock.begin),
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
