"""What remains of the relative entropy if Algorithm 1 is read with mini-batches.

The reference is then the actor itself when both gradients are taken. For ever narrower policies, this prints the
gradient of the actor loss with respect to the mean of the Gaussian, as mean and standard deviation over the action
noise: with `sampled`, with `closed_form`, and for SAC (weight 0). Expectations are exact up to rounding (Gauss-Hermite
quadrature).

    python examples/minibatch_reading.py
"""

import jax
import jax.numpy as jnp
import numpy as np

from csac.algorithms.csac import CSAC
from csac.algorithms.networks import MLP
from csac.types import Layer

BATCH = 256
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(64)


def constant_policy(mean: float, std: float) -> MLP:
    """Return an actor with the same one-dimensional Gaussian for every observation."""
    return MLP((Layer(jnp.zeros((1, 2)), jnp.array([mean, np.log(std)])),))


def flat_critics() -> tuple[MLP, MLP]:
    """Return critics that are 0 everywhere, so that only the regularisers act."""
    critic = MLP((Layer(jnp.zeros((2, 1)), jnp.zeros(1)),))
    return critic, critic


def gradients(algorithm: CSAC, std: float) -> np.ndarray:
    """Return dJ/dmean at every quadrature node of the action noise [64], with the actor as its own reference."""
    actor = constant_policy(0.3, std)

    def gradient(noise: jax.Array) -> jax.Array:
        def loss(learnt: MLP) -> jax.Array:
            networks = {"reference": actor, "critics": flat_critics()}
            return algorithm.actor_loss(learnt, jnp.zeros(1), noise, sigma=algorithm.entropy_weight, **networks)[0]

        return jax.grad(loss)(actor).layers[0].bias[0]

    return np.asarray(jax.vmap(gradient)(jnp.asarray(NODES, jnp.float32)[:, None]), np.float64)


def moments(values: np.ndarray) -> tuple[float, float]:
    """Return mean and standard deviation of values at the quadrature nodes."""
    mean = np.average(values, weights=WEIGHTS)
    return float(mean), float(np.sqrt(np.average((values - mean) ** 2, weights=WEIGHTS)))


def main() -> None:
    """Print the table."""
    sac = CSAC(relative_entropy_weight=0.0)
    exact = CSAC(relative_entropy_estimator="closed_form", reference_policy="periodic", reference_period=1)
    sampled = CSAC(relative_entropy_estimator="sampled", reference_policy="periodic", reference_period=1)
    print("Gradient of the actor loss with respect to the mean; sigma = 0.2, tau = 0.5, flat critics")
    print("       |    SAC (tau = 0)     |     closed_form      |       sampled        | sampled - closed_form,")
    print("std    |      mean        std |      mean        std |      mean        std | mean of 256: std (tau/16std)")
    for std in (1.0, 0.3, 0.1, 0.03, 0.01):
        columns = [gradients(algorithm, std) for algorithm in (sac, exact, sampled)]
        cells = " | ".join("{:+9.4f}  {:9.4f}".format(*moments(column)) for column in columns)
        left_over = moments(columns[2] - columns[1])[1] / BATCH**0.5
        print(f"{std:<6} | {cells} | {left_over:.4f} ({0.5 / BATCH**0.5 / std:.4f})")


if __name__ == "__main__":
    main()
