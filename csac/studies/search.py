"""The search spaces of `csac tune`: which hyperparameters, over which ranges, and when they have an effect."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from csac.algorithms.hyperparameters import without_effect
from csac.checks import did_you_mean
from csac.record.config import RunConfig, as_json
from csac.seeds import EVALUATION_SEED
from csac.studies.arms import train_command
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import optuna

    from csac.types import Algorithm

DIGITS = 3  # significant digits of a number that is tried
REPORT_SEEDS = 5  # in the command that trains the best configuration

Dimension = tuple[Literal["log", "linear", "below 1", "one of"], *tuple[Any, ...]]  # a scale, and its bounds or values
Space = dict[str, Dimension]

_RATE: Dimension = ("log", 3e-5, 3e-3)
_DISCOUNT: Dimension = ("below 1", 0.95, 0.999)
_ENTROPY: Space = {"entropy_weight": ("log", 0.01, 1.0), "weight_learning_rate": _RATE}
_NOISE: Space = {"exploration_std": ("log", 0.03, 0.5), "target_noise": ("log", 0.05, 0.5)}
_OFF_POLICY: Space = {
    "actor_learning_rate": _RATE,
    "critic_learning_rate": _RATE,
    "discount": _DISCOUNT,
    "target_rate": ("log", 0.001, 0.05),
    "batch_size": ("one of", 64, 128, 256, 512),
}
_REFERENCE: Space = {"reference_period": ("log", 100, 10_000), "reference_rate": ("log", 0.005, 0.5)}
_ROLLOUT: Space = {"rollout_steps": ("one of", 512, 1024, 2048, 4096), "minibatches": ("one of", 8, 16, 32, 64)}
_CLIPPED: Space = {
    "clip_range": ("linear", 0.1, 0.4),
    "entropy_weight": ("linear", 0.0, 0.02),
    "epochs": ("linear", 3, 20),
}

# Networks and updates per step are not searched: more of either costs time, which a budget of steps does not count.
SPACES: Mapping[str, Space] = {
    "csac": {**_ENTROPY, "relative_entropy_weight": ("log", 0.005, 50.0), **_REFERENCE, **_OFF_POLICY},
    "sac": {**_ENTROPY, **_OFF_POLICY},
    "td3": {"policy_delay": ("linear", 1, 4), **_NOISE, **_OFF_POLICY},
    "sd3": {"inverse_temperature": ("log", 0.001, 0.5), **_NOISE, **_OFF_POLICY},
    "ppo": {
        "learning_rate": _RATE,
        "discount": _DISCOUNT,
        "trace_decay": ("below 1", 0.8, 0.99),
        **_CLIPPED,
        **_ROLLOUT,
    },
}


def sample(trial: optuna.Trial, name: str, dimension: Dimension) -> Any:
    """Let a trial choose a value; for "below 1", the distance to 1 is drawn on a logarithmic scale."""
    scale, *ends = dimension
    if scale == "one of":
        return trial.suggest_categorical(name, ends)
    if isinstance(ends[0], int):
        return trial.suggest_int(name, *ends, log=scale == "log")
    if scale == "below 1":
        return round(1 - _rounded(trial.suggest_float(name, _rounded(1 - ends[1]), _rounded(1 - ends[0]), log=True)), 9)
    return _rounded(trial.suggest_float(name, *ends, log=scale == "log"))


def space_of(algorithm: Algorithm, wanted: Sequence[str] | None = None, given: Sequence[str] = ()) -> Space:
    """Return the hyperparameters to search: those `wanted` that have an effect, are not `given` and not learnt."""
    values: dict[str, Any] = dataclasses.asdict(algorithm)  # pyright: ignore[reportArgumentType]
    family = getattr(algorithm, "name", type(algorithm).__name__)  # a user's subclass is searched like its base class
    space = {name: one for name, one in SPACES.get(family, {}).items() if name in values}
    fixed = {*given, *without_effect(algorithm)}
    if values.get("critic_normalisation", "none") != "none":
        fixed.add("target_rate")
    if values.get("reference_period") == 1:
        fixed.add("reference_period")
    free = {name: dimension for name, dimension in space.items() if name not in fixed and values[name] != "auto"}
    for name in wanted or ():
        if name not in space:
            hint = did_you_mean(name, space) or f"there is {', '.join(space)}"
            raise InputError(f"{name!r} is not searched for {family}: {hint}")
        if name not in free:
            raise InputError(f"{name} cannot be searched: it is given, learnt, or does nothing with the other options")
    found = {name: dimension for name, dimension in free.items() if wanted is None or name in wanted}
    for name, dimension in found.items():
        if dimension[0] == "one of" and values[name] not in dimension:  # a default of the user's own class
            found[name] = (*dimension, values[name])
    if not found:
        raise InputError(f"there is nothing to search for {family}: its search space is empty, or given")
    return found


@dataclass(frozen=True, kw_only=True)
class Search:
    """The definition of a search, on which all processes that share a directory agree."""

    config: RunConfig
    """The configuration of a trial's first seed, apart from the searched hyperparameters."""
    seeds: int
    algorithm: Algorithm
    """The first trial's hyperparameters; those that are not searched keep these values."""
    space: Space

    def __post_init__(self) -> None:
        first = self.algorithm.cadence.side_by_side(self.config.environments).first_update
        if self.config.steps < first:
            raise InputError(f"no updates: steps ({self.config.steps:,}) < {first:,}, where the first one comes")
        if not self.config.evaluation_interval:
            raise InputError("a search goes by evaluations: evaluation_interval cannot be 0")

    def definition(self) -> dict[str, Any]:
        """Return the search as JSON-compatible values."""
        searched = {name: f"searched, {' '.join(map(str, dimension))}" for name, dimension in self.space.items()}
        settings = {name: value for name, value in vars(self.config).items() if name != "device"}
        return as_json("the search", {**settings, "seeds": self.seeds, **self._hyperparameters(searched)})

    def command(self, values: Mapping[str, Any]) -> str:
        """Return the command that trains a configuration with seeds that the search has not used."""
        first = 0 if self.config.seed >= REPORT_SEEDS else self.config.seed + self.seeds
        config = dataclasses.replace(
            self.config, device="cpu", evaluation_seed=EVALUATION_SEED, **self._hyperparameters(values)
        )
        return train_command(config, range(first, first + REPORT_SEEDS))

    def _hyperparameters(self, values: Mapping[str, Any]) -> dict[str, Any]:
        own: dict[str, Any] = dataclasses.asdict(self.algorithm)  # pyright: ignore[reportArgumentType]
        return {"hyperparameters": {**own, **values}}


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
