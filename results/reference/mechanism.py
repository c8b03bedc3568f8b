"""What the relative entropy does along real training runs: one file of numbers for each reference policy and estimator.

    python results/reference/mechanism.py run "periodic, closed_form" --into FOLDER      one arm
    python results/reference/mechanism.py run --into FOLDER                              every arm without a file there
    python results/reference/mechanism.py draw                                           the figure and the tables

The run is what `csac train` makes with one seed: Hopper-v4, 5,000 steps, as those whose files lie in mechanism/, which
`draw` reads. Every 137 steps it is looked at; docs/relative-entropy.md says what the columns mean.
"""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from csac.algorithms.adaptation import Weights, current_weights
from csac.algorithms.critics import least_q_value
from csac.algorithms.csac import CSAC, State
from csac.algorithms.distributions import kl, policy_at
from csac.algorithms.networks import MLP
from csac.algorithms.references import references_before
from csac.record.atomic import write_atomically
from csac.tasks.seeds import SeedEnvironments
from csac.training.learner import Learner
from csac.types import Spec

HERE = Path(__file__).parent / "mechanism"


def _arm(policy: str, estimator: str = "closed_form", tau: float = 0.5, rate: float = 0.005) -> dict[str, Any]:
    return {
        "reference_policy": policy,
        "relative_entropy_estimator": estimator,
        "relative_entropy_weight": tau,
        "reference_rate": rate,
    }


ARMS: dict[str, dict[str, Any]] = {
    f"{policy}, {estimator}": _arm(policy, estimator)
    for policy in ("algorithm1", "previous", "periodic", "average")
    for estimator in ("closed_form", "sampled")
}
# CSAC's default; the same product of weight and lag, 100, that `average, closed_form` has; and a weight that is large.
WEIGHTS: dict[str, dict[str, Any]] = {
    "average 0.05, tau 0.5": _arm("average", rate=0.05),
    "previous, tau 100": _arm("previous", tau=100.0),
    "average 0.05, tau 5": _arm("average", tau=5.0, rate=0.05),
    "periodic 1000, tau 0.1": _arm("periodic", tau=0.1),
    "algorithm1 sampled, tau 50": _arm("algorithm1", "sampled", tau=50.0),
    "previous, tau 50": _arm("previous", tau=50.0),
    "average 0.005, tau 50": _arm("average", tau=50.0),
    "periodic 1000, tau 50": _arm("periodic", tau=50.0),
}
EVERY_ARM = {**ARMS, **WEIGHTS}
TOLD_BY_WEIGHT = ("relative_entropy", "kl_gradient", "update", "churn", "churn_since_last_look", "std", "monte_carlo")
BESIDE_WEIGHTS = ("algorithm1, closed_form", "previous, closed_form", "average, closed_form", "periodic, closed_form")
INTERVAL = 137  # steps between two looks: seven of them are not quite a period of 1,000, which is seen at all ages
LOOKS_PER_ROLLOUT = 4
BATCHES = 16  # of the training's size, to tell the gradient from its noise
ROLLOUT_STEPS = 2_000
FEWEST_AHEAD = 300  # steps after a state that count for its return: of what comes later 0.99^300 = 5 % would be left
HELD_OUT = 512  # states of the rollouts, which no update has seen
FIGURES = (
    ("relative_entropy", "KL to the reference, nats", True),
    ("kl_gradient", "gradient of the KL part", True),
    ("kl_noise", "noise of the KL part, batch of 256", True),
    ("q_gradient", "gradient of the Q part", True),
    ("cosine", "cosine of KL gradient and last update", False),
    ("update", "length of the actor's last update", True),
    ("churn", "KL of one update, held-out states", True),
    ("critic_bias", "critic minus Monte-Carlo return", False),
)


class Look(NamedTuple):
    """What one look at a run finds, each a mean over states; gradients are norms over the actor's parameters."""

    relative_entropy: jax.Array
    q_gradient: jax.Array
    entropy_gradient: jax.Array
    kl_gradient: jax.Array
    q_noise: jax.Array
    entropy_noise: jax.Array
    kl_noise: jax.Array
    cosine: jax.Array
    update: jax.Array
    churn: jax.Array
    churn_since_last_look: jax.Array
    std: jax.Array
    entropy: jax.Array


class Rollout(NamedTuple):
    """What the current policy does in an environment of its own, step by step [t]."""

    observation: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    ended: np.ndarray
    q_value: np.ndarray
    next_q_value: np.ndarray  # of the action that the policy takes at what the step gave
    charge: np.ndarray  # σ log π + τ KL at the state, which the value before it has subtracted
    next_charge: np.ndarray


