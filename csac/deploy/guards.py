"""What stands between a policy and an actuator: bad observations, fallback actions, limits on change.

This is the definition. An artefact of every format has the same in its own language, and is tested against this one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from csac.deploy.contract import BOUNDS_ROUNDING, FLOAT32_MAX
from csac.types import InputError

if TYPE_CHECKING:
    from csac.deploy.contract import Contract

Fallback = Literal["zero", "middle", "last", "given"]

LONGEST_WATCHDOG = 2**24  # an ONNX graph counts in float32, where one more would be no more


@dataclass(frozen=True, eq=False)
class Guards:
    """What an artefact checks and limits; everything float32.

    Without a `fallback` there are none. With one, a step is bad where a number of the observation is
    not within `observation_low` and `observation_high` [observation] (which no NaN is), or where the policy's own
    action is not finite. Then the fallback stands in for the policy's action: `fallback_action` [action], or for
    "last" the action before, and `fallback_action` where there was none. After `watchdog` bad steps one after another
    it stays so until a reset; 0 waits for ever.

    `largest_change` [action] is how far each action may be from the one before, that of a fallback too. After a reset
    there is none before, so that the first one is not limited.
    """

    observation_low: np.ndarray | None = None
    observation_high: np.ndarray | None = None
    fallback: Fallback | None = None
    fallback_action: np.ndarray | None = None
    watchdog: int = 0
    largest_change: np.ndarray | None = None

    @property
    def is_any(self) -> bool:
        """Whether anything is checked or limited."""
        return self.fallback is not None

    @property
    def has_state(self) -> bool:
        """Whether what a step gives depends on those before it."""
        return self.fallback == "last" or self.watchdog > 0 or self.largest_change is not None

    def fields(self) -> dict[str, Any]:
        """Return what JSON holds of it."""
        return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in vars(self).items()}

    @staticmethod
    def of_fields(fields: Any, contract: Contract) -> Guards:
        """Return the guards that `fields` made these of. Raises KeyError, TypeError or ValueError for anything else."""
        observation_size, action_size = contract.spec

        def numbers(name: str, size: int) -> np.ndarray | None:
            if fields[name] is None:
                return None
            array = np.array(fields[name], np.float32)
            if array.shape != (size,) or not np.isfinite(array).all():
                raise ValueError(f"{name} is not {size} numbers")
            return array

        guards = Guards(
            numbers("observation_low", observation_size),
            numbers("observation_high", observation_size),
            fields["fallback"],
            numbers("fallback_action", action_size),
            fields["watchdog"],
            numbers("largest_change", action_size),
        )
        if guards.fallback not in (None, *get_args(Fallback)):
            raise ValueError(f"fallback {guards.fallback!r:.40} is not known")
        if type(guards.watchdog) is not int or not 0 <= guards.watchdog <= LONGEST_WATCHDOG:
            raise ValueError(f"watchdog {guards.watchdog!r:.40} is no number of steps")
        belongs = (guards.observation_low, guards.observation_high, guards.fallback_action)
        if any((array is None) != (guards.fallback is None) for array in belongs):
            raise ValueError("fallback and observation bounds disagree")
        if guards.fallback is None and (guards.watchdog or guards.largest_change is not None):
            raise ValueError("there is a watchdog or a limit without a fallback")
        guards._check_numbers(contract)
        return guards

    def _check_numbers(self, contract: Contract) -> None:
        """Raise ValueError for numbers that `make_guards` gives for no policy of this contract."""
        low, high, action = self.observation_low, self.observation_high, self.fallback_action
        if low is not None and high is not None and not (low <= high).all():
            raise ValueError("the observation bounds of the guards are not in order")
        if action is not None and not ((action >= contract.action_low) & (action <= contract.action_high)).all():
            raise ValueError("fallback_action is outside of the action's bounds")
        if self.largest_change is not None and not (self.largest_change >= 0).all():
            raise ValueError("largest_change is negative")


NO_GUARDS = Guards()


@dataclass
class GuardState:
    """What guards remember from step to step; a new one is what a reset gives."""

    last: np.ndarray | None = None  # [action], the action that was returned last
    bad: int = 0  # steps one after another that were bad, no more than the watchdog waits for


def guarded(
    guards: Guards, state: GuardState, contract: Contract, observation: np.ndarray, action: np.ndarray
) -> np.ndarray:
    """Return what leaves instead of the policy's `action` [action] at `observation` [observation]; changes `state`.

    With guards it is an array of the caller's own: neither the fallback nor the state changes with it.
    """
    if not guards.is_any:
        return action
    is_inside = (observation >= guards.observation_low) & (observation <= guards.observation_high)
    is_bad = not (is_inside.all() and np.isfinite(action).all())
    if state.bad < guards.watchdog:
        state.bad = state.bad + 1 if is_bad else 0
    if is_bad or 0 < guards.watchdog <= state.bad:
        last = state.last if guards.fallback == "last" else None
        assert guards.fallback_action is not None
        action = guards.fallback_action if last is None else last
    if guards.largest_change is not None and state.last is not None:
        action = np.clip(action, state.last - guards.largest_change, state.last + guards.largest_change)
        action = np.clip(action, contract.action_low, contract.action_high)
    state.last = action.copy()
    return action.copy()


def make_guards(
    contract: Contract,
    fallback: str | None = None,
    observation_low: np.ndarray | None = None,
    observation_high: np.ndarray | None = None,
    watchdog: int | None = None,
    rate_limit: float | None = None,
) -> Guards:
    """Return guards out of what a person asks for.

    Args:
        contract: of the policy.
        fallback: what stands in for the action where an observation is bad: `zero`, `middle` of the bounds, `last`
            action, or numbers with commas between them, one for each action. None looks at no observation.
        observation_low: [observation], the least that is taken for good; infinite, or None, where anything finite is.
        observation_high: [observation], the most.
        watchdog: after so many bad observations in a row, at most 2^24, only the fallback is left, until a reset.
        rate_limit: how much an action may change in a step, as a share of its range. It needs a fallback, since an
            action that is not a number cannot be limited; without one it is `last`.

    Raises:
        InputError: numbers or combinations that cannot be meant.
    """
    if rate_limit is not None:
        fallback = fallback or "last"
    if fallback is None and any(given is not None for given in (watchdog, observation_low, observation_high)):
        raise InputError(
            "a watchdog and a range of observations need a --fallback action: zero, middle, last or numbers"
        )
    if watchdog is not None and watchdog < 1:
        raise InputError(f"a watchdog that waits for {watchdog} bad observations: give at least 1")
    if watchdog is not None and watchdog > LONGEST_WATCHDOG:
        raise InputError(f"a watchdog that waits for {watchdog:,} bad observations: give at most {LONGEST_WATCHDOG:,}")
    change = None
    if rate_limit is not None:
        if not 0.0 < rate_limit <= 1.0:
            raise InputError(
                f"a rate limit of {rate_limit}: give a share of the action's range, more than 0, at most 1"
            )
        half = 0.5 * contract.action_high - 0.5 * contract.action_low  # a wide range may not overflow
        change = np.minimum(np.float32(2.0 * rate_limit) * half, np.float32(FLOAT32_MAX))
    if fallback is None:
        return NO_GUARDS
    size = contract.spec.observation_size
    low, high = (
        np.full(size, end) if given is None else np.clip(given, -FLOAT32_MAX, FLOAT32_MAX).astype(np.float32)
        for given, end in ((observation_low, np.float32(-FLOAT32_MAX)), (observation_high, np.float32(FLOAT32_MAX)))
    )
    kind, action = _fallback(fallback, contract)
    return Guards(low, high, kind, action, watchdog or 0, change)


def _fallback(text: str, contract: Contract) -> tuple[Fallback, np.ndarray]:
    """Return what kind of fallback a person has given, and its action [action]."""
    middle = 0.5 * contract.action_high + 0.5 * contract.action_low
    match text:
        case "middle" | "last":
            return text, middle
        case "zero":
            return text, np.clip(np.zeros_like(middle), contract.action_low, contract.action_high)
    try:
        action = np.array([float(word) for word in text.split(",")], np.float32)
    except ValueError:
        raise InputError(f"--fallback {text}: it is zero, middle, last, or numbers such as 0,0.5") from None
    if action.shape != middle.shape:
        raise InputError(f"--fallback {text} is {len(action)} numbers where the task has {len(middle)} actions")
    low, high = contract.action_low, contract.action_high
    bounded = np.clip(action, low, high)  # the contract's bounds are the task's, rounded inwards to float32
    if not (np.abs(action - bounded) <= BOUNDS_ROUNDING * np.maximum(np.abs(low), np.abs(high))).all():
        raise InputError(f"--fallback {text} is outside of the action's bounds")
    return "given", bounded
