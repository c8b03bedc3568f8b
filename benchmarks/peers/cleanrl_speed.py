"""One measurement of SAC or TD3 written the way CleanRL writes them, in a process of its own.

It prints one line of JSON. The file is ours, and has CleanRL's structure: plain PyTorch modules, a vector environment
of one, a replay in NumPy, one optimiser for the actor and one for both critics, one update after each step. With
`--compile`, the losses with their gradients, the optimisers' steps, the targets' and the choice of an action go through
torch.compile, which needs a C++ compiler and Python's headers.
"""

import copy
from itertools import pairwise

import gymnasium
import numpy as np
import settings
import torch
from measuring import Window, argument_parser, parse
from torch import nn
from torch.nn.functional import mse_loss

LOG_DEVIATION_RANGE = (-5.0, 2.0)


class Replay:
    """The last transitions, in arrays that are written from the start, as they are late in a long run."""

    def __init__(self, observation_size, action_size):
        sizes = (observation_size, action_size, 1, observation_size, 1)
        self.arrays = [np.empty((settings.REPLAY_SIZE, size), np.float32) for size in sizes]
        for array in self.arrays:
            array.fill(0)
        self.count = 0

    def add(self, *transition):
        """Store observation, action, reward, next observation and whether it was terminal."""
        for array, value in zip(self.arrays, transition, strict=True):
            array[self.count % settings.REPLAY_SIZE] = value
        self.count += 1

    def sample(self):
        """Return a batch of transitions, a tensor for each part."""
        rows = np.random.randint(0, min(self.count, settings.REPLAY_SIZE), settings.BATCH_SIZE)
        return [torch.as_tensor(array[rows]) for array in self.arrays]


class Critic(nn.Module):
    """The value of an action in a state."""

    def __init__(self, observation_size, action_size):
        super().__init__()
        self.layers = hidden_layers(observation_size + action_size)
        self.value = nn.Linear(settings.HIDDEN_SIZES[-1], 1)

    def forward(self, observations, actions):
        """Return [batch, 1]."""
        return self.value(self.layers(torch.cat([observations, actions], dim=1)))


class Actor(nn.Module):
    """What both actors share: hidden layers, and the way from (-1, 1) to the bounds of the actions."""

    def __init__(self, observation_size, action_space, outputs):
        super().__init__()
        self.layers = hidden_layers(observation_size)
        width = settings.HIDDEN_SIZES[-1]
        self.heads = nn.ModuleList(nn.Linear(width, action_space.shape[0]) for _ in range(outputs))
        self.register_buffer("scale", torch.tensor((action_space.high - action_space.low) / 2, dtype=torch.float32))
        self.register_buffer("centre", torch.tensor((action_space.high + action_space.low) / 2, dtype=torch.float32))

    def forward(self, observations):
        """Return what each head says."""
        hidden = self.layers(observations)
        return [head(hidden) for head in self.heads]


class Learner:
    """What SAC and TD3 share: two critics with their targets, optimisers, and what is compiled."""

    policy_outputs = 1

    def __init__(self, observation_size, action_space):
        action_size = action_space.shape[0]
        self.actor = Actor(observation_size, action_space, self.policy_outputs)
        self.critics = nn.ModuleList(Critic(observation_size, action_size) for _ in range(2))
        self.target_actor, self.target_critics = copy.deepcopy(self.actor), copy.deepcopy(self.critics)
        self.actor_optimiser = torch.optim.Adam(self.actor.parameters(), lr=settings.LEARNING_RATE)
        self.critic_optimiser = torch.optim.Adam(self.critics.parameters(), lr=settings.LEARNING_RATE)

    def compile(self):
        """Let torch.compile make a program of each loss with its gradient and of each step that follows."""
        self.critic_loss, self.actor_loss = torch.compile(self.critic_loss), torch.compile(self.actor_loss)
        self.actor_optimiser.step = torch.compile(self.actor_optimiser.step)
        self.critic_optimiser.step = torch.compile(self.critic_optimiser.step)
        self.act, self.follow = torch.compile(self.act), torch.compile(self.follow)

    def update(self, batch, number):
        """Make update `number`, counted from 0: the critics', and the actor's where it is due."""
        descend(self.critic_loss(*batch), self.critic_optimiser)
        if self.actor_is_due(number):
            # Its gradient reaches the critics too; their next step begins with zeroing it.
            descend(self.actor_loss(batch[0]), self.actor_optimiser)
            self.follow()

    @torch.no_grad()
    def follow(self):
        """Move the targets a little towards what they follow."""
        for followed, target in ((self.actor, self.target_actor), (self.critics, self.target_critics)):
            for parameter, slow in zip(followed.parameters(), target.parameters(), strict=True):
                slow.lerp_(parameter, settings.TARGET_RATE)

    def values_loss(self, observations, actions, targets):
        """Return the sum of both critics' squared errors."""
        return sum(mse_loss(critic(observations, actions), targets) for critic in self.critics)


