"""Whether an artefact is the policy that was trained: action by action, and in closed loop."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from csac.deploy.guards import GuardState, guarded
from csac.evaluation.evaluator import Evaluator, evaluate_episodes
from csac.record.rendering import number
from csac.record.statistics import FEWEST_FOR_INTERVAL, mean_and_interval
from csac.tasks.seeds import FRESH_EVALUATION_SEED
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from csac.deploy.artefact import Artefact
    from csac.deploy.contract import Contract
    from csac.deploy.policy import Policy
    from csac.tasks.registry import Task

TOLERANCE = 1e-5  # of an action's range
ROUNDING = 10.0  # times what float32 does to the policy itself on such observations: an artefact may be no worse
ABSURD = 0.1  # of the range, on average: whole numbers for weights cost a hundredth of it
IMPLAUSIBLE = 1e-4  # a chance so small is none

MOST_RECORDED = 2_000  # observations of the episodes that are compared
RANDOM = 1_000  # observations in each random group
BLOCK = 50  # broken observations from one reset to the next: guards have something to remember
BROKEN = "broken"
LARGEST_BOUND = 1e6  # a bound beyond it says nothing of what is to be expected


class Recording(NamedTuple):
    """What a policy saw in evaluation episodes [n, observation], and the return of each [episode]."""

    observations: np.ndarray
    returns: np.ndarray
    starts_alike: bool = False
    """Whether every episode began in one state: without noise they are one episode, played again and again."""


class Compared(NamedTuple):
    """How far an artefact is from the policy on one kind of observations, as shares of an action's range."""

    name: str
    observations: int
    largest: float
    mean: float
    rounding: float
    """How far the policy is from itself in float64."""

    @property
    def allowed(self) -> float:
        """The largest difference that an artefact with the policy's own numbers may have."""
        return max(TOLERANCE, ROUNDING * self.rounding)


@dataclass(frozen=True)
class Returns:
    """Returns of the same episodes, through the policy of the run and through the artefact: [episode]."""

    policy: np.ndarray
    artefact: np.ndarray
    starts_alike: bool = False

    @property
    def chance(self) -> float:
        """The chance that equal policies have means so far apart (Welch's t-test); 1 below two episodes that differ."""
        from scipy import special  # slow to import

        if len(self.policy) < 2:
            return 1.0
        difference = abs(self.policy.mean() - self.artefact.mean())
        # Where all episodes are alike, returns differ by rounding alone.
        difference = max(0.0, difference - 1e-4 * np.abs(self.policy).max())
        variances = np.array([values.var(ddof=1) / len(values) for values in (self.policy, self.artefact)])
        if variances.sum() == 0.0:
            return 1.0 if difference == 0.0 or self.starts_alike else 0.0
        freedom = variances.sum() ** 2 / (variances**2 / (len(self.policy) - 1)).sum()
        return float(2.0 * special.stdtr(freedom, -difference / np.sqrt(variances.sum())))


def record(
    policy: Policy,
    task: Task,
    environment_arguments: dict[str, Any] | None = None,
    episodes: int = 10,
    deterministic: bool = True,
) -> Recording:
    """Play the episodes of `csac evaluate` with a policy and keep what it sees.

    Raises:
        InputError, EvaluationFailure: as `Evaluator.run`.
    """
    evaluator, seen = Evaluator(task, environment_arguments, episodes, FRESH_EVALUATION_SEED), []
    evaluator.watch = seen.append
    try:
        played = evaluator.run(policy, deterministic)
    finally:
        evaluator.close()
    starts_alike = bool((seen[0] == seen[0][0]).all())
    return Recording(np.concatenate(seen), np.array([episode.episode_return for episode in played]), starts_alike)


