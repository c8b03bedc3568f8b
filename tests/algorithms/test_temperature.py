"""The learnt weight of the entropy: how its loss pulls, and that it holds the entropy at its target."""

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


def test_learnt_weight_holds_the_entropy_at_its_target():
    # The best policy where Q = 3a, exp(3a/σ) on [-1, 1], has an entropy of 1 + log(σ/3) where σ is small: -1 at
    # σ = 3/e² = 0.41. A tanh-Gaussian is not quite that.
    algorithm = CSAC(
        entropy_weight="auto",
        relative_entropy_weight=0.0,
        target_entropy=-1.0,
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
    _, found = jax.jit(lambda state: jax.lax.scan(one, state, jnp.arange(3000)))(state)
    held, weights = (np.asarray(values, np.float64)[-1000:].mean() for values in found)
    assert held == pytest.approx(-1.0, abs=0.03)
    assert weights == pytest.approx(0.41, rel=0.2)