def reference_of(algorithm: CSAC, state: State, updates: int) -> MLP:
    """Return the reference of the actor's loss in the update that comes after so many."""
    renews = jnp.asarray(updates % algorithm.reference_period == 0)
    used = references_before(algorithm.reference_policy, state.reference, None, state.actor, renews).actor
    assert used is not None
    return used


def weights_of(algorithm: CSAC) -> Weights:
    """Return σ and τ."""
    return current_weights((algorithm.entropy_weight, algorithm.relative_entropy_weight), None)


def parts_of_the_gradient(
    algorithm: CSAC, state: State, reference: MLP, observations: jax.Array, noises: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the actor loss's gradient on each batch [batch, parameter]: that of -Q, of σ log π and of τ times the KL.

    Args:
        algorithm: its estimator and its weights.
        state: its actor and critics.
        reference: of the relative entropy.
        observations: [batch, state, observation].
        noises: [batch, state, action].
    """

    def gradient(weights: Weights, observations: jax.Array, noises: jax.Array) -> jax.Array:
        def loss(actor: MLP) -> jax.Array:
            one = partial(algorithm.actor_loss, actor, reference=reference, critics=state.critics, weights=weights)
            return jnp.mean(jax.vmap(lambda *example: one(*example)[0])(observations, noises))

        return ravel_pytree(jax.grad(loss)(state.actor))[0]

    sigma, tau = weights_of(algorithm)
    q, with_entropy, with_kl = (
        jax.lax.map(lambda batch, weights=weights: gradient(weights, *batch), (observations, noises))
        for weights in (Weights(0.0, 0.0), Weights(sigma, 0.0), Weights(0.0, tau))
    )
    return q, with_entropy - q, with_kl - q


@partial(jax.jit, static_argnums=0)
def look(
    algorithm: CSAC,
    state: State,
    before: MLP,
    at_last_look: MLP,
    reference: MLP,
    batches: jax.Array,
    held_out: jax.Array,
    key: jax.Array,
) -> Look:
    """Return what there is to see of a state, given the actors before the last update and at the last look."""
    action_size = state.actor.layers[-1].bias.shape[0] // 2
    noises = jax.random.normal(key, (*batches.shape[:2], action_size))
    parts = parts_of_the_gradient(algorithm, state, reference, batches, noises)
    means = [part.mean(axis=0) for part in parts]
    noise = [
        jnp.sqrt(jnp.mean(jnp.sum((part - mean[None]) ** 2, axis=1))) for part, mean in zip(parts, means, strict=True)
    ]
    update = ravel_pytree(state.actor)[0] - ravel_pytree(before)[0]
    norms = [jnp.linalg.norm(mean) for mean in means]

    def divergence(actor: MLP, other: MLP, observations: jax.Array) -> jax.Array:
        return jnp.mean(jax.vmap(lambda one: kl(policy_at(actor, one), policy_at(other, one)))(observations))

    policies = jax.vmap(lambda one: policy_at(state.actor, one))(held_out)
    log_probs = jax.vmap(lambda policy, noise: policy.log_prob(noise))(
        policies, jax.random.normal(key, policies.mean.shape)
    )
    return Look(
        relative_entropy=divergence(state.actor, reference, batches.reshape(-1, batches.shape[-1])),
        q_gradient=norms[0],
        entropy_gradient=norms[1],
        kl_gradient=norms[2],
        q_noise=noise[0],
        entropy_noise=noise[1],
        kl_noise=noise[2],
        cosine=jnp.vdot(means[2], update) / jnp.maximum(norms[2] * jnp.linalg.norm(update), 1e-30),
        update=jnp.linalg.norm(update),
        churn=divergence(state.actor, before, held_out),
        churn_since_last_look=divergence(state.actor, at_last_look, held_out),
        std=jnp.mean(jnp.exp(policies.log_std)),
        entropy=-jnp.mean(log_probs),
    )


@partial(jax.jit, static_argnums=0)
def judge(
    algorithm: CSAC, state: State, reference: MLP, observation: jax.Array, key: jax.Array
) -> tuple[jax.Array, ...]:
    """Return the policy's action, the smaller critic's value of it, and what the bracket of Eq. Q_CSAC subtracts."""
    noise = jax.random.normal(key, (state.actor.layers[-1].bias.shape[0] // 2,))
    policy = policy_at(state.actor, observation)
    sigma, tau = weights_of(algorithm)
    charge = sigma * policy.log_prob(noise) + tau * kl(policy, policy_at(reference, observation))
    action = policy.sample(noise)
    return action, least_q_value(state.critics, observation, action), charge


def roll_out(algorithm: CSAC, state: State, reference: MLP, environments: SeedEnvironments, key: jax.Array) -> Rollout:
    """Let the policy act, as it explores, from the start of an episode on."""
    observations = environments.reset()
    keys = jax.random.split(key, ROLLOUT_STEPS + 1)
    action, q_value, charge = judge(algorithm, state, reference, observations[0], keys[0])
    steps = []
    for step_key in keys[1:]:
        outcome = environments.step(np.asarray(action)[None])
        after = judge(algorithm, state, reference, outcome.next_observation[0], step_key)
        ended = bool(outcome.terminated[0] or outcome.truncated[0])
        steps.append(
            (observations[0], outcome.reward[0], outcome.terminated[0], ended, q_value, after[1], charge, after[2])
        )
        observations = outcome.observation
        following = judge(algorithm, state, reference, observations[0], step_key) if ended else after
        action, q_value, charge = following
    return Rollout(*(np.array(column) for column in zip(*steps, strict=True)))


def returns_of(rollout: Rollout, discount: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what Q_CSAC of each step ought to have been, r + γ (next one - charge), and of how many steps it is made.

    Where an episode is cut off, and at the end, the critic's own value stands for what would have come; a termination
    has nothing after it, and counts as if it were seen without end.
    """
    returns, ahead = np.zeros(len(rollout.reward)), np.zeros(len(rollout.reward))
    following, count = 0.0, 0.0
    for t in reversed(range(len(returns))):
        if rollout.ended[t] or t == len(returns) - 1:
            following, count = rollout.next_q_value[t], np.inf if rollout.terminated[t] else 0.0
        bootstrap = 0.0 if rollout.terminated[t] else following - rollout.next_charge[t]
        returns[t] = following = rollout.reward[t] + discount * bootstrap
        ahead[t] = count = count + 1
    return returns, ahead


def critic_error(rollout: Rollout, discount: float) -> dict[str, float]:
    """Return by how much the critic promises more than the policy gets, on average and as a root mean square."""
    returns, ahead = returns_of(rollout, discount)
    wrong = (rollout.q_value - returns)[ahead >= FEWEST_AHEAD]
    known = returns[ahead >= FEWEST_AHEAD]
    if not len(known):
        return {"monte_carlo": np.nan, "critic_bias": np.nan, "critic_rms": np.nan}
    return {
        "monte_carlo": float(known.mean()),
        "critic_bias": float(wrong.mean()),
        "critic_rms": float(np.sqrt((wrong**2).mean())),
    }


def run(name: str, task: str, steps: int, warmup_steps: int, seed: int, folder: Path) -> None:
    """Train one arm, look at it as it goes, and write its file into a folder."""
    algorithm = CSAC(warmup_steps=warmup_steps, **EVERY_ARM[name])
    environments, aside = (SeedEnvironments(task, None, [label]) for label in (seed, 10_000 + seed))
    learner = Learner(algorithm, environments.spec, [seed], steps)
    observations = environments.reset()
    actions = learner.next_actions(observations, 0)
    rows, held_out, at_last_look = [], None, None
    for step in range(1, steps + 1):
        is_look = step > algorithm.warmup_steps and step % INTERVAL == 0
        before = _copy(learner.carry(0).state.actor) if is_look else None
        outcome = environments.step(actions)
        actions = learner.step(observations, actions, outcome, step)
        observations = outcome.observation
        if not is_look:
            continue
        carry, key = learner.carry(0), jax.random.fold_in(jax.random.key(seed), step)
        state = _copy(carry.state)
        reference = reference_of(algorithm, state, step - algorithm.warmup_steps + 1)
        error = {}
        if len(rows) % LOOKS_PER_ROLLOUT == 0:
            rollout = roll_out(algorithm, state, reference, aside, key)
            held_out = jnp.asarray(rollout.observation[:: len(rollout.observation) // HELD_OUT][:HELD_OUT])
            error = critic_error(rollout, algorithm.discount)
        batches = draw(carry.memory.rows, step, environments.spec, algorithm.batch_size, np.random.default_rng(step))
        assert held_out is not None
        found = look(
            algorithm, state, before, at_last_look or state.actor, reference, jnp.asarray(batches), held_out, key
        )
        values = {key: float(value) for key, value in found._asdict().items()}
        if at_last_look is None:
            values["churn_since_last_look"] = np.nan
        at_last_look = state.actor
        rows.append({"step": step, **values, **error})
        print(f"{name}: step {step:,}, relative entropy {rows[-1]['relative_entropy']:.4g}", flush=True)
    environments.close()
    aside.close()
    folder.mkdir(parents=True, exist_ok=True)
    names = list(rows[0])
    lines = [",".join(names), *(",".join(_text(row.get(column)) for column in names) for row in rows)]
    write_atomically(_file(folder, name), ("\n".join(lines) + "\n").encode())


def draw(rows: np.ndarray, count: int, spec: Spec, batch_size: int, generator: np.random.Generator) -> np.ndarray:
    """Return observations [batch, state, observation] of a replay that holds `count` packed transitions."""
    chosen = generator.integers(min(count, len(rows)), size=(BATCHES, batch_size))
    return np.asarray(rows)[chosen][..., : spec.observation_size]


def show() -> None:
    """Write the figure, and print tables of the arms' means over the second half of their runs."""
    tables = {name: np.genfromtxt(_file(HERE, name), delimiter=",", names=True) for name in EVERY_ARM}
    _draw({name: tables[name] for name in ARMS})
    _print_means("second half of the run", {name: tables[name] for name in ARMS})
    print()
    _print_by_weight({name: tables[name] for name in (*BESIDE_WEIGHTS, *WEIGHTS)})


def _draw(tables: dict[str, np.ndarray]) -> None:
    from matplotlib.figure import Figure

    colours = {"algorithm1": "#0072B2", "previous": "#D55E00", "periodic": "#009E73", "average": "#CC79A7"}
    figure = Figure(figsize=(16, 7.5), layout="constrained")
    for axes, (column, title, is_log) in zip(figure.subplots(2, 4).flat, FIGURES, strict=True):
        for name, rows in tables.items():
            policy, _, estimator = name.partition(", ")
            known = ~np.isnan(rows[column]) & ((rows[column] > 1e-12) | (not is_log))
            style = "-" if estimator == "closed_form" else ":"
            axes.plot(rows["step"][known], rows[column][known], style, color=colours[policy], label=name, linewidth=1.4)
        axes.set_title(title, fontsize=10, loc="left")
        axes.set_yscale("log" if is_log else "linear")
        axes.grid(color="#E4E4E4")
        axes.set_xlabel("environment steps")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(ARMS) // 2, frameon=False)
    figure.savefig(HERE.with_suffix(".png"), dpi=110)


def _print_means(heading: str, tables: dict[str, np.ndarray]) -> None:
    columns = [column for column in next(iter(tables.values())).dtype.names or () if column != "step"]
    print("| " + " | ".join([heading, *tables]) + " |")
    print("| --- |" + " ---: |" * len(tables))
    for column in columns:
        means = [np.nanmean(rows[column][len(rows) // 2 :]) for rows in tables.values()]
        print("| " + " | ".join([column, *(f"{mean:.3g}" for mean in means)]) + " |")


def _print_by_weight(tables: dict[str, np.ndarray]) -> None:
    print("| arm | τ | τL | " + " | ".join(TOLD_BY_WEIGHT) + " |")
    print("| --- |" + " ---: |" * (2 + len(TOLD_BY_WEIGHT)))
    for name in sorted(tables, key=lambda name: _weight_and_lag(EVERY_ARM[name])[1]):
        means = [np.nanmean(tables[name][column][len(tables[name]) // 2 :]) for column in TOLD_BY_WEIGHT]
        weight, product = _weight_and_lag(EVERY_ARM[name])
        print("| " + " | ".join([name, f"{weight:g}", f"{product:,.4g}", *(f"{mean:.3g}" for mean in means)]) + " |")


def _weight_and_lag(arm: dict[str, Any]) -> tuple[float, float]:
    """Return τ and its product with the lag of the reference, in updates; a period counts whole."""
    lags = {"algorithm1": 0.0, "previous": 1.0, "average": 1.0 / arm["reference_rate"], "periodic": 1000.0}
    tau = arm["relative_entropy_weight"]
    return tau, tau * lags[arm["reference_policy"]]


def _file(folder: Path, name: str) -> Path:
    return folder / f"{name.replace(', ', '-').replace(' ', '-')}.csv"


def _text(value: float | None) -> str:
    return "" if value is None or np.isnan(value) else f"{value:.6g}"


def _copy(tree: Any) -> Any:
    return jax.tree.map(jnp.array, tree)


def main() -> None:
    """Run arms, or draw what there is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("draw", help="write mechanism.png, and print the tables of docs/relative-entropy.md")
    running = commands.add_parser("run", help="train and look")
    running.add_argument("arm", nargs="?", choices=tuple(EVERY_ARM))
    running.add_argument("--into", required=True, type=Path, metavar="FOLDER", help="of runs of one task and length")
    running.add_argument("--task", default="Hopper-v4")
    running.add_argument("--steps", type=int, default=5_000)
    running.add_argument("--warmup-steps", type=int, default=1_000)
    running.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.command == "draw":
        show()
        return
    names = [arguments.arm] if arguments.arm else list(EVERY_ARM)
    missing = [name for name in names if not _file(arguments.into, name).exists()]
    if not missing:
        sys.exit(f"every arm that is asked for has a file in {arguments.into}: nothing to run")
    for name in missing:
        run(name, arguments.task, arguments.steps, arguments.warmup_steps, arguments.seed, arguments.into)


if __name__ == "__main__":
    main()
