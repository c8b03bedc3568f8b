"""Manifests of runs that nobody has trained."""

from __future__ import annotations

from typing import Any

from csac.record.config import RunConfig
from csac.record.manifest import Manifest

CONFIG = set(RunConfig.__dataclass_fields__)


def manifest(**values: Any) -> Manifest:
    """A finished run of SAC on Hopper, but for what is given of its configuration or of the manifest itself."""
    values = {"task": "Hopper-v4", "algorithm": "sac", "steps": 100, **values}
    config = RunConfig(**{name: value for name, value in values.items() if name in CONFIG})
    others = {name: value for name, value in values.items() if name not in CONFIG}
    return Manifest(config=config, **{"state": "finished", "steps_done": config.steps, **others})
