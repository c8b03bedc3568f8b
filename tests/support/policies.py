"""Policies that nothing was learnt by: contracts and networks of any shape."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.types import Activation, Head, Layer, Normaliser, PolicyNetwork, PolicyParameters, Spec

Parts = tuple[tuple[str | None, tuple[int, ...]], ...]

DICT_PARTS = (("achieved", (2,)), ("position", (1, 2)), ("speed", ()))


def contract(
    parts=((None, (2,)),),
    action_shape=(1,),
    low=-1.0,
    high=1.0,
    activation: Activation = "relu",
    head: Head = "tanh_gaussian",
) -> Contract:
    size = math.prod(action_shape)
    least, most = (np.full(size, bound, np.float32) for bound in (low, high))
    return Contract("Task-v0", "csac", activation, head, parts, action_shape, least, most)


def random_layers(*sizes: int, seed: int = 0) -> tuple[Layer, ...]:
    generator = np.random.default_rng(seed)
    return tuple(
        Layer(generator.normal(size=(inputs, outputs)), generator.normal(size=outputs))
        for inputs, outputs in pairwise(sizes)
    )


def random_network(spec: Spec, width: int = 8, seed: int = 0) -> PolicyNetwork:
    layers = random_layers(spec.observation_size, width, width, 2 * spec.action_size, seed=seed)
    return PolicyNetwork(PolicyParameters((layers,)))


def random_policy(contract: Contract, seed: int = 0, step: int | None = None) -> Policy:
    return Policy(random_network(contract.spec, seed=seed), contract, step=step)


ALGORITHMS = ("csac", "sac", "td3", "sd3", "ppo")


def algorithm_policy(algorithm: str, parts: Parts = ((None, (5,)),), action_shape: tuple[int, ...] = (3,)) -> Policy:
    """A random policy in the form that an algorithm gives its own, on a task with bounds that are not symmetric."""
    heads: dict[str, Head] = {"csac": "tanh_gaussian", "sac": "tanh_gaussian", "ppo": "clipped_gaussian"}
    head = heads.get(algorithm, "tanh")
    agreement = contract(parts, action_shape, -0.5, 2.0, "tanh" if algorithm == "ppo" else "relu", head)
    observation_size, action_size = agreement.spec[:2]
    outputs = 2 * action_size if head == "tanh_gaussian" else action_size

    def network(*sizes: int, seed: int = 0) -> tuple[Layer, ...]:
        layers = random_layers(*sizes, seed=seed)
        return tuple(Layer(0.7 * layer.weight / math.sqrt(len(layer.weight)), 0.3 * layer.bias) for layer in layers)

    # Widths that are whole blocks of 16, and that are not.
    actors = tuple(network(observation_size, 32, 21, outputs, seed=seed) for seed in range(1 + (algorithm == "sd3")))
    parameters = PolicyParameters(actors)
    if algorithm == "sd3":
        critics = tuple(network(observation_size + action_size, 19, 16, 1, seed=seed) for seed in (2, 3))
        parameters = parameters._replace(critics=critics)
    if algorithm == "ppo":
        generator = np.random.default_rng(4)
        mean, std = generator.normal(size=observation_size), generator.uniform(0.5, 2.0, observation_size)
        parameters = parameters._replace(
            normaliser=Normaliser(mean, std, np.array(10.0)), log_std=generator.normal(-1.0, 0.5, action_size)
        )
    return Policy(
        PolicyNetwork(parameters, agreement.activation, agreement.head), replace(agreement, algorithm=algorithm)
    )


def with_hidden(policy: Policy, activation: Activation, critic_activation: Activation) -> Policy:
    """The policy with these activations, and with layer norm in each hidden layer of its actors and critics."""
    generator = np.random.default_rng(7)

    def normed(layers: tuple[Layer, ...]) -> tuple[Layer, ...]:
        drawn = [generator.uniform(0.5, 1.5, (2, *layer.bias.shape)) for layer in layers[:-1]]
        hidden = (layer._replace(scale=x[0], shift=x[1] - 1) for layer, x in zip(layers[:-1], drawn, strict=True))
        return *hidden, layers[-1]

    given = policy.network.parameters
    parameters = given._replace(actors=(*map(normed, given.actors),), critics=(*map(normed, given.critics),))
    kinds: dict[str, Any] = {"activation": activation, "critic_activation": critic_activation}
    network = policy.network._replace(parameters=parameters, **kinds)
    return Policy(network, replace(policy.contract, **kinds))
