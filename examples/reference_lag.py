"""How much each reference policy slows improvement: theory compared with measurement.

    python examples/reference_lag.py

The first table counts refreshes: iterations of conservative value iteration with exact improvement, in a small random
task (tests/algorithms/test_csac_theory.py shows that CSAC's equations are the same). The other tables count updates:
descent on CSAC's actor loss with its reference policies. In the second table the gradient of Q is constant; in the
third there is a best policy, exp(Q/sigma), and the distance to it is halved; both use plain gradient descent. The
fourth is the second with Adam.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from csac.algorithms.csac import CSAC
from csac.algorithms.networks import MLP
from csac.types import Layer

STATES, ACTIONS = 10, 5
PULL = 0.01  # slope of the Q that is linear in the mean
NOISE = 0.05  # standard deviation of the gradient noise with Adam


class Weights(NamedTuple):
    """σ and τ."""

    entropy: float
    relative_entropy: float


class Choice(NamedTuple):
    """A reference policy and its period or rate."""

    policy: Literal["periodic", "average"]
    period: int = 1000
    rate: float = 0.005


CHOICES = (
    Choice("periodic", period=1),
    Choice("average", rate=1.0),
    Choice("average", rate=0.05),
    Choice("average", rate=0.005),
    Choice("periodic", period=100),
    Choice("periodic", period=1000),
)


def conservative_value_iteration(alpha: float, beta: float, discount: float, iterations: int) -> np.ndarray:
    """Return all P [iteration, state, action] of P ← r + γ E[m P] + α (P - m P), with m P = log Σ exp(βP) / β."""
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
    """Return the factor by which an iteration shrinks the distance to the limit, after a transient."""
    alpha, beta = tau / (tau + sigma), 1.0 / (tau + sigma)
    iterations = int(12 / -np.log(max(alpha, discount)))  # until e⁻¹² of it is left
    preferences = conservative_value_iteration(alpha, beta, discount, 3 * iterations)
    distance = np.abs(preferences[:iterations] - preferences[-1]).max(axis=(1, 2))
    middle = iterations // 2
    return float((distance[-1] / distance[middle]) ** (1.0 / (iterations - 1 - middle)))


def longest_lag(choice: Choice) -> float:
    """Return how many updates the reference lags behind the policy; for a period, at its end."""
    if choice.policy == "average":
        return 1.0 / choice.rate
    return choice.period if choice.period > 1 else 0.0


def predicted_slow_down(choice: Choice, resistance: float) -> float:
    """Return how many times longer the same distance takes; resistance = learning rate x τ / std².

    With the effective lag L of the reference in updates this is 1 + L x resistance. L is 1 / rate or, for periods of N,
    from (N - 1) / 2, if the resistance over a period is small, to N, if it is large.
    """
    if choice.policy == "periodic":
        return choice.period * resistance / (1.0 - (1.0 - resistance) ** choice.period)
    return 1.0 + longest_lag(choice) * resistance


def predicted_slow_down_with_adam(choice: Choice, tau: float, std: float, learning_rate: float, noise: float) -> float:
    """Return how many times longer the same distance takes with Adam, with or without gradient noise.

    Adam divides by the root of the second moment. If noise dominates, this is plain descent with the learning rate over
    the noise. Without noise every step is one learning rate long, until the reference lags so far that it pulls as hard
    as Q. From then on the speed is pull / (τ L / std²), independent of the learning rate.
    """
    if noise:
        return predicted_slow_down(choice, learning_rate / noise * tau / std**2)
    return max(1.0, learning_rate * longest_lag(choice) * tau / std**2 / PULL)


def measured_slow_down(
    choice: Choice,
    tau: float,
    std: float,
    optimiser: optax.GradientTransformation,
    updates: int = 6000,
    noise: float = 0.0,
) -> float:
    """Return how many times slower the mean of a Gaussian moves than without relative entropy, after a transient."""

    def speed(weight: float) -> float:
        way = means(choice, Weights(0.0, weight), std, optimiser, updates, even_pull, noise)
        return float(way[-1] - way[updates // 2 - 1]) / (updates - updates // 2)

    return speed(0.0) / speed(tau)


def predicted_half_life(choice: Choice, weights: Weights, std: float, learning_rate: float) -> float:
    """Return how many updates halve the distance to exp(Q/σ), after a transient.

    An update moves the mean by `pull` times its distance to the limit and by `resistance` times its distance to the
    reference. With `average` the remaining share per update is an eigenvalue of mean and reference together; with
    `periodic` a whole period leaves α + (1 - α) (1 - pull - resistance)^N, α = τ / (τ + σ). If the lag L is short
    compared with 1 / pull, the half-life is ln 2 x (1 / pull + τ / σ x L). If it is long, the policy waits for its
    reference: every L updates are a refresh, which leaves α with `periodic` and covers 1 - α of the distance with
    `average`.
    """
    pull, resistance = (float(learning_rate * weight / std**2) for weight in weights)
    if choice.policy == "periodic":
        alpha = resistance / (pull + resistance)
        left = alpha + (1.0 - alpha) * (1.0 - pull - resistance) ** choice.period
        return float(choice.period * np.log(0.5) / np.log(left))
    kept = [choice.rate, 1.0 - choice.rate]
    together = np.array([[1.0 - pull - resistance, resistance], kept])  # rows: mean, reference
    return float(np.log(0.5) / np.log(np.abs(np.linalg.eigvals(together)).max()))


def measured_half_life(choice: Choice, weights: Weights, std: float, learning_rate: float) -> float:
    """Return how many updates halve the distance to exp(Q/σ), measured after a transient."""
    period = choice.period if choice.policy == "periodic" else 1
    periods = int(np.ceil(3 * predicted_half_life(choice, weights, std, learning_rate) / period))
    updates = 2 * period * periods  # both halves end at the end of a period
    way = means(choice, weights, std, optax.sgd(learning_rate), updates, _pull_to_one(weights, std))
    distance = 1.0 - np.asarray(way)
    left = distance[-1] / distance[updates // 2 - 1]
    return float(updates // 2 * np.log(0.5) / np.log(left))


def largest_stable_resistance(choice: Choice) -> float:
    """Return the learning rate x τ / std² above which plain descent oscillates with growing amplitude."""
    if choice.policy == "average":
        return 2.0 - choice.rate
    return 2.0 if choice.period > 1 else np.inf


def means(
    choice: Choice,
    weights: Weights,
    std: float,
    optimiser: optax.GradientTransformation,
    updates: int,
    critic: Callable,
    noise: float = 0.0,
) -> jax.Array:
    """Return the mean of a Gaussian policy after each update [update] on CSAC's actor loss, starting at 0.

    `noise` is the standard deviation of the noise added to the gradient.
    """
    algorithm = CSAC(
        reference_policy=choice.policy,
        reference_period=choice.period,
        reference_rate=choice.rate,
        relative_entropy_estimator="closed_form",
        relative_entropy_weight=weights.relative_entropy,
    )

    def loss(actor: MLP, reference: MLP) -> jax.Array:
        networks = {"reference": reference, "critics": (critic, critic)}
        return algorithm.actor_loss(actor, jnp.zeros(1), jnp.zeros(1), sigma=weights.entropy, **networks)[0]

    def update(carry: tuple[MLP, MLP, optax.OptState], step: jax.Array) -> tuple[tuple, jax.Array]:
        actor, kept, optimiser_state = carry
        used = algorithm.reference_before(kept, actor, step)
        slope = jax.grad(loss)(actor, used).layers[0].bias[0]
        slope += noise * jax.random.normal(jax.random.fold_in(jax.random.key(0), step))
        change, optimiser_state = optimiser.update(slope, optimiser_state)
        moved = _gaussian(actor.layers[0].bias[0] + change, std)
        return (moved, algorithm.reference_after(used, actor), optimiser_state), moved.layers[0].bias[0]

    first = _gaussian(jnp.zeros(()), std)
    return jax.lax.scan(update, (first, first, optimiser.init(jnp.zeros(()))), jnp.arange(updates))[1]


def even_pull(inputs: jax.Array) -> jax.Array:
    """A Q that is linear in the mean."""
    return PULL * jnp.arctanh(inputs[1:])


def _pull_to_one(weights: Weights, std: float) -> Callable:
    """Return a Q whose best policy has this std and mean 1 before the tanh; it cancels the tanh's log-determinant."""

    def critic(inputs: jax.Array) -> jax.Array:
        action = inputs[1:]
        distance = jnp.arctanh(action) - 1.0
        return -weights.entropy * (0.5 * (distance / std) ** 2 + jnp.log1p(-(action**2)))

    return critic


