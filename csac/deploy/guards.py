"""Guards between a policy and an actuator: a fallback for non-finite numbers, and a limit on the action's change.

This is the reference: artefacts of every format implement it in their own language and are tested against it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.deploy.contract import BOUNDS_ROUNDING, FLOAT32_MAX
from csac.types import InputError

if TYPE_CHECKING:
    from csac.deploy.contract import Contract


@dataclass(frozen=True, eq=False)
class Guards:
    """What an artefact checks and limits; nothing without a `fallback`. Arrays are float32 [action].

    If any number of the observation or of the policy's action is not finite, the action is replaced: by the previous
    action if `repeats_last` is set and there is one, else by `fallback`. `largest_change` is how far each action, even
    a fallback, may be from the previous one; the first action after a reset is not limited.
    """

    fallback: np.ndarray | None = None
    repeats_last: bool = False
    largest_change: np.ndarray | None = None

    @property
    def has_state(self) -> bool:
        """Whether an action depends on the previous one."""
        return self.repeats_last or self.largest_change is not None

    def fields(self) -> dict[str, Any]:
        """Return the fields as JSON values."""
        return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in vars(self).items()}

    @staticmethod
    def of_fields(fields: dict[str, Any], contract: Contract) -> Guards:
        """Return the guards with these `fields`. Raises KeyError, TypeError or ValueError if they are invalid."""
        fallback, change = (
            None if fields[name] is None else np.array(fields[name], np.float32)
            for name in ("fallback", "largest_change")
        )
        for array in (fallback, change):
            if array is not None and (array.shape != contract.action_low.shape or not np.isfinite(array).all()):
                raise ValueError("the guards do not fit the actions")
        return Guards(fallback, bool(fields["repeats_last"]), change)

    def apply(
        self, action: np.ndarray, observation: np.ndarray, last: np.ndarray | None, contract: Contract
    ) -> np.ndarray:
        """Return the action to send, a new array [action]; `last` is the action sent before, None after a reset."""
        if self.fallback is not None and not (np.isfinite(observation).all() and np.isfinite(action).all()):
            action = last if self.repeats_last and last is not None else self.fallback
        if self.largest_change is not None and last is not None:
            action = np.clip(action, last - self.largest_change, last + self.largest_change)
            action = np.clip(action, contract.action_low, contract.action_high)
        return action.copy()


def make_guards(contract: Contract, fallback: str | None = None, rate_limit: float | None = None) -> Guards:
    """Return the guards for `--fallback` and `--rate-limit`. Raises InputError.

    `fallback` is `zero`, `middle` (of the bounds), `last` (the previous action), or comma-separated numbers, one per
    action. `rate_limit` is how much an action may change in a step, as a share of its range. It needs a fallback,
    because NaN cannot be limited: `last` by default.
    """
    low, high, half = contract.action_low, contract.action_high, contract.bounds.half
    change = None
    if rate_limit is not None:
        if not 0.0 < rate_limit <= 1.0:
            raise InputError(f"--rate-limit {rate_limit}: give a share of the action's range, more than 0, at most 1")
        fallback = fallback or "last"
        change = np.minimum(np.float32(2.0 * rate_limit) * half, np.float32(FLOAT32_MAX))
    if fallback is None:
        return Guards()
    if fallback in ("middle", "last"):
        return Guards(contract.bounds.centre, fallback == "last", change)
    if fallback == "zero":
        return Guards(np.clip(np.zeros_like(low), low, high), False, change)
    try:
        numbers = np.array([float(word) for word in fallback.split(",")], np.float32)
    except ValueError:
        raise InputError(f"--fallback {fallback}: give zero, middle, last, or numbers such as 0,0.5") from None
    if numbers.shape != low.shape:
        raise InputError(f"--fallback {fallback} is {len(numbers)} numbers where the task has {len(low)} actions")
    bounded = np.clip(numbers, low, high)  # the contract's bounds are the task's, rounded inwards to float32
    if not (np.abs(numbers - bounded) <= BOUNDS_ROUNDING * np.maximum(np.abs(low), np.abs(high))).all():
        raise InputError(f"--fallback {fallback} is outside of the action's bounds")
    return Guards(bounded, False, change)
