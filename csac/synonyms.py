"""What papers and other libraries call our options, and what of theirs has none here. Data, and one look-up."""

from __future__ import annotations

import re
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection

_RATES = ("--actor-learning-rate and --critic-learning-rate", "--learning-rate")
_ENVIRONMENTS = "each seed has one environment, and --seeds says how many"
_TASK = "the task has no flag: csac train Pendulum-v1"
_SIZES = ("--actor-hidden-sizes and --critic-hidden-sizes", "--hidden-sizes")

# Of the words for an option, those count whose options the command has. Some are another algorithm's own.
_CALLED_OTHERWISE = MappingProxyType(
    {
        "--tau": ("--relative-entropy-weight", "--target-rate"),
        "--rho": ("--target-rate",),
        "--sigma": ("--entropy-weight",),
        "--alpha": ("--entropy-weight",),
        "--ent-coef": ("--entropy-weight",),
        "--gamma": ("--discount",),
        "--polyak": ("--target-rate",),
        "--learning-starts": ("--warmup-steps",),
        "--start-steps": ("--warmup-steps",),
        "--buffer-size": ("--replay-size",),
        "--train-freq": ("--update-interval",),
        "--gradient-steps": ("--updates-per-step",),
        "--policy-frequency": ("--policy-delay",),
        "--n-steps": ("--rollout-steps",),
        "--total-timesteps": ("--steps",),
        "--seed": ("--first-seed",),
        "--eval-freq": ("--evaluation-interval",),
        "--n-eval-episodes": ("--evaluation-episodes",),
        "--track": ("--wandb",),
        "--wandb-project": ("--wandb",),
        "--exp-name": ("--directory",),
        "--cuda": ("--device gpu",),
        "--gpu": ("--device gpu",),
        "--autotune": ("--entropy-weight auto",),
        "--temperature": ("--entropy-weight (a number, or auto)",),
        "--temperature-learning-rate": ("--weight-learning-rate",),
        "--out": ("--video",),
        "--deterministic": ("the default, without --stochastic,",),
        "--env-kwargs": ("--environment-arguments",),  # in Python
        "--lr": _RATES,
        "--policy-lr": ("--actor-learning-rate",),
        "--actor-lr": ("--actor-learning-rate",),
        "--critic-lr": ("--critic-learning-rate",),
        "--q-lr": ("--critic-learning-rate",),
        "--learning-rate": _RATES,
        "--actor-learning-rate": _RATES,
        "--critic-learning-rate": _RATES,
        "--net-arch": _SIZES,
        "--hidden-sizes": _SIZES,
        "--actor-hidden-sizes": _SIZES,
        "--critic-hidden-sizes": _SIZES,
        "--batch-size": ("--minibatches (their number)",),
    }
)
_NEEDLESS = MappingProxyType(
    {
        "--n-envs": _ENVIRONMENTS,
        "--num-envs": _ENVIRONMENTS,
        "--environments": _ENVIRONMENTS,
        "--verbose": "none is needed",
        "--env": _TASK,
        "--env-id": _TASK,
        "--task": _TASK,
    }
)

_WRITTEN_FORMERLY = MappingProxyType(
    {
        ("reference_policy", "previous"): 'reference_policy="average", reference_rate=1',
        ("reference_policy", "algorithm1"): 'reference_policy="periodic", reference_period=1',
    }
)


def called_here(option: str, known: Collection[str]) -> str:
    """Return what the `known` options have for one of another name, as "it is --discount here", or nothing."""
    words = [word for word in _CALLED_OTHERWISE.get(option, ()) if {*re.findall(r"--[a-z-]+", word)} <= {*known}]
    if words:
        return f"it is {' or '.join(words)} here"
    return _NEEDLESS.get(option, "") if "--seeds" in known else ""


def called_in_python(name: str, known: Collection[str]) -> str:
    """Return what the `known` arguments have for one of another name, as "it is discount here", or nothing."""
    flag, *flags = ("--" + word.replace("_", "-") for word in (name, *known))
    told = re.sub(r"(--[a-z-]+) (auto|gpu)", r'\1="\2"', called_here(flag, flags))
    return re.sub(r"--[a-z-]+", lambda match: match[0][2:].replace("-", "_"), told)


def written_in_python(name: str, value: object) -> str:
    """Return how a value of former versions is written now, or nothing."""
    now = _WRITTEN_FORMERLY.get((name, str(value)), "")
    return now and f"write {now}"