def compare_actions(artefact: Artefact, policy: Policy, recorded: np.ndarray | None = None) -> list[Compared]:
    """Run an artefact beside the policy on thousands of observations; its guards have the state of a new episode after.

    Args:
        artefact: what is tested.
        policy: what it was made of.
        recorded: observations of episodes, [n, observation]; None where there are none.

    Raises:
        InputError: the artefact is another policy: a difference above 1e-5 of the action's range, or above ten times
            what float32 itself does to the policy on such observations.
    """
    generator = np.random.default_rng(0)
    results = []
    for name, observations in _observations(artefact, policy, recorded, generator).items():
        results.append(_compare(name, artefact, policy, observations, generator))
    artefact.reset()
    is_exact = artefact.contract.weights == "float32"
    for result in results:
        if not (result.largest <= result.allowed if is_exact else result.mean <= ABSURD):
            allowed = f"{result.allowed:.1e}" if is_exact else f"{ABSURD} on average"
            raise InputError(
                f"the {artefact.format} artefact is not the policy of the run: on {result.name} observations its "
                f"actions differ by up to {result.largest:.1e} of their range (allowed: {allowed}); nothing was written"
            )
    return results


def compare_returns(
    artefact: Artefact,
    reference: Recording,
    task: Task,
    environment_arguments: dict[str, Any] | None = None,
) -> Returns:
    """Play the episodes of a recording again, through an artefact.

    Tasks are chaotic: from the last bit on, episodes go their own way, and only their statistics can agree.

    Raises:
        InputError: the mean return is so far off that chance does not explain it, of an artefact without guards and
            with the policy's own numbers: the others may be worse, and say so.
        EvaluationFailure: as `evaluate_episodes`.
    """
    played = evaluate_episodes(artefact, task, len(reference.returns), environment_arguments=environment_arguments)
    returns = Returns(
        reference.returns, np.array([episode.episode_return for episode in played]), reference.starts_alike
    )
    is_same = artefact.contract.weights == "float32" and not artefact.contract.guards.is_any
    if is_same and returns.chance < IMPLAUSIBLE:
        raise InputError(
            f"in closed loop the {artefact.format} artefact is not the policy of the run: {_told(returns.artefact)} "
            f"where the policy has {_told(returns.policy)}; nothing was written"
        )
    return returns


def _told(returns: np.ndarray) -> str:
    mean = float(returns.mean())
    return f"a mean return of {number(mean)} ± {number(float(returns.std(ddof=1)), mean)}"


