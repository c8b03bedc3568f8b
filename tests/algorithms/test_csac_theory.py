"""What CSAC is in theory: its exact improvement step, tabular CVI, DPP and SAC, and what Algorithm 1 leaves of it."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import CLOSED_FORM, REFERENCES, SPEC, assert_close
from scipy.optimize import minimize
from scipy.special import logsumexp, softmax

from csac.algorithms import CSAC, SAC
from csac.algorithms import csac as csac_file
from csac.types import Transition

NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(80)
WEIGHTS = WEIGHTS / WEIGHTS.sum()  # the mean over ξ ~ N(0, 1) of f(ξ) is WEIGHTS @ f(NODES)
ONE_OBSERVATION = jnp.zeros(1)


def q_value(action):
    """A value with a bend, no symmetry, and its best action away from 0."""
    return 1.5 * action - 2.0 * action**2 + 0.4 * np.sin(5.0 * action)


def critic(inputs: jax.Array) -> jax.Array:
    action = inputs[1:]
    return 1.5 * action - 2.0 * action**2 + 0.4 * jnp.sin(5.0 * action)


def actor_losses(algorithm, parameters, reference, noises):
    """The actor loss at each noise, of the policy with these [mean, log_std] at the only observation."""

    def loss(noise):
        given = {"reference": lambda _: reference, "critics": (critic, critic), "sigma": algorithm.entropy_weight}
        return algorithm.actor_loss(lambda _: parameters, ONE_OBSERVATION, noise[None], **given)[0]

    return jax.vmap(loss)(noises)


def test_the_actor_as_its_own_reference_has_no_expected_gradient_of_the_relative_entropy():
    # With π̃ = π at u = mean + std ξ, log π(u) does not move with the mean, and -log π̃(u) has the slope ξ / std there;
    # in log_std the slopes are -1 and ξ². So the gradient of τ (log π - log π̃) is τ [ξ / std, ξ² - 1]: its mean over
    # ξ ~ N(0, 1) is 0, but at one noise it is not.
    tau, parameters = 0.5, jnp.array([0.3, -0.7])

    def gradients(relative_entropy_weight):
        algorithm = CSAC(relative_entropy_weight=relative_entropy_weight, relative_entropy_estimator="sampled")
        return jax.jacobian(lambda p: actor_losses(algorithm, p, parameters, jnp.float32(NODES)))(parameters)

    part = np.asarray(gradients(tau) - gradients(0.0))
    expected = tau * np.stack([NODES / np.exp(-0.7), NODES**2 - 1.0], axis=1)
    likely = np.abs(NODES) < 4
    np.testing.assert_allclose(part[likely], expected[likely], atol=1e-3)
    np.testing.assert_allclose(WEIGHTS @ part, [0.0, 0.0], atol=1e-5)
    assert np.abs(part[likely]).max() > 1.0


SMALL = {
    "discount": 0.9,
    "target_rate": 0.05,
    "actor_learning_rate": 3e-3,
    "critic_learning_rate": 3e-3,
    "actor_hidden_sizes": (8,),
    "critic_hidden_sizes": (8,),
    "entropy_weight": 0.2,
}


def after_updates(algorithm, updates=50):
    """The state after some updates on random batches, the same for every algorithm."""

    def one(state, step):
        key = jax.random.fold_in(jax.random.key(0), step)
        vectors = jax.random.normal(key, (32, 2 * SPEC.observation_size))
        action = jax.random.uniform(key, (32, SPEC.action_size), minval=-1.0)
        reward, terminated = action.sum(axis=1), (vectors[:, 0] > 1).astype(jnp.float32)
        batch = Transition(vectors[:, :3], action, reward, vectors[:, 3:], terminated, jnp.zeros(32))
        return algorithm.update(state, batch, key, step)[0], None

    state = algorithm.init(jax.random.key(1), SPEC, 1000)
    return jax.jit(lambda state: jax.lax.scan(one, state, jnp.arange(updates))[0])(state)


@pytest.fixture(scope="module")
def sac_state():
    return after_updates(SAC(**SMALL))


def assert_equals_sac(state, sac_state):
    for name in ("actor", "critics", "target_critics", "actor_optimiser", "critic_optimiser"):
        assert_close(getattr(state, name), getattr(sac_state, name))


@pytest.mark.parametrize(("reference", "estimator"), [("average", "closed_form"), ("periodic", "sampled")])
def test_without_relative_entropy_csac_is_sac(reference, estimator, sac_state):
    options = {**REFERENCES[reference], "relative_entropy_estimator": estimator}
    assert_equals_sac(after_updates(CSAC(relative_entropy_weight=0.0, **options, **SMALL)), sac_state)


@pytest.mark.parametrize("reference", ["the actor itself", "one update ago"])
def test_with_the_closed_form_csac_is_sac_where_the_actor_is_its_own_reference_alone(reference, sac_state):
    state = after_updates(CSAC(relative_entropy_weight=0.5, **REFERENCES[reference], **CLOSED_FORM, **SMALL))
    if reference == "the actor itself":
        assert_equals_sac(state, sac_state)
    else:
        with pytest.raises(AssertionError):
            assert_equals_sac(state, sac_state)


def test_a_learnt_entropy_weight_is_sac_s_learnt_temperature():
    settings = {**SMALL, "entropy_weight": "auto", "weight_learning_rate": 3e-3}
    ours, theirs = after_updates(CSAC(relative_entropy_weight=0.0, **settings)), after_updates(SAC(**settings))
    assert_equals_sac(ours, theirs)
    assert abs(float(theirs.temperature.log_weight)) > 0.05
    assert_close(ours.temperature.log_weight, theirs.temperature.log_weight)


def best_tanh_gaussian(sigma, tau, mean, log_std):
    """Minimise KL(π ‖ π̃^α exp(βQ) / Z) over tanh-Gaussians π by integrating over actions: ([mean, log_std], J)."""
    alpha, beta = tau / (tau + sigma), 1.0 / (tau + sigma)
    u = np.linspace(-12.0, 12.0, 8001)
    log_width = np.log(u[1] - u[0]) + np.log(4.0) - 2.0 * np.logaddexp(u, -u)  # da = 4 du / (eᵘ + e⁻ᵘ)²

    def log_density(mean, log_std):
        log_gaussian = -0.5 * ((u - mean) / np.exp(log_std)) ** 2 - log_std - 0.5 * np.log(2 * np.pi)
        return log_gaussian - (log_width - np.log(u[1] - u[0]))

    log_target = alpha * log_density(mean, log_std) + beta * q_value(np.tanh(u))
    log_z = logsumexp(log_target + log_width)

    def divergence(parameters):
        log_pi = log_density(*parameters)
        return np.exp(log_pi + log_width) @ (log_pi - log_target + log_z)

    best = minimize(divergence, [mean, log_std], method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-12})
    return best.x, (best.fun - log_z) / beta  # J is the divergence over β, without the normaliser


@pytest.mark.parametrize(("estimator", "sigma", "tau"), [("sampled", 0.2, 0.5), ("closed_form", 0.05, 1.0)])
def test_descending_the_actor_loss_reaches_the_exact_improvement(estimator, sigma, tau):
    algorithm = CSAC(entropy_weight=sigma, relative_entropy_weight=tau, relative_entropy_estimator=estimator)
    mean, log_std = -0.4, -0.6
    expected, expected_loss = best_tanh_gaussian(sigma, tau, mean, log_std)
    with jax.enable_x64(True):
        reference, weights, nodes = jnp.array([mean, log_std]), jnp.array(WEIGHTS), jnp.array(NODES)

        def loss(parameters):
            return weights @ actor_losses(algorithm, parameters, reference, nodes)

        descend = jax.jit(lambda start: jax.lax.fori_loop(0, 3000, lambda _, p: p - 0.1 * jax.grad(loss)(p), start))
        reached = descend(reference)
        np.testing.assert_allclose(reached, expected, atol=1e-4)
        assert float(loss(reached)) == pytest.approx(expected_loss, abs=1e-6)


# A small task with a table for its policy in place of the tanh-Gaussian: seven actions, PRE_TANH before
# the tanh. The noise that CSAC's equations are given chooses one of them: expectations are sums, exact to rounding.
STATES, ACTIONS, DISCOUNT = 4, 7, 0.9
GENERATOR = np.random.default_rng(0)
REWARD = GENERATOR.normal(size=(STATES, ACTIONS))
DYNAMICS = GENERATOR.dirichlet(np.full(STATES, 0.3), size=(STATES, ACTIONS))  # [state, action, next state]
FIRST_Q = GENERATOR.normal(size=(STATES, ACTIONS))
FIRST_POLICY = np.log(GENERATOR.dirichlet(np.ones(ACTIONS), size=STATES))  # log π_(-1)
GAP = GENERATOR.normal(size=(STATES, ACTIONS))  # by which the first critic lies above the second, or below it
PRE_TANH = np.linspace(-2.0, 2.0, ACTIONS)


class Table(NamedTuple):
    """The distribution of actions at one state: the part of TanhGaussian's interface that CSAC uses."""

    log_probs: jax.Array  # [action]

    def sample(self, noise):
        return jnp.tanh(noise)

    def log_prob(self, noise):
        return self.log_probs[choice(noise)]


