"""How long an artefact takes for one action: flat out, and at the rate of a controller, call by call."""

from __future__ import annotations

import ctypes
import gc
import time
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from csac.deploy.artefact import C_STANDARD, compile_c, header_alone, open_artefact
from csac.deploy.templates import LATENCY
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from csac.deploy.artefact import Artefact

NANOSECONDS = 10**9
USUAL_RATE = 100.0  # Hz, where neither the contract nor anybody says one
OBSERVATIONS = 1024  # that are gone through in turn
WARM_UP = 1_000  # calls that nobody counts
MOST_CALLS = 100_000_000  # of one measurement: each takes 16 bytes
MOST_SECONDS = 1e9  # that are waited for a call: more nanoseconds would not be a number in C
SLOWEST = 10  # times the time between two calls that are due: a measurement takes as many times as long as was asked
SECONDS_OF_A_PART = 0.25  # of a measurement at a rate: between two parts a Ctrl-C is heard


class Latency(NamedTuple):
    """What was measured of single calls, in nanoseconds."""

    durations: np.ndarray
    """From right before a call to right after it, int64 [calls]."""
    lateness: np.ndarray | None = None
    """How long after it was due a call began, int64 [calls]; None where calls followed each other at once."""
    rate: float | None = None
    """Calls a second that were due."""


class Measure(Protocol):
    """Makes calls: so many, `period` nanoseconds apart (0: at once)."""

    def __call__(self, calls: int, period: int, durations: np.ndarray, lateness: np.ndarray, due: int = 0) -> int:
        """Write the nanoseconds of each call, and how late it began, int64 [calls]; return when the last was due.

        The first is due a period after `due`, by the clock of these calls, or after now where that is 0.
        """
        ...


def measure(path: str | Path, calls: int = 100_000, rate: float | None = None, seconds: float = 10.0) -> list[Latency]:
    """Return what an artefact takes flat out, and then at a rate.

    An artefact in C is timed inside of a compiled program, one in Python around `act`, with the garbage collector off.
    Observations are random, between the task's bounds where they are known, and standard normal else: what a network
    costs does not depend on them, but for denormal numbers and the saturation of `tanh`.

    Args:
        path: the artefact's folder.
        calls: how many follow each other flat out, from 1 to 100,000,000.
        rate: Hz; by default the control rate of the task, or 100 where it is not known.
        seconds: how long calls are made at the rate, at least one and at most as many; 0 leaves that out.

    Raises:
        InputError: no artefact there, nothing here to run it with, arguments out of their range, or a rate that is
            more than ten times what calls can be made at.
    """
    artefact = open_artefact(path)
    rate = check_measurement(artefact, calls, rate, seconds)
    make_calls = (
        _measure_c(artefact) if artefact.format == "c" else measure_python(artefact.act, _observations(artefact))
    )
    _in_parts(make_calls, WARM_UP, WARM_UP, 0)
    durations, _ = _in_parts(make_calls, calls, WARM_UP, 0)
    several = [Latency(durations)]
    if seconds:
        part, period = max(1, round(rate * SECONDS_OF_A_PART)), round(NANOSECONDS / rate)
        usual = float(np.median(durations))
        if usual > SLOWEST * period:
            raise InputError(
                f"{path}: at {rate:g} Hz a call is due every {period:,} ns, and one takes {usual:,.0f} ns: "
                "give a lower rate"
            )
        several.append(Latency(*_in_parts(make_calls, round(rate * seconds), part, period), rate))
    return several


