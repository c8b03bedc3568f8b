"""CSAC's and SAC's equations against numbers worked by hand, and the order of the steps within one update."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import (
    CLOSED_FORM,
    CRITICS,
    LINEAR,
    NOISE,
    ONE,
    POLICY,
    REFERENCE,
    REFERENCES,
    assert_equal,
    batch_of,
    begin,
    csac,
    differ,
    gaussian,
    linear,
    share_no_buffer,
    transition,
    update,
)

from csac.algorithms import CSAC, SAC, TD3
from csac.algorithms.critics import critic_loss
from csac.algorithms.distributions import kl, policy_at
from csac.algorithms.networks import MLP, gradient_step, make_optimiser, polyak
from csac.types import InputError, Spec

SAMPLED = {"relative_entropy_estimator": "sampled"}
NOTHING = linear([[0.0], [0.0]], [0.0])


@pytest.mark.parametrize(
    ("options", "terminated", "truncated", "expected"),
    [
        # 2 + 0.9 (1.9242343 + 0.2·0.8037095 - 0.5·0.5993972) = 2 + 0.9·1.7852776
        (SAMPLED, 0.0, 0.0, 3.6067499),
        # 2 + 0.9 (1.9242343 + 0.2·0.8037095 - 0.5·0.4431472) = 2 + 0.9·1.8634026
        (CLOSED_FORM, 0.0, 0.0, 3.6770624),
        (SAMPLED, 1.0, 0.0, 2.0),  # nothing follows
        (SAMPLED, 1.0, 1.0, 2.0),
        (SAMPLED, 0.0, 1.0, 3.6067499),  # the environment was only stopped: the target looks ahead
        # 2 + 0.9 (1.9242343 + 0.2·0.5 - 0.5·0.4431472) and 2 + 0.9 (1.9242343 + 0.2·0.5 - 0.5·0.5)
        ({"target_log_prob_bound": 0.5}, 0.0, 0.0, 3.6223946),
        ({"target_log_prob_bound": 0.5, **SAMPLED}, 0.0, 0.0, 3.5968109),
        ({"target_log_prob_bound": 5.0}, 0.0, 0.0, 3.6770624),  # as without
        ({"relative_entropy_form": "actor_only"}, 0.0, 0.0, 3.8764787),  # 2 + 0.9 (1.9242343 + 0.2·0.8037095)
    ],
)
def test_csac_critic_target(options, terminated, truncated, expected):
    step = transition(terminated=terminated, truncated=truncated)
    networks = {"actor": POLICY, "reference": REFERENCE, "targets": CRITICS}
    target = csac(**options).critic_target(step, NOISE, sigma=0.2, **networks)
    assert float(target) == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        # 0.7 log π - 0.5 log π̃ - min Q = -0.5625967 + 0.7015534 - 1.9242343
        (SAMPLED, -1.7852776),
        # 0.2 log π + 0.5 KL - min Q = -0.1607419 + 0.2215736 - 1.9242343
        (CLOSED_FORM, -1.8634026),
        ({"target_log_prob_bound": 0.5}, -1.8634026),  # the bound is the target's
        ({"relative_entropy_form": "actor_only"}, -1.8634026),
    ],
)
def test_csac_actor_loss(options, expected):
    networks = {"reference": REFERENCE, "critics": CRITICS}
    loss, metrics = csac(**options).actor_loss(POLICY, jnp.ones(1), NOISE, sigma=0.2, **networks)
    assert float(loss) == pytest.approx(expected, abs=2e-6)
    assert float(metrics["entropy"]) == pytest.approx(0.8037095, abs=1e-6)


def test_a_relative_entropy_beyond_its_bound_no_longer_pulls_at_the_actor():
    def gradient(shift: float, weight: float) -> tuple[float, float]:
        def loss(mean: Any) -> Any:
            networks = {"reference": gaussian(0.5 - shift, 0.1), "critics": CRITICS}
            actor, algorithm = gaussian(mean, 0.1), csac(relative_entropy_weight=weight, relative_entropy_bound=100)
            return algorithm.actor_loss(actor, jnp.ones(1), NOISE, sigma=0.2, **networks)

        slope, metrics = jax.grad(loss, has_aux=True)(jnp.float32(0.5))
        return float(slope), float(metrics["relative_entropy"])

    plain = gradient(1.0, 0.0)[0]
    assert gradient(1.0, 0.5) == pytest.approx((plain + 0.5 * 1.0 / 0.1**2, 50.0), rel=1e-4)
    assert gradient(2.0, 0.5) == pytest.approx((plain, 100.0), rel=1e-4)  # 200 nats


@pytest.mark.parametrize(("terminated", "truncated", "expected"), [(0, 0, 3.8764787), (1, 0, 2.0), (0, 1, 3.8764787)])
def test_sac_critic_target(terminated, truncated, expected):
    # 2 + 0.9 (1.9242343 + 0.2·0.8037095) = 2 + 0.9·2.0849762
    step, temperature = transition(terminated=terminated, truncated=truncated), jnp.float32(0.2)
    target = SAC(discount=0.9).critic_target(step, NOISE, actor=POLICY, targets=CRITICS, temperature=temperature)
    assert float(target) == pytest.approx(expected, abs=2e-6)


def test_sac_actor_loss():
    loss, _ = SAC().actor_loss(POLICY, jnp.array([1.0]), NOISE, critics=CRITICS, temperature=jnp.float32(0.2))
    assert float(loss) == pytest.approx(-2.0849762, abs=2e-6)


def test_critic_loss_sums_both_critics():
    # Q₁(1, 0.5) = 2 and Q₂(1, 0.5) = 2.5 with target 3: 1² + 0.5²
    loss, metrics = critic_loss(CRITICS, transition(), jnp.float32(3.0))
    assert (float(loss), float(metrics["q_mean"])) == pytest.approx((1.25, 2.25))


def test_polyak():
    # 1 + 0.25 (5 - 1) = 2 and 2 + 0.25 (-2 - 2) = 1
    assert polyak({"a": 1.0, "b": 2.0}, {"a": 5.0, "b": -2.0}, 0.25) == {"a": 2.0, "b": 1.0}


def test_gradient_is_clipped_by_its_global_norm():
    # Adam's first moment after one step is 0.1 g, so it shows g: (30, 40) has norm 50 and becomes (3, 4).
    optimiser, parameters = make_optimiser(0.1, max_gradient_norm=5.0), jnp.zeros(2)
    examples = jnp.array([[30.0, 40.0]])
    _, state, _ = gradient_step(optimiser, lambda p, x: (p @ x, {}), parameters, optimiser.init(parameters), examples)
    first_moment = next(leaf for leaf in jax.tree.leaves(state) if leaf.shape == (2,))
    np.testing.assert_allclose(first_moment, [0.3, 0.4], rtol=1e-6)


NO_ENTROPY = [
    CSAC(entropy_weight=0.0, relative_entropy_weight=0.0, **LINEAR),
    SAC(entropy_weight=0.0, **LINEAR),
]


@pytest.mark.parametrize("algorithm", NO_ENTROPY, ids=lambda algorithm: algorithm.name)
def test_the_actor_descends_against_the_new_critics_and_targets_move_last(algorithm):
    # Target critics say -20 everywhere, so y = 0 + 0.5·(-20) = -10. Both critics are Q = 0.01 a = 0.01: the loss is
    # 2·10.01² and each of their parameters, having a positive gradient, goes down by the learning rate in Adam's first
    # step. The slope of Q in the action turns from 0.01 to -0.09: the actor goes down if it sees the new critics, and
    # up if it sees the old ones. Targets: halfway from (0, 0, -20) to the new (-0.1, -0.09, -0.1).
    critic, target_critic = linear([[0.0], [0.01]], [0.0]), linear([[0.0], [0.0]], [-20.0])
    state = begin(algorithm)._replace(
        actor=gaussian(0.0, 1.0), critics=(critic, critic), target_critics=(target_critic, target_critic)
    )
    state, metrics = update(algorithm, state, batch_of(transition(action=1.0, reward=0.0)))
    assert float(metrics["critic_loss"]) == pytest.approx(200.4002, rel=1e-6)
    assert float(metrics["q_mean"]) == pytest.approx(0.01)
    own = {"relative_entropy"} if isinstance(algorithm, CSAC) else {"temperature"}
    assert set(metrics) == {"critic_loss", "q_mean", "actor_loss", "entropy"} | own
    for new, target in zip(state.critics, state.target_critics, strict=True):
        np.testing.assert_allclose(new.layers[0].weight, [[-0.1], [-0.09]], atol=1e-6)
        np.testing.assert_allclose(target.layers[0].weight, [[-0.05], [-0.045]], atol=1e-6)
        np.testing.assert_allclose(target.layers[0].bias, [-10.05], atol=1e-5)
    assert float(state.actor.layers[0].bias[0]) == pytest.approx(-0.1, abs=1e-5)


def test_a_fixed_temperature_stays_and_its_state_is_finite():
    algorithm = SAC(entropy_weight=0.0, **LINEAR)
    state = begin(algorithm)
    after, metrics = update(algorithm, state, batch_of(transition()))
    assert_equal(after.temperature, state.temperature)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((after, metrics)))  # else the loop stops the seed
    assert float(metrics["temperature"]) == pytest.approx(0.0)
    _, metrics = update(SAC(entropy_weight=0.5, **LINEAR), state, batch_of(transition()))  # as in a fork
    assert float(metrics["temperature"]) == pytest.approx(0.5)


@pytest.mark.parametrize(("algorithm", "name"), [(CSAC, "entropy_weight"), (SAC, "temperature")])
def test_a_learnt_weight_has_an_adam_of_its_own(algorithm, name):
    """Neither the networks' momentum nor their bound on gradients is its: the first step is the rate, by any slack."""
    own: dict[str, Any] = {"adam_momentum": 0.5, "max_gradient_norm": 1e-12, "weight_learning_rate": 0.1}
    learner = algorithm(entropy_weight="auto", target_entropy=100.0, initial_entropy_weight=0.5, **own, **LINEAR)
    state, metrics = update(learner, begin(learner), batch_of(transition()))
    assert float(metrics[name]) == pytest.approx(0.5)  # as it was used
    assert -11.0 < float(state.temperature.optimiser[0].mu) < -9.0  # a tenth of the slack of about -100
    assert float(state.temperature.log_weight) == pytest.approx(math.log(0.5) + 0.1, abs=1e-5)
    if algorithm is SAC:  # a weight that was fixed at zero can rise
        state, _ = update(learner, begin(replace(learner, entropy_weight=0.0)), batch_of(transition()))
        assert float(state.temperature.log_weight) == pytest.approx(math.log(1e-8) + 0.1, abs=1e-5)