def choice(pre_tanh):
    """Which of the actions lies here."""
    return jnp.argmin(jnp.abs(pre_tanh - PRE_TANH))


def table_kl(policy, reference):
    return jnp.sum(jnp.exp(policy.log_probs) * (policy.log_probs - reference.log_probs))


def table_log_ratio(policy, reference, noise):
    return policy.log_prob(noise) - reference.log_prob(noise)


def table_policy_at(actor, observation):
    return Table(actor(observation))


@pytest.fixture
def tables(monkeypatch):
    """CSAC with policies that are tables."""
    monkeypatch.setattr(csac_file, "policy_at", table_policy_at)
    monkeypatch.setattr(csac_file, "kl", table_kl)
    monkeypatch.setattr(csac_file, "log_ratio", table_log_ratio)


def actor_of(log_policy):
    """A network whose outputs are those of this table [state, action]."""
    return lambda observation: log_policy[observation[0].astype(int)]


def critics_of(q):
    """Two networks whose smaller values are those of this table [state, action]; neither is the smaller everywhere."""

    def critic(table):
        return lambda inputs: table[inputs[0].astype(int), choice(jnp.arctanh(inputs[1]))][None]

    return critic(q + np.maximum(GAP, 0.0)), critic(q + np.maximum(-GAP, 0.0))


