"""What papers and other libraries call our options, and what of theirs has none here. Data, and one look-up."""

from __future__ import annotations

import re
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection

_RATES = ("--actor-learning-rate and --critic-learning-rate", "--learning-rate")
_SIZES = ("--actor-hidden-sizes and --critic-hidden-sizes", "--hidden-sizes")

# Of the words for an option, those count whose options the command has. Some are another algorithm's own.
_CALLED_OTHERWISE = MappingProxyType(
    {
        "--tau": ("--relative-entropy-weight", "--target-rate"),
        "--sigma": ("--entropy-weight",),
        "--alpha": ("--entropy-weight",),
        "--ent-coef": ("--temperature", "--entropy-weight"),
        "--gamma": ("--discount",),
        "--polyak": ("--target-rate",),
        "--learning-starts": ("--warmup-steps",),
        "--buffer-size": ("--replay-size",),
        "--train-freq": ("--update-interval",),
        "--gradient-steps": ("--updates-per-step",),
        "--total-timesteps": ("--steps",),
        "--eval-freq": ("--evaluation-interval",),
        "--n-eval-episodes": ("--evaluation-episodes",),
        "--track": ("--wandb",),
        "--out": ("--video",),
        "--env-kwargs": ("--environment-arguments",),  # in Python
        "--lr": _RATES,
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
        "--n-envs": "each seed has one environment, and --seeds says how many",
        "--verbose": "none is needed",
        "--env": "the task has no flag: csac train Pendulum-v1",
        "--task": "the task has no flag: csac train Pendulum-v1",
    }
)


def called_here(option: str, known: Collection[str]) -> str:
    """Return what the `known` options have for one of another name, as "it is --discount here", or nothing."""
    words = [word for word in _CALLED_OTHERWISE.get(option, ()) if {*re.findall(r"--[a-z-]+", word)} <= {*known}]
    if words:
        return f"it is {' or '.join(words)} here"
    return _NEEDLESS.get(option, "") if "--seeds" in known else ""
