"""What a run has learnt and remembers is the same from Python as in training."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import IdEncoded
from resuming import ADAPTIVE, ROLLOUT, SMALL, run

import csac
from csac import InputError
from csac.algorithms import SAC, SD3
from csac.algorithms.networks import BATCH
from csac.algorithms.normalisation import normalised_pass
from csac.algorithms.statistics import normalise
from csac.seeds import training_seed

STEPS = 200


@pytest.fixture(scope="module")
def sac(tmp_path_factory):
    """A run of SAC whose replay keeps the last 150 transitions."""
    return run(tmp_path_factory.mktemp("sac") / "set", SAC(**SMALL), STEPS, task=IdEncoded, evaluation_interval=STEPS)


def test_a_replay_is_arrays_in_the_order_of_the_steps(sac):
    replay = csac.load_checkpoint(sac).replay()
    assert {name: array.shape for name, array in replay.items()} == {
        "observations": (150, 4),
        "actions": (150, 1),
        "rewards": (150,),
        "next_observations": (150, 4),
        "terminated": (150,),
        "truncated": (150,),
    }
    # Episode e has 2 + e % 3 steps; an observation says [reset seed, episode, step, last action], the reward the step.
    lengths = [2 + e % 3 for e in range(100)]
    story = [(e, step) for e, length in enumerate(lengths) for step in range(1, length + 1)][STEPS - 150 : STEPS]
    for number, (episode, step) in enumerate(story):
        after = replay["next_observations"][number]
        assert after[1:3].tolist() == [episode, step]
        assert after[0] == training_seed(0, episode) % 65536
        assert after[3] == pytest.approx(replay["actions"][number, 0], abs=1e-6)
        assert replay["rewards"][number] == step
        is_last = step == lengths[episode]
        assert replay["terminated"][number] == (is_last and episode % 3 != 1)
        assert replay["truncated"][number] == (is_last and episode % 3 != 0)


def relu_network(layers, inputs):
    for layer in layers[:-1]:
        inputs = np.maximum(inputs @ layer.weight + layer.bias, 0)
    return (inputs @ layers[-1].weight + layers[-1].bias)[..., 0]


def test_q_values_are_what_the_critics_of_the_state_say(sac):
    learnt = csac.load_checkpoint(sac)
    assert (learnt.step, learnt.algorithm) == (STEPS, SAC(**SMALL))
    assert type(learnt.state).__name__ == "State"
    observations, actions = np.arange(12, dtype=np.float32).reshape(3, 4), np.array([[-0.5], [0.0], [0.7]])
    inputs = np.concatenate([observations, actions], axis=1)
    expected = np.stack([relu_network(critic.layers, inputs) for critic in learnt.state.critics], axis=1)
    np.testing.assert_allclose(learnt.q_values(observations, actions), expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(learnt.q_values(observations[0], actions[0]), expected[0], rtol=1e-4, atol=1e-5)
    with pytest.raises(InputError, match="actions has shape"):
        learnt.q_values(observations, actions[:1])
    policy = csac.load(sac)
    for left, layer in zip(policy.network.parameters.actors[0], learnt.state.actor.layers, strict=True):
        np.testing.assert_array_equal(left.weight, layer.weight)
        np.testing.assert_array_equal(left.bias, layer.bias)


@pytest.mark.slow
def test_critics_that_are_normalised_over_batches_are_asked_by_the_replay(tmp_path):
    learnt = csac.load_checkpoint(run(tmp_path / "set", ADAPTIVE, 100, task=IdEncoded))
    replay, state = learnt.replay(), learnt.state
    following = csac.load(tmp_path / "set").act(replay["next_observations"])

    def asked(observation, action, next_observation, next_action):
        seen = [normalise(state.observation_statistics, one) for one in (observation, next_observation)]
        pairs = [jnp.concatenate(pair) for pair in zip(seen, (action, next_action), strict=True)]
        return normalised_pass(state.critics[0], pairs).outputs[0][0]

    given = replay["observations"], replay["actions"], replay["next_observations"], following
    expected = jax.vmap(asked, axis_name=BATCH)(*given)
    found = learnt.q_values(replay["observations"], replay["actions"])[:, 0]
    returns, ended = [0.0], replay["terminated"] | replay["truncated"]
    for i, reward in enumerate(replay["rewards"]):
        returns.append(reward + ADAPTIVE.discount * returns[-1] * (i == 0 or not ended[i - 1]))
    np.testing.assert_allclose(found, np.std(returns[1:]) * expected, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_the_pairs_of_sd3_have_a_critic_each_and_ppo_has_none(tmp_path):
    learnt = csac.load_checkpoint(run(tmp_path / "sd3", SD3(noise_samples=2, **SMALL), 60, task=IdEncoded))
    assert learnt.q_values(np.zeros((5, 4)), np.zeros((5, 1))).shape == (5, 2)
    learnt = csac.load_checkpoint(run(tmp_path / "ppo", ROLLOUT, 64, task=IdEncoded))
    assert len(learnt.replay()["rewards"]) == 64
    with pytest.raises(InputError, match="ppo has no critics"):
        learnt.q_values(np.zeros(4), np.zeros(1))


def test_a_checkpoint_that_is_not_there_is_one_line(sac):
    assert csac.load_checkpoint(sac, step=120).step == 120
    cases: list[tuple[dict[str, Any], str]] = [({"step": 60}, "60"), ({"seed": 5}, "5"), ({"step": "last"}, "step")]
    for given, name in cases:
        with pytest.raises(InputError, match=name):
            csac.load_checkpoint(sac, **given)