def expected_loss(algorithm, log_policy, log_reference, q):
    """The mean of `actor_loss` over the policy's actions [state]."""

    def loss(state, noise):
        given = {"reference": actor_of(log_reference), "critics": critics_of(q), "sigma": algorithm.entropy_weight}
        return algorithm.actor_loss(actor_of(log_policy), state[None], noise[None], **given)[0]

    losses = jax.vmap(jax.vmap(loss, (None, 0)), (0, None))(jnp.arange(STATES), jnp.asarray(PRE_TANH))
    return jnp.sum(jnp.exp(log_policy) * losses, axis=1)


def expected_target(algorithm, log_policy, log_reference, q):
    """The mean of `critic_target` over next states and over the policy's actions there [state, action]."""

    def target(state, action, reward, next_state, noise):
        transition = Transition(state[None], action[None], reward, next_state[None], jnp.zeros(()), jnp.zeros(()))
        return algorithm.critic_target(
            transition,
            noise[None],
            actor=actor_of(log_policy),
            reference=actor_of(log_reference),
            targets=critics_of(q),
            sigma=algorithm.entropy_weight,
        )

    for axes in ((4,), (3,), (1, 2), (0, 2)):  # in the end [state, action, next state, next action]
        target = jax.vmap(target, [0 if axis in axes else None for axis in range(5)])
    states, actions = jnp.arange(STATES), jnp.asarray(PRE_TANH)
    targets = target(states, jnp.tanh(actions), jnp.asarray(REWARD), states, actions)
    return jnp.einsum("ijk,kl,ijkl->ij", DYNAMICS, jnp.exp(log_policy), targets)


def improve(algorithm, log_reference, q):
    """Minimise the mean of `actor_loss` over all policies: log π.

    It is (linear in π) + (τ + σ) Σ π log π, so one mirror step of size β = 1 / (τ + σ) from any policy, here the
    uniform one, ends in the minimum.
    """
    log_policy = jnp.full_like(q, -jnp.log(ACTIONS))
    slope = jax.grad(lambda policy: expected_loss(algorithm, jnp.log(policy), log_reference, q).sum())(
        jnp.exp(log_policy)
    )
    size = 1.0 / (algorithm.entropy_weight + algorithm.relative_entropy_weight)
    return jax.nn.log_softmax(log_policy - size * slope, axis=1)


