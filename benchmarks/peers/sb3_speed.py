"""One measurement of SB3 or SBX, in a process of its own; `python -m benchmarks peers` runs it with the peers' Python.

It prints one line of JSON.
"""

from measuring import STEPS, Window, argument_parser, parse
from models import make_model
from settings import TASK_SEED


def fill(replay):
    """Touch every page of the replay, so that the peak memory is that of a run long enough to fill it."""
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        getattr(replay, name).fill(0)


def make_clock(window):
    """Return a callback that ends training after the window."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Clock(BaseCallback):
        is_over = False

        def _on_rollout_start(self):
            # A rollout is one step, of PPO 2048; the update that belongs to the rollout before is over by now.
            self.is_over = window.is_over_at(self.num_timesteps)

        def _on_step(self):
            return not self.is_over

    return Clock()


def main():
    """Train until the window is over and print what was measured."""
    parser = argument_parser(__doc__, ("sac", "td3", "ppo"))
    parser.add_argument("--library", choices=("sb3", "sbx"), required=True)
    arguments = parse(parser, evaluates=True)

    import gymnasium
    import torch
    from stable_baselines3.common.callbacks import EvalCallback
    from stable_baselines3.common.monitor import Monitor

    torch.set_num_threads(arguments.threads)
    model = make_model(arguments.library, arguments.algorithm, arguments.task, TASK_SEED, arguments.warmup - 1)
    if arguments.algorithm != "ppo":
        fill(model.replay_buffer)
    window = Window(arguments)
    callbacks = [make_clock(window)]
    if arguments.evaluation_interval:
        evaluation = EvalCallback(
            Monitor(gymnasium.make(arguments.task)),
            n_eval_episodes=arguments.evaluation_episodes,
            eval_freq=arguments.evaluation_interval,
            verbose=0,
        )
        callbacks.append(evaluation)
    model.learn(STEPS, callback=callbacks)
    window.report([episode["r"] for episode in model.ep_info_buffer])


if __name__ == "__main__":
    main()
