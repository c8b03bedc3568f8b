"""Measure the latency of an artefact's actions, call by call: back to back, and at the rate of a controller."""

from __future__ import annotations

import gc
import time
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from csac.deploy.c import Library
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from csac.deploy.artefact import Artefact

USUAL_RATE = 100.0  # Hz, if neither the contract nor the user gives one
MOST_CALLS = 10_000_000  # per measurement

_OBSERVATIONS = 1_024  # random observations, used in turn
_WARM_UP = 1_000  # calls that are not measured


class Latency(NamedTuple):
    """Measured times of single calls, in nanoseconds."""

    durations: np.ndarray
    """From right before each call to right after it, int64 [calls]."""
    lateness: np.ndarray | None = None
    """How late each call began after it was due, int64 [calls]; None if calls ran back to back."""
    rate: float | None = None
    """Scheduled calls per second; None if calls ran back to back."""


def measure(
    artefact: Artefact, calls: int = 100_000, rate: float | None = None, seconds: float = 10.0
) -> tuple[Latency, ...]:
    """Time an artefact's actions for `calls` calls back to back, and then for `seconds` at a fixed rate.

    An artefact in C is timed inside its compiled library, the others around `act`, with the garbage collector off.
    Observations are standard normal.

    Args:
        artefact: open it with `optimise` to time C code compiled for this machine.
        calls: at least 1.
        rate: Hz; by default the control rate of the task, or 100 if it is not known.
        seconds: 0 skips the second measurement.
    """
    rate = float((artefact.fields["control_rate_hz"] or USUAL_RATE) if rate is None else rate)
    paced = rate * seconds
    if not (1 <= calls <= MOST_CALLS and rate > 0 and seconds >= 0 and (paced == 0 or 1 <= paced <= MOST_CALLS)):
        raise InputError(
            f"calls {calls}, and seconds {seconds:g} at rate {rate:g}: both make from 1 to {MOST_CALLS:,} calls"
        )
    size = artefact.contract.spec.observation_size
    observations = list(np.random.default_rng(0).standard_normal((_OBSERVATIONS, size), np.float32))
    time_call = artefact.runner.time if isinstance(artefact.runner, Library) else _timed(artefact)
    time_calls(time_call, observations, _WARM_UP)
    measured = [Latency(time_calls(time_call, observations, calls)[0])]
    if seconds:
        measured.append(Latency(*time_calls(time_call, observations, round(paced), round(1e9 / rate)), rate))
    return tuple(measured)


def _timed(artefact: Artefact) -> Callable[[np.ndarray], int]:
    def time_call(observation: np.ndarray) -> int:
        began = time.perf_counter_ns()
        artefact.act(observation)
        return time.perf_counter_ns() - began

    return time_call


def time_calls(
    time_call: Callable[[np.ndarray], int], observations: list[np.ndarray], calls: int, period: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return how long each call took and how late it began, int64 [calls], for calls due every `period`, all in ns."""
    durations, lateness = np.zeros((2, calls), np.int64)
    due, is_collecting = time.perf_counter_ns(), gc.isenabled()
    gc.disable()
    try:
        for call in range(calls):
            due += period
            if period and (wait := due - time.perf_counter_ns()) > 0:
                time.sleep(wait / 1e9)
            lateness[call] = time.perf_counter_ns() - due if period else 0
            durations[call] = time_call(observations[call % len(observations)])
    finally:
        if is_collecting:
            gc.enable()
    return durations, lateness