@pytest.mark.parametrize("algorithm", [CSAC, SAC], ids=lambda algorithm: algorithm.name)
def test_the_target_entropy_is_minus_the_number_of_action_dimensions(algorithm):
    # Near u = 0 the tanh changes little: the entropy of three dimensions is about 3 (1.4189385 - 2.2) = -2.3. The
    # target is -3: the weight falls, where the target of one or two dimensions would raise it.
    learner = algorithm(entropy_weight="auto", weight_learning_rate=0.1, **LINEAR)
    state = begin(learner, Spec(1, 3))._replace(actor=linear([[0.0] * 6], [0.0] * 3 + [-2.2] * 3))
    batch = batch_of(*[transition()._replace(action=np.zeros(3, np.float32))] * 1000)
    state, metrics = update(learner, state, batch)
    assert float(metrics["entropy"]) == pytest.approx(-2.3, abs=0.2)
    assert float(state.temperature.log_weight) == pytest.approx(-0.1, abs=1e-4)


@jax.jit
def mean_kl(actor: MLP, reference: MLP, observations: jax.Array) -> jax.Array:
    return jnp.mean(jax.vmap(lambda x: kl(policy_at(actor, x), policy_at(reference, x)))(observations))


REFERRING = {
    choice: CSAC(entropy_weight=0.0, relative_entropy_weight=0.5, **options, **CLOSED_FORM, **LINEAR)
    for choice, options in REFERENCES.items()
}


