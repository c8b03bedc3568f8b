"""Verify that an artefact computes the same actions as its policy."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from csac.types import InputError

if TYPE_CHECKING:
    from csac.deploy.artefact import Artefact
    from csac.deploy.policy import Policy

TOLERANCE = 1e-5  # relative to an action's range
ROUNDING = 10.0  # times the policy's own float32 rounding error: an artefact's error may be as large
MOST_RECORDED = 2_000  # recorded observations that are compared at most
RANDOM = 1_000  # additional observations, with twice the standard deviation of those recorded


class Comparison(NamedTuple):
    """How far an artefact's actions are from the policy's, relative to an action's range."""

    observations: int
    largest: float
    allowed: float


def compare_actions(artefact: Artefact, policy: Policy, recorded: np.ndarray | None = None) -> Comparison:
    """Compare an artefact with its policy and guards, on observations `recorded` in episodes and on random ones.

    Raises InputError if actions differ by more than both 1e-5 of their range and ten times the policy's own float32
    rounding error on such observations.
    """
    generator, contract = np.random.default_rng(0), policy.contract
    observations = _observations(policy, recorded, generator)
    observations = observations[_is_clear(policy, observations)]
    rounding = np.abs(policy.act(observations) - policy.act(observations.astype(np.float64))).max(initial=0.0) / 2.0
    if artefact.guards.fallback is not None:
        broken = np.arange(2, len(observations), 7)
        places = generator.integers(observations.shape[1], size=len(broken))
        observations[broken, places] = generator.choice([np.nan, np.inf, -np.inf], len(broken))
    actions = contract.bounds.scale(policy.act(observations))
    span = contract.action_high.astype(np.float64) - contract.action_low
    span[span == 0.0] = 1.0
    largest, last = 0.0, None
    artefact.reset()
    for observation, action in zip(observations, actions, strict=True):
        last = artefact.guards.apply(action, observation, last, contract)
        difference = float((np.abs(artefact.act(observation).astype(np.float64) - last) / span).max())
        largest = max(largest, difference if np.isfinite(difference) else np.inf)
    artefact.reset()
    comparison = Comparison(len(observations), largest, max(TOLERANCE, ROUNDING * float(rounding)))
    if not comparison.largest <= comparison.allowed:
        raise InputError(
            f"the {artefact.fields['format']} artefact is not the policy of the run: its actions differ by up to "
            f"{comparison.largest:.1e} of their range (allowed: {comparison.allowed:.1e}); nothing was written"
        )
    return comparison


def _observations(policy: Policy, recorded: np.ndarray | None, generator: np.random.Generator) -> np.ndarray:
    """Return typical observations, and some farther away: float32 [n, observation]."""
    normaliser, size = policy.network.parameters.normaliser, policy.contract.spec.observation_size
    mean, std = (np.zeros(size), np.ones(size)) if normaliser is None else (normaliser.mean, normaliser.std)
    chosen = np.zeros((0, size))
    if recorded is not None:
        mean, std = recorded.mean(axis=0), recorded.std(axis=0)
        chosen = recorded[np.linspace(0, len(recorded) - 1, min(MOST_RECORDED, len(recorded))).astype(int)]
    random = mean + 2.0 * std * generator.standard_normal((RANDOM, size))
    return np.concatenate([chosen, random]).astype(np.float32)


def _is_clear(policy: Policy, observations: np.ndarray) -> np.ndarray:
    """Return [n], whether the critics' choice between the actors is clearer than rounding errors."""
    _, values = policy.candidates(observations, None)
    if values is None:
        return np.ones(len(observations), bool)
    second, first = np.sort(values, axis=0)[-2:]
    return first - second > 1e-4 * np.abs(first) + 1e-6
