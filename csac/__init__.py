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
    from csac.algorithms.csac import CSAC
    from csac.algorithms.ppo import PPO
    from csac.algorithms.sac import SAC
    from csac.algorithms.sd3 import SD3
    from csac.algorithms.td3 import TD3
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
    "CSAC": "csac.algorithms.csac",
    "PPO": "csac.algorithms.ppo",
    "SAC": "csac.algorithms.sac",
    "SD3": "csac.algorithms.sd3",
    "TD3": "csac.algorithms.td3",
    "Callback": "csac.training.callbacks",
    "SaveEvery": "csac.training.callbacks",
    "StopAfterNoImprovement": "csac.training.callbacks",
    "StopOnReturn": "csac.training.callbacks",
    "InputError": "csac.types",
    "Policy": "csac.deploy.policy",
    "evaluate": "csac.evaluation.evaluator",
    "evaluate_episodes": "csac.evaluation.evaluator",
    "load": "csac.deploy.choosing",
    "load_checkpoint": "csac.training.learnt",
    "train": "csac.training.train",
    "resume": "csac.training.train",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value = import_module("importlib.metadata").version("csac")
    elif name in _MODULES:
        value = getattr(import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module 'csac' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