def check_measurement(artefact: Artefact, calls: int, rate: float | None, seconds: float) -> float:
    """Return the rate to measure at, in Hz. Raises InputError for what `measure` does not take."""
    if calls < 1:
        raise InputError(f"calls must be at least 1, not {calls}")
    if calls > MOST_CALLS:
        raise InputError(f"calls must be at most {MOST_CALLS:,}, not {calls:,}")
    if rate is not None and not 0 < rate <= NANOSECONDS:
        raise InputError(f"the rate must be more than 0 Hz and at most 1e9, not {rate:g}")
    if not 0 <= seconds <= MOST_SECONDS:
        raise InputError(f"seconds must be 0 or more and at most {MOST_SECONDS:g}, not {seconds:g}")
    rate = rate or artefact.contract.control_rate or USUAL_RATE
    if seconds > 0 and rate * seconds < 1:
        raise InputError(
            f"{seconds:g} seconds at {rate:g} Hz are less than one call: give more seconds or a higher rate"
        )
    if rate * seconds > MOST_CALLS:
        raise InputError(f"{seconds:g} seconds at {rate:g} Hz are more than {MOST_CALLS:,} calls: take fewer seconds")
    return rate


def measure_python(act: Callable[[np.ndarray], object], observations: np.ndarray) -> Measure:
    """Return what makes calls of a function of Python, on observations [n, observation] in turn."""
    several = list(observations)

    def make_calls(calls: int, period: int, durations: np.ndarray, lateness: np.ndarray, due: int = 0) -> int:
        clock, count = time.perf_counter_ns, len(several)
        due, is_collecting = due or clock(), gc.isenabled()
        gc.disable()
        try:
            for call in range(calls):
                due += period
                if period and (wait := due - clock()) > 0:
                    time.sleep(wait / NANOSECONDS)
                began = clock()
                act(several[call % count])
                durations[call] = clock() - began
                lateness[call] = began - due if period else 0
        finally:
            if is_collecting:
                gc.enable()
        return due

    return make_calls


def _in_parts(make_calls: Measure, calls: int, part: int, period: int) -> tuple[np.ndarray, np.ndarray]:
    durations, lateness = np.zeros((2, calls), np.int64)
    due = 0
    for begin in range(0, calls, part):
        some = slice(begin, begin + part)
        due = make_calls(len(durations[some]), period, durations[some], lateness[some], due)
    return durations, lateness


def _measure_c(artefact: Artefact) -> Measure:
    """Return what makes calls inside of a compiled program, so that none of Python's time is in them."""
    with header_alone(artefact.folder, artefact.contract) as place:
        library = place / "latency.so"
        compile_c(
            *C_STANDARD,
            "-I",
            place,
            "-fPIC",
            "-shared",
            "-O3",
            "-march=native",
            LATENCY,
            "-o",
            library,
            "-lm",
        )
        function = ctypes.CDLL(str(library)).latency_measure  # stays in memory without its file
    function.restype = ctypes.c_int64
    observations = _observations(artefact)

    def make_calls(calls: int, period: int, durations: np.ndarray, lateness: np.ndarray, due: int = 0) -> int:
        return function(
            ctypes.c_void_p(observations.ctypes.data),
            ctypes.c_int64(len(observations)),
            ctypes.c_int64(calls),
            ctypes.c_int64(period),
            ctypes.c_void_p(durations.ctypes.data),
            ctypes.c_void_p(lateness.ctypes.data),
            ctypes.c_int64(due),
        )

    return make_calls


def _observations(artefact: Artefact) -> np.ndarray:
    """Return random observations, float32 [n, observation]: the same for artefacts of one policy."""
    contract, generator = artefact.contract, np.random.default_rng(0)
    shape = (OBSERVATIONS, contract.policy.spec.observation_size)
    normal, uniform = generator.standard_normal(shape), generator.random(shape)
    if contract.observation_low is None or contract.observation_high is None:
        return normal.astype(np.float32)
    low, high = contract.observation_low, contract.observation_high
    bounded = np.isfinite(low) & np.isfinite(high) & (np.abs(low) < 1e6) & (np.abs(high) < 1e6)
    between = np.where(bounded, low, 0.0) + uniform * (np.where(bounded, high, 1.0) - np.where(bounded, low, 0.0))
    return np.ascontiguousarray(np.where(bounded, between, normal), np.float32)
