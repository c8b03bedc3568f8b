"""Where `csac tune` looks: of each algorithm the hyperparameters that are searched, how far, and why so far.

Not searched are the networks and the updates per step, since more of either costs time, which a search by steps does
not see; nor what changes speed alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from csac.record.rendering import Cell, Row, Table
from csac.studies.cells import similar
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import optuna

DIGITS = 3  # of a number that is tried: more say nothing, and are long to type


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`; on the scale "to 1", their distance to 1 is drawn on a logarithmic scale."""

    low: float
    high: float
    scale: Literal["linear", "logarithmic", "to 1"]
    why: str
    needs: tuple[str, Any] | None = None
    """A hyperparameter, and the value without which this one means nothing."""

    def draw(self, trial: optuna.Trial, name: str) -> float | int:
        """Have a trial choose a value; Optuna knows it as `drawn_as(name)`."""
        if isinstance(self.low, int):
            return trial.suggest_int(name, self.low, int(self.high), log=self.scale == "logarithmic")
        if self.scale == "to 1":
            distance = trial.suggest_float(
                self.drawn_as(name), _rounded(1 - self.high), _rounded(1 - self.low), log=True
            )
            return round(1 - _rounded(distance), 9)
        return _rounded(trial.suggest_float(name, self.low, self.high, log=self.scale == "logarithmic"))

    def drawn_as(self, name: str) -> str:
        """Return what Optuna calls the parameter."""
        return f"1 - {name}" if self.scale == "to 1" else name

    def as_drawn(self, value: Any) -> Any:
        """Return what Optuna has to draw for this value."""
        return _rounded(1 - value) if self.scale == "to 1" else value

    def holds(self, value: Any) -> bool:
        """Whether a value can be drawn."""
        return self.low <= value <= self.high

    @property
    def ends(self) -> tuple[Any, ...]:
        """Values at the borders."""
        return (self.low, self.high)

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g}" + ("" if self.scale == "linear" else f", {self.scale}")


@dataclass(frozen=True)
class Choice:
    """One of several values."""

    values: tuple[Any, ...]
    why: str
    needs: tuple[str, Any] | None = None

    def draw(self, trial: optuna.Trial, name: str) -> Any:
        """Have a trial choose a value."""
        return trial.suggest_categorical(name, self.values)

    def drawn_as(self, name: str) -> str:
        """Return what Optuna calls the parameter."""
        return name

    def as_drawn(self, value: Any) -> Any:
        """Return what Optuna has to draw for this value."""
        return value

    def holds(self, value: Any) -> bool:
        """Whether a value can be drawn."""
        return value in self.values

    @property
    def ends(self) -> tuple[Any, ...]:
        """Every value."""
        return self.values

    def __str__(self) -> str:
        return ", ".join(map(str, self.values))


Dimension = Range | Choice

_LEARNING_RATE = Range(3e-5, 3e-3, "logarithmic", "a factor of ten to either side of the usual 3e-4")
_DISCOUNT = Range(0.95, 0.999, "to 1", "horizons of 20 to 1,000 steps")
_TARGET_RATE = Range(0.001, 0.05, "logarithmic", "targets that lag 20 to 1,000 updates behind; the papers have 0.005")
_BATCH_SIZE = Choice((64, 128, 256, 512), "256 in the papers; a larger batch costs as much more time")
_ENTROPY_WEIGHT = "0.2 in the papers; what is right goes with the size of the rewards"
_OFF_POLICY: Mapping[str, Dimension] = {
    "actor_learning_rate": _LEARNING_RATE,
    "critic_learning_rate": _LEARNING_RATE,
    "discount": _DISCOUNT,
    "target_rate": _TARGET_RATE,
    "batch_size": _BATCH_SIZE,
}
_NORMALISABLE: Mapping[str, Dimension] = {  # normalised critics do without target networks
    **_OFF_POLICY,
    "target_rate": replace(_TARGET_RATE, needs=("critic_normalisation", "none")),
}
_NOISE: Mapping[str, Dimension] = {
    "exploration_noise": Range(0.03, 0.5, "logarithmic", "0.1 in the papers"),
    "target_noise": Range(0.05, 0.5, "logarithmic", "0.2 in the papers; they clip it at 0.5"),
}

