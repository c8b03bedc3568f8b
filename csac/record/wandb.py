"""Log the curves of a run to Weights & Biases, one W&B run each, with TensorBoard's tags. Errors never end a run."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from typing import TYPE_CHECKING, Any

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from csac.record.run import RunDirectory

_SETTINGS = {"silent": True, "console": "off", "init_timeout": 30.0, "finish_timeout": 30.0}


def import_wandb() -> Any:
    """Import and return the wandb module. Raises InputError if it is not installed."""
    try:
        import wandb
    except ImportError:
        wandb = None
    if not hasattr(wandb, "init"):  # a folder named wandb, which W&B itself creates, can be imported too
        raise InputError("W&B is not installed: pip install '.[wandb]' in a clone of csac")
    return wandb


class WandbLog:
    """Log to a run's W&B run; without an API key, to files in the run's directory, which `wandb sync` uploads."""

    def __init__(self, run: RunDirectory, project: bool | str) -> None:
        wandb, mode = import_wandb(), os.environ.get("WANDB_MODE", "online")
        mode = "offline" if mode == "online" and not wandb.api.api_key else mode
        project_file = run.path / "wandb" / "project.txt"  # for when the run is resumed
        default_project = project_file.read_text() if project_file.exists() else os.environ.get("WANDB_PROJECT", "csac")
        self._run = wandb.init(
            project=project if isinstance(project, str) else default_project,
            group="/".join(run.path.parts[-3:-1]),
            name=f"{run.path.parent.name} {run.path.name}",
            id=hashlib.sha256(f"{run.path} {run.manifest.created}".encode()).hexdigest()[:16],
            resume="allow" if mode == "online" else None,
            mode=mode,
            config=dataclasses.asdict(run.config),
            dir=str(run.path),
            reinit="create_new",
            settings=wandb.Settings(**_SETTINGS),
        )
        project_file.write_text(self._run.project)
        self._run.define_metric("*", step_metric="global_step")  # W&B's own step counter would refuse a late evaluation

    def write(self, points: Mapping[int, Mapping[str, float]]) -> None:
        """Log the values of each step."""
        for step, values in points.items():
            self._run.log({**values, "global_step": step})

    def close(self) -> None:
        """Finish the W&B run."""
        self._run.finish()
