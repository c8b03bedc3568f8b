"""What is measured along a run: parts of the gradient, and what a critic ought to have said."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import (
    CLOSED_FORM,
    CRITICS,
    LINEAR,
    ONE,
    POLICY,
    REFERENCE,
    batch_of,
    gaussian,
    linear,
    transition,
    update,
)
from probes import Endless, Result

from csac.algorithms import CSAC
from csac.algorithms.distributions import kl, policy_at
from csac.tasks.seeds import SeedEnvironments

MECHANISM = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[1] / "results" / "reference" / "mechanism.py")))


def rollout(reward, terminated, ended, next_q_value, next_charge, q_value):
    n = len(reward)
    given = (np.zeros((n, 1)), reward, terminated, ended, q_value, next_q_value, np.zeros(n), next_charge)
    return MECHANISM.Rollout(*map(np.asarray, given))


def test_what_the_critic_ought_to_have_said():
    # γ = 0.5. Step 2 terminates: 3. Step 1: 2 + 0.5 (3 - 0.4) = 3.3. Step 0: 1 + 0.5 (3.3 - 0.2) = 2.55. Step 3 is the
    # last: 4 + 0.5 (10 - 2) = 8.
    given = rollout([1, 2, 3, 4], [0, 0, 1, 0], [0, 0, 1, 0], [9, 9, 9, 10], [0.2, 0.4, 9, 2], [3, 3, 3, 3])
    returns, ahead = MECHANISM.returns_of(given, 0.5)
    np.testing.assert_allclose(returns, [2.55, 3.3, 3.0, 8.0])
    np.testing.assert_array_equal(ahead, [np.inf, np.inf, np.inf, 1])
    # Steps 0 to 2 are seen to their end: the critic's 3 is 0.45, -0.3 and 0 too high.
    error = MECHANISM.critic_error(given, 0.5)
    assert error == pytest.approx({"monte_carlo": 2.95, "critic_bias": 0.05, "critic_rms": np.sqrt(0.2925 / 3)})


def test_a_time_limit_is_no_end():
    given = rollout([1, 2], [0, 0], [1, 0], [6, 4], [2, 0], [0, 0])  # 1 + 0.5 (6 - 2) and 2 + 0.5·4
    np.testing.assert_allclose(MECHANISM.returns_of(given, 0.5)[0], [3.0, 4.0])


@pytest.mark.parametrize("estimator", ["closed_form", "sampled"])
def test_the_parts_are_those_of_the_actor_s_gradient(estimator):
    # KL(N(μ, s²) ‖ N(1, 2²)) has the slope (μ - 1)/4 = -0.25 in μ and s²/4 - 1 = -0.75 in log s, at μ = 0 and s = 1;
    # the sampled log-ratio has them on average over the noise.
    algorithm = CSAC(entropy_weight=0.2, relative_entropy_weight=0.5, relative_entropy_estimator=estimator, **LINEAR)
    state = algorithm.init(jax.random.key(0), ONE, 1000)._replace(actor=POLICY, critics=CRITICS)
    noises = jax.random.normal(jax.random.key(0), (4, 20_000, 1))
    q, entropy, relative_entropy = MECHANISM.parts_of_the_gradient(
        algorithm, state, REFERENCE, jnp.ones((4, 20_000, 1)), noises
    )
    order = [0.5 * -0.25, 0.5 * -0.75]  # of the bias; the weights' gradient is the same, as the observation is 1
    np.testing.assert_allclose(relative_entropy.mean(axis=0), order * 2, atol=0.01)
    # At s = 1 Q₁ = 1 + 2a is the smaller one where a < 2/3, and Q₂ = 3 - a above; da/dμ = 1 - a² and
    # dlog π/dlog s = -1 + 2ua.
    u = np.asarray(noises, np.float64)
    slopes = np.where(np.tanh(u) < 2 / 3, -2.0, 1.0) * (1 - np.tanh(u) ** 2)
    assert float(q.mean(axis=0)[2]) == pytest.approx(np.mean(slopes), abs=1e-3)
    assert float(entropy.mean(axis=0)[3]) == pytest.approx(0.2 * np.mean(-1 + 2 * u * np.tanh(u)), abs=1e-3)


@pytest.mark.parametrize(("reference_mean", "cosine"), [(0.1, 1.0), (0.7, -1.0)])
def test_a_look_at_gaussians_that_moved(reference_mean, cosine):
    # Of the same std 0.5, a distance d of the means is a KL of d² / (2·0.5²) with the slope d / 0.5² in the mean and
    # none in the std. The actor went from 0.2 to 0.3: descent on the KL goes back where the reference lies behind it,
    # and on where it lies ahead.
    algorithm = CSAC(relative_entropy_weight=0.5, **CLOSED_FORM, **LINEAR)
    actor = gaussian(0.3, 0.5)
    state = algorithm.init(jax.random.key(0), ONE, 1000)._replace(actor=actor, critics=CRITICS)
    batches, held_out = jnp.zeros((2, 8, 1)), jnp.zeros((4, 1))  # observations of 0: the weights have no gradient
    found = MECHANISM.look(
        algorithm,
        state,
        gaussian(0.2, 0.5),
        gaussian(-0.3, 0.5),
        gaussian(reference_mean, 0.5),
        batches,
        held_out,
        jax.random.key(1),
    )
    distance = abs(0.3 - reference_mean)
    expected = {
        "relative_entropy": distance**2 / 0.5,
        "kl_gradient": 0.5 * distance / 0.25,
        "kl_noise": 0.0,
        "cosine": cosine,
        "update": 0.1,
        "churn": 0.1**2 / 0.5,
        "churn_since_last_look": 0.6**2 / 0.5,
        "std": 0.5,
    }
    assert {name: float(getattr(found, name)) for name in expected} == pytest.approx(expected, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("reference_policy", ["algorithm1", "previous", "periodic", "average"])
def test_the_reference_is_that_of_the_next_update(reference_policy):
    algorithm = CSAC(reference_policy=reference_policy, reference_period=3, reference_rate=0.3, **CLOSED_FORM, **LINEAR)
    state = algorithm.init(jax.random.key(0), ONE, 1000)
    batch = batch_of(transition(), transition(observation=-1.0, action=-0.5))
    told, found = [], []
    for updates in range(7):
        reference = MECHANISM.reference_of(algorithm, state, updates)
        policies = [(policy_at(state.actor, one), policy_at(reference, one)) for one in batch.observation]
        found.append(np.mean([kl(*pair) for pair in policies]))
        state, metrics = update(algorithm, state, batch, updates)
        told.append(metrics["relative_entropy"])
    np.testing.assert_allclose(found, told, rtol=1e-4, atol=1e-6)
    assert (max(found) > 1e-4) == (reference_policy != "algorithm1")


class Counting(Endless):
    """Observes the steps of its episode, which has four."""

    def __init__(self) -> None:
        super().__init__(length=4)

    def step(self, action: np.ndarray) -> Result:
        _, reward, terminated, truncated, info = super().step(action)
        return np.array([self.steps], np.float32), reward, terminated, truncated, info


@pytest.mark.parametrize(("sigma", "tau"), [(0.0, 0.5), (0.2, 0.0)])
def test_a_rollout_has_what_each_state_is_worth_and_is_charged(monkeypatch, sigma, tau):
    monkeypatch.setitem(MECHANISM.roll_out.__globals__, "ROLLOUT_STEPS", 400)
    algorithm = CSAC(entropy_weight=sigma, relative_entropy_weight=tau, **CLOSED_FORM, **LINEAR)
    # N(0.2 s, 0.5²) towards N(0, 0.5²) is a KL of 0.08 s² at step s; the critics say s + 1 and s + 5 of any action.
    actor = linear([[0.2, 0.0]], [0.0, float(np.log(0.5))])
    critics = (linear([[1.0], [0.0]], [5.0]), linear([[1.0], [0.0]], [1.0]))
    state = algorithm.init(jax.random.key(0), ONE, 1000)._replace(actor=actor, critics=critics)
    environments = SeedEnvironments(Counting, None, [0])
    found = MECHANISM.roll_out(algorithm, state, gaussian(0.0, 0.5), environments, jax.random.key(1))
    environments.close()

    step = np.arange(400) % 4
    np.testing.assert_array_equal(found.observation[:, 0], step)
    np.testing.assert_array_equal(found.ended, step == 3)
    assert not found.terminated.any()
    np.testing.assert_allclose(found.reward, 1.0)
    np.testing.assert_allclose(found.q_value, step + 1)
    np.testing.assert_allclose(found.next_q_value, step + 2)
    within = ~found.ended[:-1]
    np.testing.assert_allclose(found.next_charge[:-1][within], found.charge[1:][within], rtol=1e-6)
    if tau:
        np.testing.assert_allclose(found.charge, tau * 0.08 * step**2, atol=1e-6)
        np.testing.assert_allclose(found.next_charge, tau * 0.08 * (step + 1) ** 2, atol=1e-6)
    else:
        noises = jax.random.normal(jax.random.key(2), (20_000, 1))
        log_prob = jax.vmap(policy_at(actor, jnp.zeros(1)).log_prob)(noises).mean()
        assert found.charge[step == 0].mean() == pytest.approx(sigma * float(log_prob), abs=0.03)


@pytest.mark.slow
def test_a_run_is_looked_at_beside_the_actor_before_its_last_update(tmp_path):
    name = "previous, closed_form"
    MECHANISM.run(name, "probes:Endless-v0", 2 * MECHANISM.INTERVAL, 10, 0, tmp_path)
    rows = np.genfromtxt(tmp_path / "previous-closed_form.csv", delimiter=",", names=True)
    assert rows["step"].tolist() == [137, 274]
    # All states are the same, so the KL to the next update's reference is that to the actor before the last one.
    assert (rows["churn"] > 0).all()
    np.testing.assert_allclose(rows["relative_entropy"], rows["churn"], rtol=1e-4)
    assert (rows["update"] > 0).all()