@pytest.mark.parametrize("choice", REFERENCES)
def test_reference_policy_over_time(choice):
    """The KL that an update reports tells which reference it used. A_k is the actor before update k."""
    algorithm = REFERRING[choice]
    batch = batch_of(*(transition(observation=x, action=x / 3) for x in (-2.0, 0.5, 1.0)))
    state, actors, reported = begin(algorithm), [], []
    for k in range(7):
        actors.append(state.actor)
        state, metrics = update(algorithm, state, batch, k)
        reported.append(float(metrics["relative_entropy"]))

    averages = [actors[0]]
    for actor in actors[:-1]:  # R_0 = A_0, R_(k+1) = R_k + 0.25 (A_k - R_k)
        averages.append(jax.tree.map(lambda average, a: 0.75 * average + 0.25 * a, averages[-1], actor))
    references = {
        "the actor itself": actors,  # A_k
        "one update ago": [actors[0], *actors[:-1]],  # A_(k-1), but for the last bits
        "periodic": [actors[k - k % 3] for k in range(7)],
        "average": averages,
    }[choice]
    pairs = zip(actors, references, strict=True)
    expected = np.array([mean_kl(actor, reference, batch.observation) for actor, reference in pairs])
    np.testing.assert_allclose(reported, expected, atol=2e-6)
    assert max(reported) == 0 if choice == "the actor itself" else max(reported) > 1e-3