def _gaussian(mean: jax.Array, std: float) -> MLP:
    return MLP((Layer(jnp.zeros((1, 2)), jnp.stack([mean, jnp.log(jnp.float32(std))])),))


def main() -> None:
    """Print the tables."""
    sigma, discount = 0.2, 0.9
    print(f"Refreshes: what one of them leaves of the distance to the end; sigma = {sigma}, discount {discount}")
    print("tau   | alpha = tau/(tau+sigma) | predicted max(alpha, discount) | measured | refreshes to halve, Q given")
    for tau in (0.005, 0.05, 0.5, 5.0, 50.0):
        alpha = tau / (tau + sigma)
        cells = f"{max(alpha, discount):30.4f} | {contraction(sigma, tau, discount):8.4f}"
        print(f"{tau:<5} | {alpha:23.4f} | {cells} | {np.log(0.5) / np.log(alpha):.2f}")

    std, learning_rate = 0.5, 0.01
    print(f"\nUpdates: how many times longer the same way takes; std = {std}, learning rate {learning_rate}")

    def slow_down(choice: Choice, tau: float) -> tuple[float, float]:
        predicted = predicted_slow_down(choice, learning_rate * tau / std**2)
        return predicted, measured_slow_down(choice, tau, std, optax.sgd(learning_rate))

    _print_by_reference(slow_down, 3)
    print(f"\nUpdates until half of the distance to SAC's policy is left; sigma = {sigma}, the others the same")

    def half_life(choice: Choice, tau: float) -> tuple[float, float]:
        weights = Weights(sigma, tau)
        own = (choice, weights, std, learning_rate)
        return predicted_half_life(*own), measured_half_life(*own)

    _print_by_reference(half_life, 1)

    learning_rate, tau = 3e-4, 0.5
    print(f"\nUpdates with Adam: how many times longer the same way takes; learning rate {learning_rate}, tau = {tau}")
    print(f"reference        | no noise: predicted measured | noise {NOISE}: predicted measured")
    for choice in CHOICES:
        cells = []
        # Without noise all steps have one direction, and the mean must stay where tanh is invertible.
        for noise, updates in ((0.0, 8_000), (NOISE, 40_000)):
            predicted = predicted_slow_down_with_adam(choice, tau, std, learning_rate, noise)
            measured = measured_slow_down(choice, tau, std, optax.adam(learning_rate), updates, noise)
            cells.append(f"{predicted:9.2f} {measured:8.2f}")
        print(f"{_name(choice):<16} | {cells[0]:>28} | {cells[1]:>31}")


def _name(choice: Choice) -> str:
    return f"{choice.policy} {choice.period if choice.policy == 'periodic' else choice.rate:g}"


def _print_by_reference(values: Callable[[Choice, float], tuple[float, float]], decimals: int) -> None:
    """Print a row for each reference, with predicted and measured values for each weight."""
    print("reference        | tau = 0.05: predicted measured |  0.5: predicted measured |    5: predicted measured")
    for choice in CHOICES:
        pairs = [values(choice, tau) for tau in (0.05, 0.5, 5.0)]
        cells = [f"{predicted:9.{decimals}f} {measured:8.{decimals}f}" for predicted, measured in pairs]
        print(f"{_name(choice):<16} | {cells[0]:>29} | {cells[1]:>23} | {cells[2]:>23}")


if __name__ == "__main__":
    main()
