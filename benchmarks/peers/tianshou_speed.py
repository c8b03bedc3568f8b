"""One measurement of Tianshou's SAC or TD3 under Tianshou's own trainer, in a process of its own.

It prints one line of JSON. After each step the trainer looks through everything in its replay for missing values, so
that its steps become slower as the replay fills; the window is early, which favours it.
"""

from collections import deque

import gymnasium
import numpy as np
import settings
import torch
from measuring import STEPS, Window, argument_parser, parse
from tianshou.algorithm import SAC, TD3
from tianshou.algorithm.modelfree.ddpg import ContinuousDeterministicPolicy
from tianshou.algorithm.modelfree.sac import SACPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, Collector, ReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.exploration import GaussianNoise
from tianshou.trainer import OffPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorDeterministic, ContinuousActorProbabilistic, ContinuousCritic


class WindowIsOverError(Exception):
    """The window is over, and the trainer has no other way to be told."""


def make_algorithm(name, environment):
    """Return Tianshou's `sac` or `td3` for the spaces of this environment."""
    observations, actions = environment.observation_space, environment.action_space

    def hidden_layers(**inputs):
        return Net(state_shape=observations.shape, hidden_sizes=settings.HIDDEN_SIZES, **inputs)

    def critic():
        return ContinuousCritic(preprocess_net=hidden_layers(action_shape=actions.shape, concat=True))

    common = {
        "policy_optim": AdamOptimizerFactory(lr=settings.LEARNING_RATE),
        "critic": critic(),
        "critic_optim": AdamOptimizerFactory(lr=settings.LEARNING_RATE),
        "critic2": critic(),
        "tau": settings.TARGET_RATE,
        "gamma": settings.DISCOUNT,
    }
    if name == "sac":
        actor = ContinuousActorProbabilistic(
            preprocess_net=hidden_layers(), action_shape=actions.shape, unbounded=True, conditioned_sigma=True
        )
        policy = SACPolicy(actor=actor, action_space=actions)
        return SAC(policy=policy, alpha=settings.SAC_ENTROPY_WEIGHT, **common)
    policy = ContinuousDeterministicPolicy(
        actor=ContinuousActorDeterministic(preprocess_net=hidden_layers(), action_shape=actions.shape),
        action_space=actions,
        exploration_noise=GaussianNoise(sigma=settings.TD3_EXPLORATION_NOISE),
    )
    return TD3(
        policy=policy,
        policy_noise=settings.TD3_TARGET_NOISE,
        noise_clip=settings.TD3_TARGET_NOISE_LIMIT,
        update_actor_freq=settings.TD3_POLICY_DELAY,
        **common,
    )


def fill(replay):
    """Touch the pages that no transition has reached yet, so that the peak memory is that of a full replay."""
    arrays = [replay.obs, replay.obs_next, replay.act, replay.rew, replay.terminated, replay.truncated, replay.done]
    for array in [*arrays, *replay.info.values()]:
        assert not isinstance(array, Batch)
        array[len(replay) :] = 0


def main():
    """Train until the window is over and print what was measured."""
    arguments = parse(argument_parser(__doc__, ("sac", "td3")))
    torch.set_num_threads(arguments.threads)
    np.random.seed(settings.TASK_SEED)
    torch.manual_seed(settings.TASK_SEED)
    environments = DummyVectorEnv([lambda: gymnasium.make(arguments.task)])
    algorithm = make_algorithm(arguments.algorithm, gymnasium.make(arguments.task))
    window, returns = Window(arguments), deque(maxlen=100)
    collector = Collector(
        algorithm,
        environments,
        ReplayBuffer(settings.REPLAY_SIZE),
        exploration_noise=arguments.algorithm == "td3",
        on_episode_done_hook=lambda episode: returns.append(episode.rew.sum()),
    )
    collector.reset(gym_reset_kwargs={"seed": settings.TASK_SEED})
    random_steps = arguments.warmup - 1  # the first training step steps once more, and updates
    collector.collect(n_step=random_steps, random=True)
    fill(collector.buffer)

    def before_training_step(_epoch, steps):
        if steps and window.is_over_at(random_steps + steps):
            raise WindowIsOverError

    parameters = OffPolicyTrainerParams(
        training_collector=collector,
        training_fn=before_training_step,
        max_epochs=1,
        epoch_num_steps=STEPS,
        collection_step_num_env_steps=1,
        update_step_num_gradient_steps_per_sample=1.0,
        batch_size=settings.BATCH_SIZE,
        show_progress=False,
    )
    try:
        algorithm.run_training(parameters)
    except WindowIsOverError:
        window.report(returns)


if __name__ == "__main__":
    main()
