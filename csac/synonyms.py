"""Names of our options in papers and other libraries."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

_RATES = "--actor-learning-rate and --critic-learning-rate"
_SIZES = "--actor-hidden-sizes and --critic-hidden-sizes"

NAMES: Mapping[str, str] = {
    "--tau": "--relative-entropy-weight (the paper's tau) or --target-rate (Polyak's)",
    "--rho": "--target-rate",
    "--polyak": "--target-rate",
    "--sigma": "--entropy-weight",
    "--alpha": "--entropy-weight",
    "--ent-coef": "--entropy-weight",
    "--temperature": "--entropy-weight (a number, or auto)",
    "--autotune": "--entropy-weight auto",
    "--temperature-learning-rate": "--weight-learning-rate",
    "--gamma": "--discount",
    "--lr": _RATES,
    "--learning-rate": _RATES,
    "--policy-lr": "--actor-learning-rate",
    "--q-lr": "--critic-learning-rate",
    "--net-arch": _SIZES,
    "--hidden-sizes": _SIZES,
    "--batch-size": "--minibatches (their number)",
    "--buffer-size": "--replay-size",
    "--learning-starts": "--warmup-steps",
    "--train-freq": "--update-interval",
    "--gradient-steps": "--updates-per-step",
    "--policy-frequency": "--policy-delay",
    "--n-steps": "--rollout-steps",
    "--total-timesteps": "--steps",
    "--seed": "--first-seed",
    "--n-envs": "--environments",
    "--num-envs": "--environments",
    "--eval-freq": "--evaluation-interval",
    "--n-eval-episodes": "--evaluation-episodes",
    "--env-kwargs": "--environment-arguments",  # in Python
    "--environment-arguments": "--env-kwargs",  # of Python, on the command line
    "--perturbations": "--perturb",
    "--start-from": "--from",
    "--groups": "--seeds-per-process",
    "--cuda": "--device gpu",
    "--track": "--wandb",
    "--out": "--video",
}


def option_hint(option: str, known: Collection[str]) -> str:
    """Return a hint such as "it is --discount here" if `option` is another name of a `known` one, else ""."""
    names_here = NAMES.get(option, "")
    return f"it is {names_here} here" if {*re.findall(r"--[a-z-]+", names_here)} & {*known} else ""


def argument_hint(name: str, known: Collection[str]) -> str:
    """Return a hint such as "it is discount here" if `name` is another name of a `known` one, else ""."""
    flag, *flags = ("--" + word.replace("_", "-") for word in (name, *known))
    return re.sub(r"--[a-z-]+", lambda match: match[0][2:].replace("-", "_"), option_hint(flag, flags))
