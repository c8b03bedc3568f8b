"""One measurement of PARL's SAC on PaddlePaddle, in a process of its own, with the Python of PARL's own environment.

It prints one line of JSON. The algorithm and the replay are PARL's; the networks and the loop are what PARL leaves to
its users.
"""

import os
from itertools import pairwise

os.environ["PARL_BACKEND"] = "paddle"

import gymnasium
import numpy as np
import paddle
import parl
import settings
from measuring import Window, argument_parser, parse
from paddle import nn
from parl.utils import ReplayMemory

LOG_DEVIATION_RANGE = (-20.0, 2.0)


class Model(parl.Model):
    """The networks, under the names that `parl.algorithms.SAC` asks for."""

    def __init__(self, observation_size, action_size):
        super().__init__()
        self.actor = network(observation_size, 2 * action_size)
        self.critics = nn.LayerList([network(observation_size + action_size, 1) for _ in range(2)])

    def policy(self, observations):
        """Return means and log standard deviations, before tanh."""
        means, log_deviations = paddle.chunk(self.actor(observations), 2, axis=-1)
        return means, paddle.clip(log_deviations, *LOG_DEVIATION_RANGE)

    def value(self, observations, actions):
        """Return what each critic says, [batch, 1]."""
        pairs = paddle.concat([observations, actions], axis=1)
        return [critic(pairs) for critic in self.critics]

    def get_actor_params(self):
        """Return the actor's parameters."""
        return self.actor.parameters()

    def get_critic_params(self):
        """Return both critics' parameters."""
        return self.critics.parameters()


class Agent(parl.Agent):
    """Arrays in, arrays out."""

    def act(self, observation):
        """Return an action to explore with."""
        with paddle.no_grad():
            actions, _ = self.alg.sample(paddle.to_tensor(observation[None], dtype="float32"))
        return actions.numpy()[0]

    def learn(self, observations, actions, rewards, next_observations, terminal):
        """Make one update."""
        parts = observations, actions, rewards[:, None], next_observations, terminal[:, None]
        self.alg.learn(*(paddle.to_tensor(part) for part in parts))


def network(inputs, outputs):
    """Return a multilayer perceptron."""
    sizes = (inputs, *settings.HIDDEN_SIZES)
    pairs = pairwise(sizes)
    hidden = [layer for pair in pairs for layer in (nn.Linear(*pair), nn.ReLU())]
    return nn.Sequential(*hidden, nn.Linear(sizes[-1], outputs))


def train(agent, environment, warmup, window):
    """Explore and learn until the window is over; the first update follows step `warmup`."""
    sizes = environment.observation_space.shape[0], environment.action_space.shape[0]
    replay = ReplayMemory(settings.REPLAY_SIZE, *sizes)
    for array in (replay.obs, replay.action, replay.reward, replay.terminal, replay.next_obs):
        array.fill(0)  # touches its memory, as a long run would
    observation, _ = environment.reset(seed=settings.TASK_SEED)
    step = 0
    while not (step >= warmup and window.is_over_at(step)):
        action = environment.action_space.sample() if step < warmup else agent.act(observation)
        next_observation, reward, terminated, truncated, _ = environment.step(action)
        replay.append(observation, action, reward, next_observation, terminated)
        observation = environment.reset()[0] if terminated or truncated else next_observation
        step += 1
        if step >= warmup:
            agent.learn(*replay.sample_batch(settings.BATCH_SIZE))


def main():
    """Train until the window is over and print what was measured."""
    arguments = parse(argument_parser(__doc__, ("sac",)))
    paddle.base.core.set_num_threads(arguments.threads)
    np.random.seed(settings.TASK_SEED)
    paddle.seed(settings.TASK_SEED)
    environment = gymnasium.wrappers.RecordEpisodeStatistics(gymnasium.make(arguments.task))
    environment.action_space.seed(settings.TASK_SEED)
    model = Model(environment.observation_space.shape[0], environment.action_space.shape[0])
    algorithm = parl.algorithms.SAC(
        model,
        gamma=settings.DISCOUNT,
        tau=settings.TARGET_RATE,
        alpha=settings.SAC_ENTROPY_WEIGHT,
        actor_lr=settings.LEARNING_RATE,
        critic_lr=settings.LEARNING_RATE,
    )
    window = Window(arguments)
    train(Agent(algorithm), environment, arguments.warmup, window)
    window.report(environment.return_queue)


if __name__ == "__main__":
    main()
