"""Conservative Soft Actor-Critic and its baselines in JAX.

    from csac import CSAC, evaluate, train

    run = train(CSAC(), "HalfCheetah-v4", steps=60_000)
    returns = evaluate(run.policy(), "HalfCheetah-v4", episodes=100)

The names are resolved on first use: importing csac imports neither JAX nor Gymnasium.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from csac.algorithms import CSAC, PPO, SAC, SD3, TD3
    from csac.deploy.choosing import load
    from csac.deploy.policy import Policy
    from csac.evaluation.evaluator import evaluate, evaluate_episodes
    from csac.training.callbacks import Callback, SaveEvery, StopAfterNoImprovement, StopOnReturn
    from csac.training.learnt import load_checkpoint
    from csac.training.train import resume, train
    from csac.types import InputError

    __version__: str

__all__ = [
    "CSAC",
    "PPO",
    "SAC",
    "SD3",
    "TD3",
    "Callback",
    "InputError",
    "Policy",
    "SaveEvery",
    "StopAfterNoImprovement",
    "StopOnReturn",
    "__version__",
    "evaluate",
    "evaluate_episodes",
    "load",
    "load_checkpoint",
    "resume",
    "train",
]

_MODULES = {
    "csac.algorithms": {"CSAC", "PPO", "SAC", "SD3", "TD3"},
    "csac.deploy.choosing": {"load"},
    "csac.deploy.policy": {"Policy"},
    "csac.evaluation.evaluator": {"evaluate", "evaluate_episodes"},
    "csac.training.callbacks": {"Callback", "SaveEvery", "StopAfterNoImprovement", "StopOnReturn"},
    "csac.training.learnt": {"load_checkpoint"},
    "csac.training.train": {"resume", "train"},
    "csac.types": {"InputError"},
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value = import_module("importlib.metadata").version("csac")
    else:
        module = next((module for module, names in _MODULES.items() if name in names), None)
        if module is None:
            raise AttributeError(f"module 'csac' has no attribute {name!r}")
        value = getattr(import_module(module), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
