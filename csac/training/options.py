"""The options of a run, checked: each is declared here once, for Python and for the command line. No JAX."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypedDict

from csac.checks import check_whole, did_you_mean
from csac.record.manifest import SEED_LIMIT, STEPS_LIMIT
from csac.synonyms import called_in_python
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from csac.tasks.perturbations import Perturbation
    from csac.types import Algorithm

MOST_SEEDS = 10_000
MOST_EPISODES = 1_000_000  # as many as there are reset seeds between those of training's evaluations and of later ones
LONGEST_INTERVAL = 10**15  # as good as never


@dataclass(frozen=True, kw_only=True)
class Options:
    """How a run is made: the keyword arguments of `train` that are flags of `csac train` as they stand.

    Raises:
        InputError: a number outside its range.
    """

    steps: int = 1_000_000
    """Environment steps per seed, warm-up included."""
    seeds: int = 1
    """Number of independent seeds to train."""
    first_seed: int = 0
    """Label of the first seed; the others are numbered from it."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Device that the networks are trained on."""
    evaluation_interval: int = 5_000
    """Environment steps between evaluations; there is always one at the last step."""
    evaluation_episodes: int = 10
    """Episodes per evaluation."""
    checkpoint_interval: int = 50_000
    """Environment steps between checkpoints; there is also one every ten minutes and at the end. 0: none at all."""
    keep_checkpoints: int = 2
    """Number of newest checkpoints to keep; 0 keeps all."""

    def __post_init__(self) -> None:
        if self.device not in ("cpu", "gpu"):
            raise InputError(f"device must be cpu or gpu, not {self.device!r}")
        for name, least, most in (
            ("steps", 1, STEPS_LIMIT),
            ("seeds", 1, MOST_SEEDS),
            ("first_seed", 0, SEED_LIMIT - 1),
            ("evaluation_interval", 1, LONGEST_INTERVAL),
            ("evaluation_episodes", 1, MOST_EPISODES),
            ("checkpoint_interval", 0, LONGEST_INTERVAL),
            ("keep_checkpoints", 0, LONGEST_INTERVAL),
        ):
            check_whole(name, getattr(self, name), least, most)
        if self.labels[-1] >= SEED_LIMIT:
            raise InputError(
                f"first_seed={self.first_seed} leaves no labels for {self.seeds} seeds: the last is 2^32 - 1"
            )

    @property
    def labels(self) -> list[int]:
        """The labels of the seeds, in order."""
        return list(range(self.first_seed, self.first_seed + self.seeds))


class PlanOptions(TypedDict, total=False):
    """The keyword arguments of `train` that say what is trained and how, as `Options` and `Plan` explain them."""

    steps: int
    seeds: int
    first_seed: int
    device: Literal["cpu", "gpu"]
    evaluation_interval: int
    evaluation_episodes: int
    evaluation_seed: int
    checkpoint_interval: int
    keep_checkpoints: int
    environment_arguments: dict[str, Any] | None
    perturbations: str | Perturbation | Iterable[str | Perturbation] | None
    events: Sequence[str] | None
    groups: int | None
    evaluation_processes: int | None


def checked_options(given: PlanOptions, algorithm: Algorithm | None = None) -> tuple[Options, dict[str, Any]]:
    """Return the options that are numbers, checked, and the others as they were given.

    A hyperparameter of `algorithm` among them is told as one.

    Raises:
        InputError: there is no option of that name, or a number outside its range.
    """
    if unknown := given.keys() - PlanOptions.__annotations__.keys():
        raise InputError(f"train takes no {min(unknown)}{_hint(min(unknown), algorithm)}")
    names = {item.name for item in dataclasses.fields(Options)}
    simple: Any = {name: value for name, value in given.items() if name in names}
    return Options(**simple), {name: value for name, value in given.items() if name not in names}


def check_groups(groups: int, seeds: int) -> None:
    """Raise InputError for what is no number of groups that this many seeds can fill."""
    check_whole("groups", groups, 1, MOST_SEEDS)
    if groups > seeds:
        raise InputError(f"groups must be at most as many as seeds, {seeds}, not {groups}: each needs one")


def _hint(name: str, algorithm: Algorithm | None) -> str:
    """Return ": ..." with what an option is called here, or what is most like it, or nothing."""
    known = PlanOptions.__annotations__
    if algorithm and name in (item.name for item in dataclasses.fields(algorithm)):  # pyright: ignore[reportArgumentType]
        return f": it is a hyperparameter, as in train({type(algorithm).__name__}({name}=...), ...)"
    hint = called_in_python(name, known) or did_you_mean(name, known)
    return f": {hint}" if hint else ""
