"""A custom algorithm, written against the protocol: REINFORCE with normalised returns (Williams 1992)."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from csac.algorithms.memory import Rollout
from csac.algorithms.networks import MLP, gradient_step, init_optimiser, make_mlp
from csac.types import Cadence, PolicyNetwork, PolicyParameters


class State(NamedTuple):
    """The learnt state of one seed."""

    actor: MLP
    optimiser: Any


@dataclass(frozen=True)
class Reinforce:
    """REINFORCE with normalised returns (Williams 1992)."""

    learning_rate: float = 1e-3
    discount: float = 0.98
    rollout_steps: int = 500
    std: float = 0.5

    @property
    def cadence(self):
        """Return warm-up steps, steps between updates, updates made then, and transitions per update."""
        return Cadence(0, self.rollout_steps, 1, self.rollout_steps)

    def memory(self, spec, steps):
        """Return an empty Rollout, or a Replay."""
        return Rollout.create(self.rollout_steps, spec)

    def init(self, key, spec, steps):
        """Return the initial state of one seed; no two leaves may share a buffer."""
        actor = make_mlp(key, spec.observation_size, (32, 32), spec.action_size)
        return State(actor, init_optimiser(optax.adam(self.learning_rate), actor))

    def act(self, state, observation, key, explore):
        """Return an action [action] for one observation [observation]; legal actions are in [-1, 1]."""
        mean = jnp.tanh(state.actor(observation))
        return mean + self.std * jax.random.normal(key, mean.shape) if explore else mean

    def update(self, state, batch, key, step):
        """Return the state after update number `step`, counted from 0, and scalars to log."""

        def add(later, transition):
            reward, ended = transition
            value = reward + self.discount * (1 - ended) * later
            return value, value

        ended = jnp.maximum(batch.terminated, batch.truncated)
        returns = jax.lax.scan(add, 0.0, (batch.reward, ended), reverse=True)[1]
        advantages = (returns - jnp.mean(returns)) / (jnp.std(returns) + 1e-8)
        adam, given = optax.adam(self.learning_rate), (batch.observation, batch.action, advantages)
        actor, optimiser, metrics = gradient_step(adam, self.loss, state.actor, state.optimiser, *given)
        return State(actor, optimiser), metrics

    def loss(self, actor, observation, action, advantage):
        """Return -A log π(a|s) of one example, without constants."""
        loss = advantage * jnp.sum((action - jnp.tanh(actor(observation))) ** 2) / (2 * self.std**2)
        return loss, {"loss": loss}

    def policy(self, state):
        """Return the deterministic policy as plain layers, which can be exported without JAX."""
        return PolicyNetwork(PolicyParameters((state.actor.layers,)), state.actor.activation, "tanh")
