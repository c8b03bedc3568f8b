"""An actor that moves once in a few updates of its critics: TD3 (Fujimoto et al. 2018), CrossQ (Bhatt et al. 2024)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from csac.algorithms.shapes import Count
from csac.types import Metrics

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


def make_first_metrics(names: Iterable[str], delay: int) -> Metrics | None:
    """Return what an actor that waits tells before it first moved, 0 each; None where it moves at every update."""
    return None if delay == 1 else {name: jnp.zeros(()) for name in names}


def improve_delayed(
    delay: int, step: Count, improve: Callable[..., tuple[Any, Metrics]], state: Any, *given: Any
) -> tuple[Any, Metrics]:
    """Return `improve(state, *given)` at every `delay`-th update, else the state as it is and its metrics.

    Args:
        delay: updates of the critics for each improvement of the actor.
        step: updates before this one; the last of each `delay` improves, as in TD3's Algorithm 1.
        improve: returns a state and metrics. It is not computed where it is not due.
        state: has a field `actor_metrics`: those of the last improvement, or None where the delay is 1.
        given: what else `improve` takes.
    """
    if delay == 1:
        return improve(state, *given)
    is_due = (step + 1) % delay == 0
    state, metrics = jax.lax.cond(is_due, improve, lambda state, *_: (state, state.actor_metrics), state, *given)
    return state._replace(actor_metrics=metrics), metrics
