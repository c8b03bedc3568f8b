"""Manifests of runs that nobody has trained."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from csac.record.config import RunConfig
from csac.record.manifest import Manifest
from csac.record.run import RunDirectory
from csac.record.sets import RunSet

CONFIG = set(RunConfig.__dataclass_fields__)


def manifest(**values: Any) -> Manifest:
    """A finished run of SAC on Hopper, but for what is given of its configuration or of the manifest itself."""
    values = {"task": "Hopper-v4", "algorithm": "sac", "steps": 100, **values}
    config = RunConfig(**{name: value for name, value in values.items() if name in CONFIG})
    others = {name: value for name, value in values.items() if name not in CONFIG}
    return Manifest(config=config, **{"state": "finished", "steps_done": config.steps, **others})


def make_set(
    path: str | Path, seeds: Iterable[int] = (0,), failures: Mapping[int, str] | None = None, **values: Any
) -> RunSet:
    """A set of runs that nobody has trained, of these seeds, some of which failed."""
    for seed in seeds:
        reason = (failures or {}).get(seed, "")
        told = {"failure": reason, "state": "failed"} if reason else {}
        RunDirectory.create(Path(path, f"seed-{seed}"), manifest(seed=seed, **{**values, **told}))
    return RunSet.open(path)