SPACES: Mapping[str, Mapping[str, Dimension]] = MappingProxyType(
    {
        "csac": {
            "entropy_weight": Range(0.01, 1.0, "logarithmic", _ENTROPY_WEIGHT),
            "relative_entropy_weight": Range(
                0.005, 50.0, "logarithmic", "the range of the paper's ablation; 0.5 there"
            ),
            "reference_period": Range(
                100, 10_000, "logarithmic", "a factor of ten around the default", ("reference_policy", "periodic")
            ),
            "reference_rate": Range(
                0.005, 0.5, "logarithmic", "a factor of ten around the default", ("reference_policy", "average")
            ),
            **_NORMALISABLE,
        },
        "sac": {
            "entropy_weight": Range(0.01, 1.0, "logarithmic", _ENTROPY_WEIGHT),
            "weight_learning_rate": replace(_LEARNING_RATE, needs=("entropy_weight", "auto")),
            **_NORMALISABLE,
        },
        "td3": {"policy_delay": Range(1, 4, "linear", "2 in the paper"), **_NOISE, **_OFF_POLICY},
        "sd3": {
            "inverse_temperature": Range(
                0.001, 0.5, "logarithmic", "its authors' 0.001 to 0.1 on these tasks, and further up"
            ),
            **_NOISE,
            **_OFF_POLICY,
        },
        "ppo": {
            "learning_rate": _LEARNING_RATE,
            "discount": _DISCOUNT,
            "trace_decay": Range(0.8, 0.99, "to 1", "advantages that look 5 to 100 steps ahead; 0.95 is usual"),
            "clip_range": Range(0.1, 0.4, "linear", "0.2 in the paper"),
            "entropy_weight": Range(0.0, 0.02, "linear", "none in the paper for continuous actions"),
            "epochs": Range(3, 20, "linear", "10 in the paper"),
            "rollout_steps": Choice((512, 1024, 2048, 4096), "2048 in the paper"),
            "minibatches": Choice((8, 16, 32, 64), "32 in the paper's setting; each divides every rollout"),
        },
    }
)


def searched(
    algorithm: str, hyperparameters: Mapping[str, Any], wanted: Sequence[str] | None, given: Sequence[str]
) -> dict[str, Dimension]:
    """Return what is searched: all that means something, or what is `wanted` of it, but for what is `given`.

    A weight that is learnt (`auto`) is no number to search.

    Raises:
        InputError: something is wanted that is not searched, means nothing here or is given; or nothing is left.
    """
    space = SPACES[algorithm]
    for name in wanted or ():
        if name not in space:
            raise InputError(f"{name!r} is not searched for {algorithm}{similar(name, space)}")
        if name in given:
            raise InputError(f"{name} is given, and so not searched: leave it out here or there")
        needs = space[name].needs
        if needs and hyperparameters[needs[0]] != needs[1]:
            raise InputError(f"{name} means nothing without --{needs[0].replace('_', '-')} {needs[1]}")
        if hyperparameters[name] == "auto":
            raise InputError(f"{name} is auto, and so learnt and not searched: leave it out")
    names = list(space) if wanted is None else wanted
    chosen = {
        name: dimension
        for name, dimension in space.items()
        if name in names
        and name not in given
        and hyperparameters[name] != "auto"
        and _is_meant(dimension, hyperparameters)
    }
    if not chosen:
        raise InputError("there is nothing to search: every hyperparameter of the search space is given")
    return chosen


def space_table(algorithm: str) -> Table:
    """Return the search space of an algorithm as a table."""
    rows = []
    for name, dimension in SPACES[algorithm].items():
        needs = f" (with {dimension.needs[0]} {dimension.needs[1]})" if dimension.needs else ""
        rows.append(Row((Cell(f"`{name}`"), Cell(str(dimension)), Cell(dimension.why + needs))))
    return Table(("hyperparameter", "range", "why"), tuple(rows))


def _is_meant(dimension: Dimension, hyperparameters: Mapping[str, Any]) -> bool:
    return dimension.needs is None or hyperparameters[dimension.needs[0]] == dimension.needs[1]


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
