"""Policies that nothing was learnt by: contracts and networks of any shape."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from csac.deploy.contract import Activation, Contract, Head
from csac.deploy.policy import Policy
from csac.types import Layer, PolicyNetwork, PolicyParameters, Spec

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
    bounds = [np.full(size, bound, np.float32) for bound in (low, high)]
    return Contract("Task-v0", "csac", activation, head, parts, action_shape, *bounds)


def random_layers(*sizes: int, seed: int = 0) -> tuple[Layer, ...]:
    generator = np.random.default_rng(seed)
    return tuple(
        Layer(generator.normal(size=(inputs, outputs)), generator.normal(size=outputs))
        for inputs, outputs in pairwise(sizes)
    )


def random_network(spec: Spec, width: int = 8, seed: int = 0) -> PolicyNetwork:
    layers = random_layers(spec.observation_size, width, width, 2 * spec.action_size, seed=seed)
    return PolicyNetwork(PolicyParameters((layers,)))


def random_policy(contract: Contract, seed: int = 0) -> Policy:
    return Policy(random_network(contract.spec, seed=seed), contract)
