"""Activations and layer norm, by hand and in every algorithm."""

from __future__ import annotations

from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import SPEC, begin, transitions, update

from csac.algorithms import CSAC, PPO, SAC, SD3, TD3
from csac.algorithms.networks import MLP, make_mlp
from csac.algorithms.normalisation import fold, normalised_pass
from csac.training.train import train
from csac.types import Activation, InputError, Layer, PolicyNetwork, PolicyParameters

# At -1 and 2: e⁻¹ - 1; x / (1 + e⁻ˣ); ½ x (1 + tanh(√(2/π) (x + 0.044715 x³))).
KNOWN = {
    "relu": (0.0, 2.0),
    "tanh": (-0.7615942, 0.9640276),
    "elu": (-0.6321206, 2.0),
    "silu": (-0.2689414, 1.7615942),
    "gelu": (-0.1588080, 1.9545977),
}
IDENTITY = Layer(jnp.eye(2), jnp.zeros(2))
TINY: dict[str, Any] = {"actor_hidden_sizes": (4,), "critic_hidden_sizes": (4,)}


@pytest.mark.parametrize("activation", get_args(Activation))
def test_activations_by_hand(activation):
    outputs = MLP((IDENTITY, IDENTITY), activation)(jnp.array([-1.0, 2.0]))
    assert outputs.tolist() == pytest.approx(KNOWN[activation], abs=1e-6)


def test_layer_norm_by_hand():
    # Of (1, 3) the mean is 2 and the variance 1: ±1/√1.00001, scaled and shifted, then the ReLU.
    normed = Layer(jnp.eye(2), jnp.array([1.0, 3.0]), jnp.array([2.0, 3.0]), jnp.array([0.5, -1.0]))
    outputs = MLP((normed, IDENTITY))(jnp.zeros(2))
    assert outputs.tolist() == pytest.approx([0.0, 3.0 / 1.00001**0.5 - 1.0])


def networks_of(state: Any) -> tuple[MLP, MLP]:
    """An actor and a critic of an algorithm's state."""
    state = getattr(state, "parameters", getattr(state, "first", state))
    return state.actor, state.critics[1] if hasattr(state, "critics") else state.critic


@pytest.mark.parametrize("algorithm", [SAC, SD3, PPO], ids=lambda algorithm: algorithm.name)
def test_networks_have_the_chosen_activations_and_layer_norm(algorithm):
    sizes: dict[str, Any] = {"hidden_sizes": (4,)} if algorithm is PPO else TINY
    learner = algorithm(activation="silu", actor_activation="elu", critic_layer_norm=True, **sizes)
    networks = networks_of(state := begin(learner, SPEC))
    assert tuple(network.activation for network in networks) == ("elu", "silu")
    assert tuple(network.layers[0].scale is not None for network in networks) == (False, True)
    assert all(network.layers[-1].scale is None for network in networks)
    policy = learner.policy(state)
    assert policy.activation == "elu"
    assert policy.critic_activation == ("silu" if algorithm is SD3 else "relu")


def test_layer_norm_begins_plain_and_batch_normalisation_folds_into_it():
    state = begin(SAC(activation="gelu", layer_norm=True, **TINY), SPEC)
    assert [network.activation for network in networks_of(state)] == ["gelu", "gelu"]
    assert (state.actor.layers[0].scale.tolist(), state.actor.layers[0].shift.tolist()) == ([1.0] * 4, [0.0] * 4)
    critic, _ = state.critics
    inputs = jnp.asarray(np.random.default_rng(0).normal(size=(6, 5)), jnp.float32)
    passed = jax.jit(jax.vmap(lambda one: normalised_pass(critic, [one]), axis_name="batch"))(inputs)
    folded = fold(critic, jax.tree.map(lambda leaf: leaf[0], passed.moments))
    np.testing.assert_allclose(jax.vmap(folded)(inputs), passed.outputs[0], rtol=1e-5, atol=1e-5)


class Halved(eqx.Module):
    """What an MLP gives, halved: no MLP, but a function that one can be."""

    inner: MLP
    name: Any = "halved"

    def __call__(self, inputs):
        return self.inner(inputs) / 2


class OneName(Halved):
    name: Any = eqx.field(static=True, default="halved")


class Pair(OneName):
    def __call__(self, inputs):
        return jnp.repeat(self.inner(inputs), 2)


def with_networks(kind: Any, actor: Any = None, critic: Any = None, **methods: Any) -> Any:
    """Return an algorithm of small networks, inside these modules where they are given."""

    def make_actor(self, key, spec, outputs):
        return actor(make_mlp(key, spec.observation_size, (4,), outputs))

    def make_critic(self, key, spec):
        return critic(make_mlp(key, spec.observation_size + spec.action_size, (4,), 1))

    own = {"make_actor": make_actor if actor else None, "make_critic": make_critic if critic else None, **methods}
    return type("Own", (kind,), {name: method for name, method in own.items() if method})


@pytest.mark.parametrize("kind", [CSAC, TD3])
def test_a_critic_of_another_kind_learns(kind):
    learner = with_networks(kind, critic=OneName)(**TINY)
    before = begin(learner, SPEC)
    after, _ = update(learner, before, transitions(4))
    assert type(after.critics[0]) is OneName
    assert not np.array_equal(after.critics[0].inner.layers[0].weight, before.critics[0].inner.layers[0].weight)
    assert len(learner.policy(after).parameters.actors) == 1


def test_an_actor_of_another_kind_leaves_by_the_layers_that_it_gives():
    def policy(self, state):
        *hidden, last = state.actor.inner.layers
        layers = (*hidden, Layer(last.weight / 2, last.bias / 2))
        return PolicyNetwork(PolicyParameters((layers,)), "relu", "tanh")

    learner = with_networks(TD3, actor=OneName, policy=policy)(**TINY)
    after, _ = update(learner, begin(learner, SPEC), transitions(4))
    observation = jnp.array([0.5, -1.0, 2.0])[: SPEC.observation_size]
    (layers,) = learner.policy(after).parameters.actors
    expected = learner.act(after, observation, jax.random.key(0), explore=False)
    np.testing.assert_allclose(jnp.tanh(MLP(layers)(observation)), expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("learner", "message"),
    [
        (with_networks(SAC, critic=Halved)(**TINY), "Halved has 'halved', which cannot be learnt"),
        (with_networks(SAC, critic=Pair)(**TINY), r"Pair returns an array of shape \(2,\), not \(1,\)"),
        (
            with_networks(SD3, critic=lambda _: eqx.nn.Linear(9, 1, key=jax.random.key(0)))(**TINY),
            "Linear cannot be called with 4 ",
        ),
        (with_networks(SAC, actor=OneName)(**TINY), "OneName is no MLP, but policies are exported as plain layers"),
        (with_networks(SD3, critic=OneName)(**TINY), "OneName is no MLP"),
        (
            with_networks(CSAC, critic=OneName)(critic_normalisation="batch", **TINY),
            "batch is for MLPs, not for OneName",
        ),
    ],
)
def test_networks_that_cannot_be_used_are_told_before_a_run_begins(learner, message, tmp_path):
    with pytest.raises(InputError, match=message):
        train(learner, "Pendulum-v1", steps=100, directory=tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()