def _observations(
    artefact: Artefact, policy: Policy, recorded: np.ndarray | None, generator: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return observations by their kind, each [n, observation] float32."""
    size = policy.contract.spec.observation_size
    low, high = _expected(artefact, policy, recorded)
    centre, reach = 0.5 * (low + high), 0.5 * (high - low)

    def random(factor: float) -> np.ndarray:
        drawn = centre + factor * reach * generator.uniform(-1.0, 1.0, (RANDOM, size))
        drawn[:2] = centre - factor * reach, centre + factor * reach
        return drawn.astype(np.float32)

    groups = {}
    if recorded is not None:
        chosen = np.linspace(0, len(recorded) - 1, min(MOST_RECORDED, len(recorded))).astype(int)
        groups["recorded"] = recorded[chosen]
    groups |= {"random": random(1.0), "10 times as far": random(10.0), "1,000 times as far": random(1000.0)}
    if artefact.contract.guards.fallback is not None:
        groups[BROKEN] = _broken(groups.get("recorded", groups["random"])[:RANDOM], artefact, generator)
    return groups


def _broken(observations: np.ndarray, artefact: Artefact, generator: np.random.Generator) -> np.ndarray:
    """Return observations of which every other one has a number that the guards refuse, some by the last bit."""
    broken, most = observations.copy(), artefact.contract.guards.observation_high
    rows = np.flatnonzero(generator.random(len(broken)) < 0.5)
    places = generator.integers(broken.shape[1], size=len(rows))
    wrong = np.tile(np.array([np.nan, np.inf, -np.inf, np.nan], np.float32), (len(rows), 1))
    if most is not None:
        with np.errstate(over="ignore"):  # above the largest of all numbers is infinity
            wrong[:, 3] = np.nextafter(most[places], np.float32(np.inf))
    broken[rows, places] = wrong[np.arange(len(rows)), generator.integers(4, size=len(rows))]
    return broken


def _expected(artefact: Artefact, policy: Policy, recorded: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return between which bounds observations are to be expected: the task's, else those seen, else a guess.

    What guards refuse is not among them.
    """
    normaliser, size = policy.network.parameters.normaliser, policy.contract.spec.observation_size
    low, high = np.full(size, -3.0), np.full(size, 3.0)
    if normaliser is not None:
        low, high = normaliser.mean - 3.0 * normaliser.std, normaliser.mean + 3.0 * normaliser.std
    if recorded is not None:
        low, high = recorded.min(axis=0), recorded.max(axis=0)
    contract = artefact.contract
    if contract.observation_low is not None and contract.observation_high is not None:
        low = np.where(np.abs(contract.observation_low) < LARGEST_BOUND, contract.observation_low, low)
        high = np.where(np.abs(contract.observation_high) < LARGEST_BOUND, contract.observation_high, high)
    if contract.guards.observation_low is not None and contract.guards.observation_high is not None:
        low, high = np.maximum(low, contract.guards.observation_low), np.minimum(high, contract.guards.observation_high)
    return low.astype(np.float64), high.astype(np.float64)


def _compare(
    name: str, artefact: Artefact, policy: Policy, observations: np.ndarray, generator: np.random.Generator
) -> Compared:
    """Run both, with a reset before each observation: what guards remember is tried on the broken ones alone."""
    contract, noise, block = policy.contract, None, BLOCK if name == BROKEN else 1
    if artefact.contract.noise_seed is not None:
        noise = generator.standard_normal((len(observations), contract.spec.action_size)).astype(np.float32)
    actions, rounding, is_candidate = _candidates(policy, observations, noise)
    span = contract.action_high.astype(np.float64) - contract.action_low
    span[span == 0.0] = 1.0
    differences, state = [], GuardState()
    for row, observation in enumerate(observations):
        if row % block == 0:
            artefact.reset()
            state = GuardState()
        answer = artefact.act(observation, None if noise is None else noise[row])
        possible = [
            (_distance(answer, expected, span), after)
            for expected, after in _expectations(
                artefact, state, contract, observation, actions[:, row], is_candidate[:, row]
            )
        ]
        difference, state = min(possible, key=lambda item: item[0])
        differences.append(difference)
    return Compared(name, len(observations), max(differences), float(np.mean(differences)), rounding)


def _candidates(
    policy: Policy, observations: np.ndarray, noise: np.ndarray | None
) -> tuple[np.ndarray, float, np.ndarray]:
    """Return each actor's actions [actor, n, action], how far float32 takes them, and which may be the chosen one.

    Where two actors are valued alike but for rounding, either may be chosen: [actor, n].
    """
    actions, values = policy.candidates(observations, noise)
    exact_actions, exact_values = policy.candidates(observations.astype(np.float64), noise)
    error = np.abs(actions - exact_actions)
    rounding = float(error[np.isfinite(error)].max(initial=0.0)) / 2.0
    is_candidate = np.ones(actions.shape[:2], bool)
    if values is not None and exact_values is not None:
        off = np.abs(values - exact_values)
        slack = ROUNDING * off[np.isfinite(off)].max(initial=0.0)
        is_candidate = ~(exact_values < exact_values.max(axis=0) - slack)
    scaled = policy.contract.to_environment(actions.reshape(-1, actions.shape[-1]))
    return scaled.reshape(actions.shape), rounding, is_candidate


def _expectations(
    artefact: Artefact,
    state: GuardState,
    contract: Contract,
    observation: np.ndarray,
    actions: np.ndarray,
    is_candidate: np.ndarray,
) -> Iterator[tuple[np.ndarray, GuardState]]:
    """Yield what may leave at an observation, and the state of the guards after it."""
    for action in actions[is_candidate]:
        after = copy.copy(state)
        yield guarded(artefact.contract.guards, after, contract, observation, action), after


def _distance(answer: np.ndarray, expected: np.ndarray, span: np.ndarray) -> float:
    """Return the largest difference as a share of each action's range; infinite where one of them is not a number."""
    difference = float((np.abs(answer.astype(np.float64) - expected) / span).max())
    return difference if np.isfinite(difference) else np.inf


def returns_as_fields(returns: np.ndarray) -> dict[str, Any]:
    """Return what a contract says of returns: how many, their mean, spread and 95 % t-interval; nulls for too few."""
    over, count = mean_and_interval(returns), len(returns)
    return {
        "episodes": count,
        "mean_return": float(over.mean),
        "standard_deviation": float(returns.std(ddof=1)) if count > 1 else None,
        "interval_95": [float(over.low), float(over.high)] if count >= FEWEST_FOR_INTERVAL else None,
    }
