"""One measurement of SB3's or SBX's SAC, in a process of its own; `benchmarks/speed.py` runs it with the peers' Python.

It prints one line of JSON. The two scripts that measure take the same arguments, and this one `--together` as well.
"""

import argparse
import json
import os
import resource
import sys
import time
import warnings

TASK_SEED = 0
PAPER = {
    "learning_rate": 3e-4,
    "buffer_size": 1_000_000,
    "batch_size": 256,
    "tau": 0.005,
    "gamma": 0.99,
    "train_freq": 1,
    "gradient_steps": 1,
    "ent_coef": 0.2,
}


def parse():
    """Return the arguments that the driver gives."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--algorithm", choices=("sb3", "sbx"), required=True)
    parser.add_argument("--task", required=True)
    parser.add_argument("--seeds", type=int, choices=(1,), required=True)
    parser.add_argument("--cores", required=True)
    parser.add_argument("--launched", type=float, required=True)
    parser.add_argument("--warmup", type=int, required=True)
    parser.add_argument("--settled", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--evaluation-interval", type=int, required=True)
    parser.add_argument("--evaluation-episodes", type=int, required=True)
    parser.add_argument("--together", action="store_true", help="say `ready` and wait for a line before the window")
    return parser.parse_args()


def make_model(arguments, environment):
    """Return the peer's SAC with the paper's settings."""
    if arguments.algorithm == "sb3":
        from stable_baselines3 import SAC
    else:
        from sbx import SAC
    model = SAC(
        "MlpPolicy",
        environment,
        learning_starts=arguments.warmup - 1,
        policy_kwargs={"net_arch": [256, 256]},
        seed=TASK_SEED,
        device="cpu",
        **PAPER,
    )
    fill(model.replay_buffer)
    return model


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

        def _on_step(self):
            # Called after the environment's step and before its update: the first update is over one call later.
            if self.num_timesteps == arguments.warmup + 1:
                self.start_seconds = time.monotonic() - arguments.launched
            if self.num_timesteps == arguments.settled:
                if arguments.together:
                    print("ready", flush=True)
                    sys.stdin.readline()
                self.begin = time.monotonic()
            if self.num_timesteps <= arguments.settled:
                return True
            self.steps, self.end = self.num_timesteps - arguments.settled, time.monotonic()
            return self.end - self.begin < arguments.seconds or self.steps < arguments.steps

    return Clock()


def main():
    """Train until the window is over and print what was measured."""
    arguments = parse()
    cores = [int(core) for core in arguments.cores.split(",")]
    os.sched_setaffinity(0, cores)
    warnings.filterwarnings("ignore")

    import gymnasium
    import torch
    from stable_baselines3.common.callbacks import EvalCallback
    from stable_baselines3.common.monitor import Monitor

    torch.set_num_threads(len(cores))
    model = make_model(arguments, gymnasium.make(arguments.task))
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
