"""The learnt weight of the entropy: where its constraint is active it holds it, where it is not it falls."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import CLOSED_FORM, LINEAR, batch_of, begin, gaussian, linear, transition

from csac.algorithms import CSAC
from csac.algorithms.temperature import temperature_loss


def test_the_weight_rises_where_its_constraint_is_hurt():
    # d/d(log α) [log α · (-2 - (-1))] = -1, and descent goes against it.
    assert float(jax.grad(temperature_loss, has_aux=True)(0.3, -2.0, target=-1.0)[0]) == -1.0


def entropies(target, updates=3000):
    """The entropy and σ of each update of a policy that Q = 3a pulls to the edge of its actions, float64 [update]."""
    algorithm = CSAC(
        entropy_weight="auto",
        relative_entropy_weight=0.0,
        target_entropy=target,
        weight_learning_rate=0.01,
        **CLOSED_FORM,
        **{**LINEAR, "actor_learning_rate": 0.01, "critic_learning_rate": 1e-9, "discount": 0.0},
    )
    batch, critic = batch_of(*[transition()] * 64), linear([[0.0], [3.0]], [0.0])

    def one(state, step):
        key = jax.random.fold_in(jax.random.key(0), step)
        state, metrics = algorithm.update(state._replace(critics=(critic, critic)), batch, key, step)
        return state, (metrics["entropy"], metrics["entropy_weight"])

    state = begin(algorithm)._replace(actor=gaussian(0.0, 0.5))
    _, found = jax.jit(lambda state: jax.lax.scan(one, state, jnp.arange(updates)))(state)
    return [np.asarray(values, np.float64) for values in found]


def test_the_entropy_is_held_at_its_target_where_the_value_pulls_the_policy_together():
    # The best policy, exp(3a/σ) on [-1, 1], has an entropy of 1 + log(σ/3) where σ is small: -1 at σ = 3/e² = 0.41.
    # A tanh-Gaussian is not quite that.
    held, weights = entropies(-1.0)
    assert held[-1000:].mean() == pytest.approx(-1.0, abs=0.03)
    assert weights[-1000:].mean() == pytest.approx(0.41, rel=0.2)


def test_the_weight_falls_where_the_policy_stays_wide_by_itself():
    free, weights = entropies(-100.0)
    assert 1e-9 < weights[-1] < 1e-6
    assert -100.0 < free[-1] < -1.0