class SAC(Learner):
    """Soft actor-critic with a fixed entropy weight."""

    policy_outputs = 2  # means and log standard deviations

    def actor_is_due(self, number):
        """Return True: CleanRL makes two updates every second time, which comes to the same."""
        return True

    def sample(self, observations):
        """Return actions and their log density, [batch, actions] and [batch, 1]."""
        means, squashed = self.actor(observations)
        low, high = LOG_DEVIATION_RANGE
        log_deviations = low + 0.5 * (high - low) * (torch.tanh(squashed) + 1)
        normal = torch.distributions.Normal(means, log_deviations.exp())
        raw = normal.rsample()
        unit = torch.tanh(raw)
        log_density = normal.log_prob(raw) - torch.log(self.actor.scale * (1 - unit.pow(2)) + 1e-6)
        return unit * self.actor.scale + self.actor.centre, log_density.sum(1, keepdim=True)

    @torch.no_grad()
    def act(self, observations):
        """Return actions to explore with."""
        return self.sample(observations)[0]

    def critic_loss(self, observations, actions, rewards, next_observations, terminal):
        """Return the loss of both critics."""
        with torch.no_grad():
            next_actions, log_density = self.sample(next_observations)
            values = torch.min(*(critic(next_observations, next_actions) for critic in self.target_critics))
            soft = values - settings.SAC_ENTROPY_WEIGHT * log_density
            targets = rewards + settings.DISCOUNT * (1 - terminal) * soft
        return self.values_loss(observations, actions, targets)

    def actor_loss(self, observations):
        """Return the loss of the actor."""
        actions, log_density = self.sample(observations)
        values = torch.min(*(critic(observations, actions) for critic in self.critics))
        return (settings.SAC_ENTROPY_WEIGHT * log_density - values).mean()


class TD3(Learner):
    """Twin delayed deterministic policy gradient."""

    def actor_is_due(self, number):
        """Return whether this is one of every second update."""
        return number % settings.TD3_POLICY_DELAY == 0

    def choose(self, actor, observations):
        """Return the actions of this actor."""
        (raw,) = actor(observations)
        return torch.tanh(raw) * actor.scale + actor.centre

    def clip(self, actions):
        """Return actions within the bounds."""
        return torch.clamp(actions, self.actor.centre - self.actor.scale, self.actor.centre + self.actor.scale)

    @torch.no_grad()
    def act(self, observations):
        """Return actions to explore with."""
        actions = self.choose(self.actor, observations)
        return self.clip(actions + settings.TD3_EXPLORATION_NOISE * self.actor.scale * torch.randn_like(actions))

    def critic_loss(self, observations, actions, rewards, next_observations, terminal):
        """Return the loss of both critics."""
        with torch.no_grad():
            limit = settings.TD3_TARGET_NOISE_LIMIT
            noise = (settings.TD3_TARGET_NOISE * torch.randn_like(actions)).clamp(-limit, limit) * self.actor.scale
            next_actions = self.clip(self.choose(self.target_actor, next_observations) + noise)
            values = torch.min(*(critic(next_observations, next_actions) for critic in self.target_critics))
            targets = rewards + settings.DISCOUNT * (1 - terminal) * values
        return self.values_loss(observations, actions, targets)

    def actor_loss(self, observations):
        """Return the loss of the actor."""
        return -self.critics[0](observations, self.choose(self.actor, observations)).mean()


def hidden_layers(inputs):
    """Return the hidden layers, each followed by ReLU."""
    sizes = (inputs, *settings.HIDDEN_SIZES)
    pairs = pairwise(sizes)
    return nn.Sequential(*(layer for pair in pairs for layer in (nn.Linear(*pair), nn.ReLU())))


def descend(loss, optimiser):
    """Take one step down the gradient of the loss."""
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()


def train(learner, environments, warmup, window):
    """Explore and learn until the window is over; the first update follows step `warmup`."""
    replay = Replay(environments.single_observation_space.shape[0], environments.single_action_space.shape[0])
    observations, _ = environments.reset(seed=settings.TASK_SEED)
    step = 0
    while not (step >= warmup and window.is_over_at(step)):
        if step < warmup:
            actions = environments.action_space.sample()
        else:
            actions = learner.act(torch.as_tensor(observations, dtype=torch.float32)).numpy()
        next_observations, rewards, terminated, truncated, info = environments.step(actions)
        ended = terminated[0] or truncated[0]
        last = info["final_obs"][0] if ended else next_observations[0]  # not what the next episode begins with
        replay.add(observations[0], actions[0], rewards[0], last, terminated[0])
        observations = next_observations
        step += 1
        if step >= warmup:
            learner.update(replay.sample(), step - warmup)


def main():
    """Train until the window is over and print what was measured."""
    parser = argument_parser(__doc__, ("sac", "td3"))
    parser.add_argument("--compile", action="store_true", help="use torch.compile")
    arguments = parse(parser)

    torch.set_num_threads(arguments.threads)
    np.random.seed(settings.TASK_SEED)
    torch.manual_seed(settings.TASK_SEED)
    counted = gymnasium.wrappers.RecordEpisodeStatistics(gymnasium.make(arguments.task))
    environments = gymnasium.vector.SyncVectorEnv(
        [lambda: counted], autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP
    )
    environments.action_space.seed(settings.TASK_SEED)
    observation_size = environments.single_observation_space.shape[0]
    learner = {"sac": SAC, "td3": TD3}[arguments.algorithm](observation_size, environments.single_action_space)
    if arguments.compile:
        learner.compile()
    window = Window(arguments)
    train(learner, environments, arguments.warmup, window)
    window.report(counted.return_queue)


if __name__ == "__main__":
    main()
