"""What CSAC's options change: each by numbers worked by hand, and what makes no sense refused."""

from __future__ import annotations

from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from equations import (
    BOTH_WEIGHTS,
    CLOSED_FORM,
    CRITICS,
    LINEAR,
    NOISE,
    ONE,
    PERIODIC,
    POLICY,
    REFERENCE,
    batch_of,
    csac,
    gaussian,
    linear,
    transition,
    update,
)

from csac.algorithms import CSAC
from csac.types import InputError

# As in test_equations: log π = -0.8037095, log π - log π̃ = 0.5993972, KL = 0.4431472, min Q = 1.9242343; the taken
# action 0.5 is tanh 0.5493061 with log π = -0.5·0.5493061² - 0.9189385 - log 0.75 = -0.7821251.


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        # 2 + 0.9 (1.9242343 + 0.2·0.5 - 0.5·0.4431472) and 2 + 0.9 (1.9242343 + 0.2·0.5 - 0.5·0.5)
        ({"target_log_prob_bound": 0.5}, 3.6223946),
        ({"target_log_prob_bound": 0.5, "relative_entropy_estimator": "sampled"}, 3.5968109),
        ({"target_log_prob_bound": 0.3}, 3.6508109),  # 2 + 0.9 (1.9242343 + 0.2·0.3 - 0.5·0.3)
        ({"target_log_prob_bound": 5.0}, 3.6770624),  # as without
        # 2 + 0.9 (1.9242343 + 0.2·0.8037095)
        ({"relative_entropy_form": "actor_only"}, 3.8764787),
        # 2 - 0.5·0.7821251 + 0.9 (1.9242343 + 0.7·0.8037095) and 2 - 0.5·0.5 + 0.9 (1.9242343 + 0.7·0.5)
        ({"relative_entropy_form": "implicit"}, 3.8470854),
        ({"relative_entropy_form": "implicit", "target_log_prob_bound": 0.5}, 3.7968109),
    ],
)
def test_critic_target(options, expected):
    reference = None if options.get("relative_entropy_form") == "implicit" else REFERENCE
    networks = {"actor": POLICY, "reference": reference, "target_critics": CRITICS}
    target = csac(**options).critic_target(transition(), NOISE, weights=BOTH_WEIGHTS, **networks)
    assert float(target) == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"target_log_prob_bound": 0.5}, -1.8634026),  # as without: the bound is the target's
        ({"relative_entropy_form": "actor_only"}, -1.8634026),
        ({"relative_entropy_form": "implicit"}, -2.4868310),  # 0.7 log π - min Q
    ],
)
def test_actor_loss(options, expected):
    reference = None if options.get("relative_entropy_form") == "implicit" else REFERENCE
    networks = {"reference": reference, "critics": CRITICS}
    loss, _ = csac(**options).actor_loss(POLICY, jnp.ones(1), NOISE, weights=BOTH_WEIGHTS, **networks)
    assert float(loss) == pytest.approx(expected, abs=2e-6)


def test_the_implicit_form_keeps_no_second_policy_and_survives_saturated_actions():
    algorithm = CSAC(relative_entropy_form="implicit", target_log_prob_bound=5.0, **LINEAR)
    state = algorithm.init(jax.random.key(0), ONE, 1000)
    assert state.reference is None
    state, metrics = update(algorithm, state, batch_of(transition(action=1.0), transition(action=-1.0)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, metrics)))
    assert "relative_entropy" not in metrics


def test_the_implicit_bonus_belongs_to_the_action_that_was_taken_and_no_termination_masks_it():
    networks = {"actor": POLICY, "reference": None, "target_critics": CRITICS}
    algorithm = csac(relative_entropy_form="implicit")
    target = algorithm.critic_target(transition(terminated=1.0), NOISE, weights=BOTH_WEIGHTS, **networks)
    assert float(target) == pytest.approx(2.0 - 0.5 * 0.7821251, abs=2e-6)


# CVI charges π_k for its distance from π_(k-1), while the actor, already beyond π_k, is charged for its own from π_k:
# KL(N(0, 1) ‖ N(1, 2²)) = 0.4431472 and KL(N(1, 2²) ‖ N(0, 2²)) = 1/8.
EARLIER = gaussian(0.0, 2.0)
EARLIER_CRITIC: dict[str, Any] = {
    "relative_entropy_weight": 0.5,
    "critic_reference": "earlier",
    "reference_period": 4,
    **CLOSED_FORM,
}


@pytest.mark.parametrize(
    ("choice", "step", "of_the_actor", "of_the_critic"),
    [
        ("periodic", 5, 0.4431472, 0.125),
        ("periodic", 8, 0.0, 0.4431472),  # renewed: π_k is the actor, and π_(k-1) what was π_k
        ("algorithm1", 5, 0.0, 0.4431472),
    ],
)
def test_the_critic_s_own_reference(choice, step, of_the_actor, of_the_critic):
    # No entropy weight, critics 0 and target critics 3 everywhere: y = 2 + 0.5 (3 - 0.5 KL), and the loss is 2 y².
    algorithm = CSAC(entropy_weight=0.0, reference_policy=choice, **EARLIER_CRITIC, **LINEAR)
    nothing, three = linear([[0.0], [0.0]], [0.0]), linear([[0.0], [0.0]], [3.0])
    state = algorithm.init(jax.random.key(0), ONE, 1000)._replace(
        actor=POLICY,
        reference=REFERENCE,
        earlier_reference=EARLIER,
        critics=(nothing, nothing),
        target_critics=(three, three),
    )
    _, metrics = update(algorithm, state, batch_of(transition()), step)
    assert float(metrics["relative_entropy"]) == pytest.approx(of_the_actor, abs=1e-6)
    assert float(metrics["critic_loss"]) == pytest.approx(2 * (3.5 - 0.25 * of_the_critic) ** 2, rel=1e-6)


