"""What a group is told, without a run around it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from csac.training.messages import Settings
from csac.training.plan import Plan
from csac.types import Algorithm


def settings(
    algorithm: Algorithm, task: Any, steps: int, checkpoints: Path | None = None, begin: int = 0, **options: Any
) -> Settings:
    """Return settings of a plan that is evaluated at its end alone and never saved, but for `options`."""
    options = {"evaluation_interval": steps, "evaluation_episodes": 1, "checkpoint_interval": 0, **options}
    plan = Plan(algorithm=algorithm, task=task, task_name=str(task), groups=(), steps=steps, **options)
    return Settings(plan, checkpoints, begin)