@lru_cache
def iteration(algorithm):
    """One iteration of an algorithm, compiled once for all tests: each uses the tables."""

    @jax.jit
    def step(q, log_before):
        log_policy = improve(algorithm, log_before, q)
        value = -expected_loss(algorithm, log_policy, log_before, q)
        return log_policy, value, expected_target(algorithm, log_policy, log_before, q)

    return step


def iterate(sigma, tau, iterations, estimator: Any = "sampled", **options):
    """CSAC's own equations, exactly: yields (Q_k, log π_k, V_k).

    The actor descends towards π_k with π_(k-1) as its reference, and the critic's target is taken with π_k against
    π_(k-1).
    """
    algorithm = CSAC(
        entropy_weight=sigma,
        relative_entropy_weight=tau,
        relative_entropy_estimator=estimator,
        discount=DISCOUNT,
        **options,
    )
    step = iteration(algorithm)
    iterates = []  # and not one by one: between two of a generator's, float64 would stay on for everybody
    with jax.enable_x64(True):
        q, log_policy = jnp.array(FIRST_Q), jnp.array(FIRST_POLICY)
        for _ in range(iterations):
            before = q
            log_policy, value, q = step(q, log_policy)
            iterates.append((np.asarray(before), np.asarray(log_policy), np.asarray(value)))
    return iterates


def soft_value_iteration(sigma):
    """The fixed point of SAC, by iterating V = σ log Σ exp(Q / σ)."""
    q = np.zeros((STATES, ACTIONS))
    for _ in range(500):
        q = REWARD + DISCOUNT * DYNAMICS @ (sigma * logsumexp(q / sigma, axis=1))
    return q


@pytest.mark.usefixtures("tables")
@pytest.mark.parametrize(
    ("estimator", "sigma", "tau"),
    [
        ("sampled", 0.2, 0.5),
        ("sampled", 0.0, 0.5),
        ("closed_form", 0.5, 0.05),
        ("closed_form", 0.2, 5.0),
        ("closed_form", 0.2, 0.0),
    ],
)
def test_target_and_loss_are_conservative_value_iteration(sigma, tau, estimator):
    # CVI (Kozuno et al. 2019) knows only preferences P, with m P = (1/β) log Σ exp(βP):
    #   P_(k+1) = r + γ E[m P_k] + α (P_k - m P_k), from P_0 = τ log π_(-1) + Q_0,
    # its policy is π_k ∝ exp(βP_k) and its value m P_k. With σ = 0, α = 1: that is DPP. With τ = 0, α = 0: SAC.
    alpha, beta = tau / (tau + sigma), 1.0 / (tau + sigma)
    log_before, preference = FIRST_POLICY, tau * FIRST_POLICY + FIRST_Q
    for q, log_policy, value in iterate(sigma, tau, 40, estimator):
        np.testing.assert_allclose(q, preference - tau * log_before, atol=1e-9)
        soft_maximum = logsumexp(beta * preference, axis=1) / beta
        np.testing.assert_allclose(np.exp(log_policy), softmax(beta * preference, axis=1), atol=1e-9)
        np.testing.assert_allclose(value, soft_maximum, atol=1e-9)
        log_before = log_policy
        preference = REWARD + DISCOUNT * DYNAMICS @ soft_maximum + alpha * (preference - soft_maximum[:, None])


@pytest.mark.usefixtures("tables")
@pytest.mark.parametrize("tau", [0.05, 5.0])
def test_actor_only_relative_entropy_has_the_fixed_point_of_sac(tau):
    # At the end the policy is its own reference, so that it makes no difference whether its KL is part of the value.
    sigma = 0.2
    restrained = iterate(sigma, tau, 1000, "closed_form", relative_entropy_form="actor_only")
    expected = soft_value_iteration(sigma)
    np.testing.assert_allclose(restrained[-1][0], expected, atol=1e-8)
    np.testing.assert_allclose(np.exp(restrained[-1][1]), softmax(expected / sigma, axis=1), atol=1e-8)
    both = iterate(sigma, tau, 3, "closed_form")
    assert np.all(restrained[1][0] > both[1][0] + 1e-3), "the first value has no penalty"
