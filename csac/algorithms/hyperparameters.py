"""The ranges that hyperparameters may take, said once for every algorithm."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

Limit = tuple["Callable[[Any], bool]", str]

POSITIVE: Limit = (lambda value: value > 0, "more than 0")
NOT_NEGATIVE: Limit = (lambda value: value >= 0, "0 or more")
COUNT: Limit = (lambda value: value >= 1, "at least 1")
RATE: Limit = (lambda value: 0 < value <= 1, "more than 0 and at most 1")
WIDTHS: Limit = (
    lambda value: isinstance(value, tuple | list) and all(_is_whole(width) and width >= 1 for width in value),
    "a tuple of whole numbers of at least 1",
)

LIMITS: dict[str, Limit] = {
    "entropy_weight": NOT_NEGATIVE,
    "relative_entropy_weight": NOT_NEGATIVE,
    "reference_period": COUNT,
    "reference_rate": RATE,
    "inverse_temperature": NOT_NEGATIVE,
    "noise_samples": COUNT,
    "exploration_noise": NOT_NEGATIVE,
    "target_noise": NOT_NEGATIVE,
    "target_noise_clip": NOT_NEGATIVE,
    "policy_delay": COUNT,
    "discount": (lambda value: 0 <= value < 1, "at least 0 and less than 1"),
    "target_rate": RATE,
    "trace_decay": (lambda value: 0 <= value <= 1, "from 0 to 1"),
    "learning_rate": POSITIVE,
    "actor_learning_rate": POSITIVE,
    "critic_learning_rate": POSITIVE,
    "temperature_learning_rate": POSITIVE,
    "hidden_sizes": WIDTHS,
    "actor_hidden_sizes": WIDTHS,
    "critic_hidden_sizes": WIDTHS,
    "batch_size": COUNT,
    "rollout_steps": COUNT,
    "minibatches": COUNT,
    "epochs": COUNT,
    "clip_range": POSITIVE,
    "value_loss_weight": NOT_NEGATIVE,
    "normalisation_limit": POSITIVE,
    "adam_epsilon": POSITIVE,
    "replay_size": COUNT,
    "warmup_steps": NOT_NEGATIVE,
    "updates_per_step": COUNT,
    "update_interval": COUNT,
    "max_gradient_norm": NOT_NEGATIVE,
}


def check_hyperparameters(algorithm: Any) -> None:
    """Refuse a value outside its range or its choices.

    Raises:
        InputError: the first such field, its value and what it may be.
    """
    hints = get_type_hints(type(algorithm))
    for field in dataclasses.fields(algorithm):
        value, hint = getattr(algorithm, field.name), hints[field.name]
        if get_origin(hint) is Literal and value not in get_args(hint):
            raise InputError(f"{field.name} must be one of {', '.join(get_args(hint))}, not {value!r}")
        if hint is bool and not isinstance(value, bool):
            raise InputError(f"{field.name} must be true or false, not {value!r}")
        if hint is int and not _is_whole(value):
            raise InputError(f"{field.name} must be a whole number, not {value!r}")
        optional = hint == float | None and value is None
        if hint in (float, float | None) and not optional and not _is_finite(value):
            raise InputError(f"{field.name} must be a finite number, not {value!r}")
        accepts, words = LIMITS.get(field.name, (lambda _: True, ""))
        if not accepts(value):
            raise InputError(f"{field.name} must be {words}, not {value!r}")


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
