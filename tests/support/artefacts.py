"""Artefacts on disk, as an export leaves them, and what is put into them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csac.deploy.artefact import Artefact, open_artefact
from csac.deploy.artefact_contract import ArtefactContract, Format
from csac.deploy.policy import Policy
from csac.deploy.writing import write_artefact

FORMATS: tuple[Format, ...] = ("numpy", "onnx", "c")
HAS_COMPILER = shutil.which("cc") is not None
needs_compiler = pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler here")
WITHOUT_ABSOLUTE_SLEEP = """\
#define _POSIX_C_SOURCE 200112L
#include <time.h>
#undef TIMER_ABSTIME
#pragma GCC poison clock_nanosleep
"""  # what precedes a source in C, to compile it as where this is not there
LOW, HIGH = np.full(5, -1.5), np.full(5, 1.5)
GUARDED: dict[str, Any] = {
    "fallback": "last",
    "observation_low": LOW,
    "observation_high": HIGH,
    "watchdog": 4,
    "rate_limit": 0.02,
}


def leave(folder: Path, policy: Policy, format: Format, **fields: Any) -> ArtefactContract:
    """Write an artefact, and return its contract."""
    folder.mkdir(exist_ok=True)
    return write_artefact(folder, policy.network, ArtefactContract(policy.contract, format, **fields))


def exported(folder: Path, policy: Policy, format: Format, **fields: Any) -> Artefact:
    """Write an artefact and open it; that in C is compiled."""
    leave(folder, policy, format, **fields)
    return open_artefact(folder)


def observations(size: int, count: int = 40, seed: int = 0) -> np.ndarray:
    """Around zero, far away, and at the origin."""
    drawn = np.random.default_rng(seed).normal(size=(count, size))
    drawn[count // 2 :] *= 100.0
    drawn[0] = 0.0
    return drawn.astype(np.float32)


def together(artefact: Artefact, given: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
    """The actions of an artefact, one observation after the other."""
    rows = range(len(given))
    return np.stack([artefact.act(given[row], None if noise is None else noise[row]) for row in rows])
