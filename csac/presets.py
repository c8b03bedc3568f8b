"""Presets of hyperparameters by algorithm and task: `paper` has the paper's tables, `strong` faster critics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

# Actor and critics have the same activation, and no layer norm.
_ALIKE: Mapping[str, Any] = {
    "actor_activation": None,
    "critic_activation": None,
    "layer_norm": False,
    "actor_layer_norm": None,
    "critic_layer_norm": None,
}

# The paper's "Common hyper-parameter settings of compared approaches": its columns CSAC, SAC and TD3 are equal.
_PAPER_COMMON: Mapping[str, Any] = {
    "actor_learning_rate": 3e-4,
    "critic_learning_rate": 3e-4,
    "actor_hidden_sizes": (256, 256),
    "critic_hidden_sizes": (256, 256),
    "target_rate": 0.005,
    "batch_size": 256,
    "replay_size": 1_000_000,
    "warmup_steps": 10_000,
    "discount": 0.99,
    # Not in the table, but in the equations and in Algorithm 1: one update per step, no clipping.
    "updates_per_step": 1,
    "update_interval": 1,
    "max_gradient_norm": 0.0,
    "n_steps": 1,
    "normalise_rewards": False,
    "learning_rate_schedule": "constant",
    "exploration_noise": "white",
    "activation": "relu",
    **_ALIKE,
}

# What the table leaves out for TD3 and SD3; the papers of both have the same values.
_NOISE: Mapping[str, Any] = {"exploration_std": 0.1, "target_noise": 0.2, "target_noise_clip": 0.5}

_PAPER: Mapping[str, Mapping[str, Any]] = {
    # "For CSAC, sigma was set to 0.2 and tau to 0.5 across all MuJoCo tasks"; Algorithm 1 for the reference policy.
    "csac": {
        **_PAPER_COMMON,
        "entropy_weight": 0.2,
        "relative_entropy_weight": 0.5,
        "reference_policy": "periodic",
        "reference_period": 1,
        "relative_entropy_estimator": "sampled",
    },
    # PARL's SAC, on which the paper built: a fixed temperature.
    "sac": {**_PAPER_COMMON, "entropy_weight": 0.2},
    "td3": {**_PAPER_COMMON, **_NOISE, "policy_delay": 2},
    # The paper's column SD3, and the settings of SD3's authors for what it leaves out.
    "sd3": {
        **_PAPER_COMMON,
        **_NOISE,
        "actor_learning_rate": 1e-3,
        "critic_learning_rate": 1e-3,
        "inverse_temperature": 0.05,
        "noise_samples": 50,
        "importance_sampling": False,
    },
    # The paper's column PPO ("batch size 32" read as 32 minibatches), and PARL's example for what it leaves out.
    "ppo": {
        "learning_rate": 3e-4,
        "learning_rate_schedule": "linear",
        "hidden_sizes": (64, 64),
        "activation": "tanh",
        **_ALIKE,
        "discount": 0.99,
        "trace_decay": 0.95,
        "rollout_steps": 2048,
        "minibatches": 32,
        "epochs": 10,
        "clip_range": 0.2,
        "clip_value_loss": True,
        "value_loss_weight": 0.5,
        "entropy_weight": 0.0,
        "max_gradient_norm": 0.5,
        "adam_epsilon": 1e-5,
        "normalise_advantages": True,
        "normalise_observations": True,
        "normalise_rewards": True,
        "normalisation_limit": 10.0,
    },
}

# The paper's "Specific hyperparameters of CSAC", whose PandaReach row equals the MuJoCo tasks' values, and the inverse
# temperatures of SD3's authors.
_SD3_TASKS = (("Ant", 0.001), ("HalfCheetah", 0.005), ("Hopper", 0.05), ("Walker2d", 0.1))
_PAPER_TASKS: Mapping[tuple[str, str], Mapping[str, Any]] = {
    ("csac", "PyFlyt/QuadX-Waypoints-v1"): {"relative_entropy_weight": 0.1},
    **{("sd3", f"{task}-v{v}"): {"inverse_temperature": beta} for task, beta in _SD3_TASKS for v in (4, 5)},
}

# Critics that learn faster: parts and sources in docs/algorithms/critics.md, runs in results/strong.
# One setting for all tasks. It names every value, so that new defaults cannot change what was measured.
_FASTER_CRITICS: Mapping[str, Any] = {
    **_PAPER_COMMON,
    "critic_normalisation": "batch",
    "normalise_observations": True,
    "critic_learning_rate": 1e-3,
    "actor_learning_rate": 1e-3,
    "policy_delay": 3,
    "adam_momentum": 0.5,
    "n_steps": 2,
    "warmup_steps": 5_000,
    "entropy_weight": "auto",
    "initial_entropy_weight": 0.01,
    "target_entropy": None,
    "target_entropy_per_dimension": -0.5,
    "weight_learning_rate": 1e-3,
    "policy_average_rate": 1.0,
}

_STRONG: Mapping[str, Mapping[str, Any]] = {
    "csac": {
        **_FASTER_CRITICS,
        "relative_entropy_weight": 0.5,
        "relative_entropy_form": "explicit",
        "reference_policy": "periodic",
        "reference_period": 1000,
        "relative_entropy_estimator": "closed_form",
        "target_log_prob_bound": 1.0,
        "relative_entropy_bound": 100.0,
    },
    "sac": _FASTER_CRITICS,
}

_ALGORITHMS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {"paper": _PAPER, "strong": _STRONG}
_TASKS: Mapping[str, Mapping[tuple[str, str], Mapping[str, Any]]] = {"paper": _PAPER_TASKS}

PRESETS: tuple[str, ...] = tuple(_ALGORITHMS)


def hyperparameters(preset: str, algorithm: str, task: str) -> dict[str, Any]:
    """Return the hyperparameters, by field name, that `preset` gives `algorithm` on `task`.

    `task` is a Gymnasium id, with or without the module in front; a task that the preset does not name gets the
    algorithm's values for all tasks.

    Raises:
        InputError: unknown preset, a preset without the algorithm, or a task that is not a string.
    """
    if preset not in PRESETS:
        raise InputError(f"no preset is called {preset!r}: choose {' or '.join(PRESETS)}")
    if not isinstance(task, str):
        raise InputError(f"task is a Gymnasium id such as 'Hopper-v4', not {task!r:.40}")
    algorithms = _ALGORITHMS[preset]
    if algorithm not in algorithms:
        raise InputError(f"the preset {preset!r} has no {algorithm!r}: it has {' and '.join(algorithms)}")
    return {**algorithms[algorithm], **_TASKS.get(preset, {}).get((algorithm, task.rpartition(":")[2]), {})}