@pytest.mark.parametrize(
    ("choice", "step", "relative_entropy"),
    [
        ("the actor itself", 5, 0.0),
        ("one update ago", 5, 0.4431472),
        ("average", 5, 0.4431472),
        ("periodic", 5, 0.4431472),
        ("periodic", 6, 0.0),
    ],
)
def test_the_critic_target_of_an_update_uses_the_reference_policy(choice, step, relative_entropy):
    # No entropy weight, critics 0 and target critics 3 everywhere: y = 2 + 0.5 (3 - 0.5 KL), and the loss is 2 y².
    algorithm, three = REFERRING[choice], linear([[0.0], [0.0]], [3.0])
    state = begin(algorithm)._replace(
        actor=POLICY, reference=REFERENCE, critics=(NOTHING, NOTHING), target_critics=(three, three)
    )
    _, metrics = update(algorithm, state, batch_of(*[transition()] * 3), step)
    assert float(metrics["critic_loss"]) == pytest.approx(2 * (3.5 - 0.25 * relative_entropy) ** 2, rel=1e-6)


@pytest.mark.parametrize("algorithm", [CSAC(**LINEAR), SAC(**LINEAR)], ids=lambda algorithm: algorithm.name)
def test_actions_are_the_tanh_of_the_mean_or_of_a_sample(algorithm):
    state = begin(algorithm)._replace(actor=gaussian(0.5, 0.1))
    act = jax.vmap(algorithm.act, in_axes=(None, None, 0, None))
    keys = jax.random.split(jax.random.key(1), 4000)
    np.testing.assert_allclose(act(state, jnp.ones(1), keys, False), math.tanh(0.5), rtol=1e-6)
    before_tanh = np.arctanh(act(state, jnp.ones(1), keys, True))
    assert before_tanh.mean() == pytest.approx(0.5, abs=0.01)  # standard error 0.0016
    assert before_tanh.std() == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize("algorithm", [CSAC, SAC, TD3], ids=lambda one: one.name)
def test_the_first_state_has_copies_for_targets_and_reference_two_critics_and_buffers_of_its_own(algorithm):
    state = algorithm(normalise_observations=True, **LINEAR).init(jax.random.key(0), ONE, 1000)
    assert_equal(state.critics, state.target_critics)
    assert_equal(state.actor, getattr(state, "reference", getattr(state, "target_actor", state.actor)))
    assert differ(*state.critics)
    assert share_no_buffer(state)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"relative_entropy_weight": "auto"}, "relative_entropy_weight"),
        ({"relative_entropy_form": "implicit"}, "relative_entropy_form"),
        ({"critic_reference": "earlier"}, "critic_reference"),
    ],
)
def test_what_makes_no_sense_is_refused(options, name):
    with pytest.raises(InputError, match=name):
        CSAC(**options)


def test_the_default_keeps_no_state_for_options_that_are_off():
    state = begin(CSAC(**LINEAR))
    kept = ("actor", "reference", "critics", "target_critics", "actor_optimiser", "critic_optimiser")
    assert [name for name, value in state._asdict().items() if value is not None] == list(kept)
