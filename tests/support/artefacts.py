"""Artefacts on disk, as an export leaves them, and what is put into them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csac.deploy.artefact import Artefact, Format, open_artefact, write_artefact
from csac.deploy.guards import Guards
from csac.deploy.policy import Policy

FORMATS: tuple[Format, ...] = ("numpy", "onnx", "c")
HAS_COMPILER = shutil.which("cc") is not None
NO_GUARDS = Guards()
needs_compiler = pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler here")


def leave(folder: Path, policy: Policy, format: Format, guards: Guards = NO_GUARDS, **facts: Any) -> Path:
    """Write an artefact, and return its folder."""
    folder.mkdir(exist_ok=True)
    write_artefact(folder, policy, format, guards, facts)
    return folder


def exported(folder: Path, policy: Policy, format: Format, guards: Guards = NO_GUARDS) -> Artefact:
    """Write an artefact and open it; that in C is compiled."""
    return open_artefact(leave(folder, policy, format, guards))


def observations(size: int, count: int = 40, seed: int = 0) -> np.ndarray:
    """Around zero, far away, and at the origin."""
    drawn = np.random.default_rng(seed).normal(size=(count, size))
    drawn[count // 2 :] *= 100.0
    drawn[0] = 0.0
    return drawn.astype(np.float32)


def together(artefact: Artefact, given: np.ndarray) -> np.ndarray:
    """The actions of an artefact, one observation after the other."""
    return np.stack([artefact.act(observation) for observation in given])
