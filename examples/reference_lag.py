"""How much each reference policy slows improvement down: what theory predicts beside what CSAC's own equations do.

    python examples/reference_lag.py

The first table is in refreshes: iterations of conservative value iteration, each with its exact improvement, in a small
random task. The second is in updates: gradient descent on CSAC's actor loss, with a Q that always pulls one way.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac.algorithms.adaptation import Weights
from csac.algorithms.csac import CSAC
from csac.algorithms.networks import MLP
from csac.algorithms.references import ReferencePolicy, reference_after, references_before
from csac.types import Layer

STATES, ACTIONS = 10, 5


class Choice(NamedTuple):
    """A reference policy and the number that belongs to it."""

    policy: ReferencePolicy
    period: int = 1000
    rate: float = 0.005


def conservative_value_iteration(alpha: float, beta: float, discount: float, iterations: int) -> np.ndarray:
    """Return each P [iteration, state, action] of P ← r + γ E[m P] + α (P - m P), with m P = log Σ exp(βP) / β."""
    generator = np.random.default_rng(0)
    reward = generator.normal(size=(STATES, ACTIONS))
    dynamics = generator.dirichlet(np.ones(STATES), size=(STATES, ACTIONS))
    preference, found = np.zeros((STATES, ACTIONS)), []
    for _ in range(iterations):
        largest = preference.max(axis=1)
        value = largest + np.log(np.exp(beta * (preference - largest[:, None])).sum(axis=1)) / beta
        preference = reward + discount * dynamics @ value + alpha * (preference - value[:, None])
        found.append(preference)
    return np.array(found)


def contraction(sigma: float, tau: float, discount: float) -> float:
    """Return the factor by which an iteration shrinks the distance to the end, once the first ones are over."""
    alpha, beta = tau / (tau + sigma), 1.0 / (tau + sigma)
    iterations = int(12 / -np.log(max(alpha, discount)))  # until e⁻¹² of it is left
    preferences = conservative_value_iteration(alpha, beta, discount, 3 * iterations)
    distance = np.abs(preferences[:iterations] - preferences[-1]).max(axis=(1, 2))
    middle = iterations // 2
    return float((distance[-1] / distance[middle]) ** (1.0 / (iterations - 1 - middle)))


def predicted_slow_down(choice: Choice, resistance: float) -> float:
    """Return how many times longer the same way takes; resistance = learning rate x τ / std².

    With the effective lag L of the reference, in updates, it is 1 + L x resistance: L is 0, 1, 1 / rate or, for periods
    of N, (N - 1) / 2 where the resistance of a period is small, and N where it is large.
    """
    if choice.policy == "algorithm1":
        return 1.0
    if choice.policy == "periodic":
        return choice.period * resistance / (1.0 - (1.0 - resistance) ** choice.period)
    return 1.0 + resistance / (1.0 if choice.policy == "previous" else choice.rate)


def measured_slow_down(choice: Choice, tau: float, std: float, learning_rate: float, updates: int = 6000) -> float:
    """Return how many times longer the mean of a Gaussian takes than without relative entropy, after a transient."""
    free, held = (_speed(choice, weight, std, learning_rate, updates) for weight in (0.0, tau))
    return free / held


def _speed(choice: Choice, tau: float, std: float, learning_rate: float, updates: int) -> float:
    """Return how far the mean goes in an update, over the second half of them."""
    algorithm = CSAC(relative_entropy_weight=tau, relative_entropy_estimator="closed_form")
    critic = lambda inputs: 1e-2 * jnp.arctanh(inputs[1:])  # noqa: E731  (rises evenly with the mean)

    def loss(actor: MLP, reference: MLP | None) -> jax.Array:
        networks = {"reference": reference, "critics": (critic, critic)}
        return algorithm.actor_loss(actor, jnp.zeros(1), jnp.zeros(1), weights=Weights(0.0, tau), **networks)[0]

    def update(carry: tuple[MLP, MLP], step: jax.Array) -> tuple[tuple[MLP, MLP], jax.Array]:
        actor, kept = carry
        used = references_before(choice.policy, kept, None, actor, step % choice.period == 0).actor
        slope = jax.grad(loss)(actor, used).layers[0].bias[0]
        moved = _gaussian(actor.layers[0].bias[0] - learning_rate * slope, std)
        kept = reference_after(choice.policy, used, actor, choice.rate)
        assert kept is not None
        return (moved, kept), moved.layers[0].bias[0]

    first = _gaussian(jnp.zeros(()), std)
    _, means = jax.lax.scan(update, (first, first), jnp.arange(updates))
    return float(means[-1] - means[updates // 2 - 1]) / (updates - updates // 2)


def _gaussian(mean: jax.Array, std: float) -> MLP:
    return MLP((Layer(jnp.zeros((1, 2)), jnp.stack([mean, jnp.log(jnp.float32(std))])),))


def main() -> None:
    """Print both tables."""
    sigma, discount = 0.2, 0.9
    print(f"Refreshes: what one of them leaves of the distance to the end; sigma = {sigma}, discount {discount}")
    print("tau   | alpha = tau/(tau+sigma) | predicted max(alpha, discount) | measured | refreshes to halve, Q given")
    for tau in (0.005, 0.05, 0.5, 5.0, 50.0):
        alpha = tau / (tau + sigma)
        cells = f"{max(alpha, discount):30.4f} | {contraction(sigma, tau, discount):8.4f}"
        print(f"{tau:<5} | {alpha:23.4f} | {cells} | {np.log(0.5) / np.log(alpha):.2f}")

    std, learning_rate = 0.5, 0.01
    print(f"\nUpdates: how many times longer the same way takes; std = {std}, learning rate {learning_rate}")
    print("reference        | tau = 0.05: predicted measured |  0.5: predicted measured |    5: predicted measured")
    choices = (
        Choice("algorithm1"),
        Choice("previous"),
        Choice("average", rate=0.05),
        Choice("average", rate=0.005),
        Choice("periodic", period=100),
        Choice("periodic", period=1000),
    )
    for choice in choices:
        number = {"periodic": f" {choice.period}", "average": f" {choice.rate}"}.get(choice.policy, "")
        cells = []
        for tau in (0.05, 0.5, 5.0):
            predicted = predicted_slow_down(choice, learning_rate * tau / std**2)
            cells.append(f"{predicted:9.3f} {measured_slow_down(choice, tau, std, learning_rate):8.3f}")
        print(f"{choice.policy + number:<16} | {cells[0]:>29} | {cells[1]:>23} | {cells[2]:>23}")


if __name__ == "__main__":
    main()
