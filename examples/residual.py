"""A custom critic: run csac train TASK --algorithm residual:ResidualSAC in this folder."""

from dataclasses import dataclass

import equinox as eqx
import jax

from csac import SAC


class ResidualCritic(eqx.Module):
    """Q(s, a) for one example, [observation + action] -> [1]."""

    first: eqx.nn.Linear
    block: eqx.nn.Linear
    last: eqx.nn.Linear

    def __init__(self, key, size, width):
        keys = jax.random.split(key, 3)
        self.first = eqx.nn.Linear(size, width, key=keys[0])
        self.block = eqx.nn.Linear(width, width, key=keys[1])
        self.last = eqx.nn.Linear(width, 1, key=keys[2])

    def __call__(self, inputs):
        """Return [Q] for one pair [observation + action]."""
        hidden = self.first(inputs)
        return self.last(hidden + self.block(jax.nn.relu(hidden)))


@dataclass(frozen=True)
class ResidualSAC(SAC):
    """SAC whose critics have a residual block."""

    def make_critic(self, key, spec):
        """Return a randomly initialised critic."""
        return ResidualCritic(key, spec.observation_size + spec.action_size, self.critic_hidden_sizes[0])