@pytest.mark.parametrize("normalisation", ["none", "batch"])
def test_between_renewals_the_critics_of_two_references_do_not_hear_of_the_actor(normalisation):
    algorithm = CSAC(reference_policy="periodic", critic_normalisation=normalisation, **EARLIER_CRITIC, **LINEAR)
    state = algorithm.init(jax.random.key(0), ONE, 1000)._replace(reference=REFERENCE, earlier_reference=EARLIER)
    batch = batch_of(transition(), transition(observation=-1.0, next_observation=0.5, action=-0.2))

    def learnt(actor, step):
        """The critics and, as Adam's first step is one of signs, the moments of their gradient."""
        after, _ = update(algorithm, state._replace(actor=actor), batch, step)
        return jax.flatten_util.ravel_pytree((after.critics, after.critic_optimiser))[0]

    for step in (5, 7):
        np.testing.assert_array_equal(learnt(POLICY, step), learnt(gaussian(0.5, 0.1), step))
    assert not np.allclose(learnt(POLICY, 8), learnt(gaussian(0.5, 0.1), 8))


def test_updates_keep_the_copy_before_the_last_one():
    algorithm = CSAC(reference_policy="periodic", **(EARLIER_CRITIC | {"reference_period": 2}), **LINEAR)
    state = algorithm.init(jax.random.key(0), ONE, 1000)
    batch, actors = batch_of(transition(), transition(observation=-1.0, action=-0.5)), []
    for step in range(5):
        actors.append(state.actor)
        state, _ = update(algorithm, state, batch, step)
    jax.tree.map(np.testing.assert_array_equal, (state.reference, state.earlier_reference), (actors[4], actors[2]))
    assert not np.allclose(actors[4].layers[0].bias, actors[2].layers[0].bias)


def test_the_next_action_of_two_references_is_that_of_the_stored_policy():
    # Policies so sharp that π_k always takes 0.5 and the actor -0.5; π_k = π_(k-1). The critics are 0, their targets
    # 3 + 2a, and log π is left out: y = 2 + 0.5 (3 + 2·0.5) = 4, where the actor's own action would make it 3.
    stored, actor = gaussian(0.5493061, 1e-6), gaussian(-0.5493061, 1e-6)
    nothing, rising = linear([[0.0], [0.0]], [0.0]), linear([[0.0], [2.0]], [3.0])
    algorithm = CSAC(reference_policy="periodic", entropy_weight=0.0, **EARLIER_CRITIC, **LINEAR)
    state = algorithm.init(jax.random.key(0), ONE, 1000)._replace(
        actor=actor,
        reference=stored,
        earlier_reference=stored,
        critics=(nothing, nothing),
        target_critics=(rising, rising),
    )
    _, metrics = update(algorithm, state, batch_of(transition()), 5)
    assert float(metrics["critic_loss"]) == pytest.approx(2 * 4.0**2, rel=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"relative_entropy_weight": "auto", "reference_policy": "algorithm1"},
            "relative_entropy_weight auto with reference_policy algorithm1 makes no sense: the actor is its own",
        ),
        (
            {"relative_entropy_weight": "auto", "reference_policy": "periodic", "reference_period": 1},
            "the actor is its own reference",
        ),
        ({"relative_entropy_weight": "auto", "relative_entropy_form": "implicit", **PERIODIC}, "there is no reference"),
        ({"critic_reference": "earlier", "relative_entropy_form": "actor_only"}, "the target has none"),
        ({"critic_reference": "earlier", "relative_entropy_form": "implicit"}, "the target has none"),
        ({"critic_reference": "earlier", "reference_policy": "average"}, "no copy replaces another"),
        ({"critic_reference": "earlier", "reference_policy": "previous"}, "no copy replaces another"),
        ({"entropy_weight": "automatic"}, "entropy_weight must be a finite number, or auto, not 'automatic'"),
        ({"entropy_weight": -1}, "entropy_weight must be 0 or more, or auto, not -1"),
    ],
)
def test_what_makes_no_sense_is_refused(options, message):
    with pytest.raises(InputError) as raised:
        CSAC(**options)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_the_default_has_the_state_and_the_metrics_that_it_had():
    state = CSAC(**LINEAR).init(jax.random.key(0), ONE, 1000)
    kept = ("actor", "reference", "critics", "target_critics", "actor_optimiser", "critic_optimiser")
    assert [name for name, value in state._asdict().items() if value is not None] == list(kept)
    _, metrics = update(CSAC(**LINEAR), state, batch_of(transition()))
    assert set(metrics) == {"critic_loss", "q_mean", "actor_loss", "entropy", "relative_entropy"}
