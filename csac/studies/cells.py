"""A cell: one call of `train` for one seed, named by its whole configuration: studies that share it share its run."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args, get_type_hints

from csac.algorithms import ALGORITHMS
from csac.checks import did_you_mean
from csac.console.tables import short
from csac.record.atomic import write_atomically
from csac.record.run import LOCK, MANIFEST, RunDirectory, is_locked, is_run
from csac.tasks.perturbations import perturbations_of
from csac.tasks.registry import events_of
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from csac.record.manifest import Manifest
    from csac.types import Algorithm

HOME = Path("runs/studies/cells")
LONGEST_NAME = 70  # characters of what a directory says of its cell, before the hash
LOST_EPISODE = "the episode in progress, which the checkpoint could not hold"  # that `restarting_seeds` restart

State = Literal["waiting", "partial", "running", "complete", "failed"]


@dataclass(frozen=True)
class Cell:
    """One call of `train`, for one seed. Plain values: it can be sent to a process that has not imported JAX yet."""

    task: str
    algorithm: str
    hyperparameters: dict[str, Any]
    """Every one of them, so that no later default changes what a cell is."""
    steps: int
    seed: int
    evaluation_interval: int
    evaluation_episodes: int
    perturbations: tuple[str, ...] = ()
    environment_arguments: dict[str, Any] = dataclasses.field(default_factory=dict)
    events: tuple[str, ...] = ()

    @classmethod
    def make(
        cls,
        task: str,
        algorithm: str,
        hyperparameters: Mapping[str, Any],
        *,
        perturbations: Iterable[str] = (),
        environment_arguments: Mapping[str, Any] | None = None,
        events: Iterable[str] = (),
        **plain: int,
    ) -> Cell:
        """Return a cell with every hyperparameter, written as `train` would write it.

        Raises:
            InputError: no such algorithm or hyperparameter, or a value that it cannot have.
        """
        return cls(
            task=task,
            algorithm=algorithm,
            hyperparameters=complete(algorithm, hyperparameters),
            perturbations=tuple(str(item) for item in perturbations_of(perturbations)),
            environment_arguments=dict(environment_arguments or {}),
            events=events_of(task, events),
            **plain,
        )

    @classmethod
    def of_run(cls, manifest: Manifest) -> Cell:
        """Return the cell whose run has this manifest. Raises InputError where it is no cell's.

        A hyperparameter that an older run has not got is the default: that is what it did.
        """
        if len(manifest.seeds) != 1:
            raise InputError("it has several seeds, and a cell has one")
        return cls.make(
            manifest.task,
            manifest.algorithm,
            manifest.hyperparameters,
            perturbations=manifest.perturbations,
            environment_arguments=manifest.environment_arguments,
            events=manifest.events,
            steps=manifest.steps,
            seed=manifest.seeds[0],
            evaluation_interval=manifest.evaluation.interval,
            evaluation_episodes=manifest.evaluation.episodes,
        )

    @functools.cached_property
    def key(self) -> str:
        """The hash of everything that decides what the cell computes."""
        return _hash(dataclasses.asdict(self))

    @functools.cached_property
    def arm(self) -> str:
        """What is trained, whatever the seed: `csac-periodic-closed_form-100k-1a2b3c4d`."""
        configuration = dataclasses.asdict(self)
        del configuration["seed"]
        words = [self.algorithm, *_told(self.algorithm, self.hyperparameters), *self.perturbations, short(self.steps)]
        name = "-".join(words).replace("/", "-").replace(" ", "")
        return f"{name[:LONGEST_NAME]}-{_hash(configuration)[:8]}"

    @property
    def name(self) -> Path:
        """Where the run lies below the folder of all cells: `<task>/<arm>/seed-<k>`."""
        return Path(self.task.replace("/", "-").replace(":", "-"), self.arm, f"seed-{self.seed}")

    def make_algorithm(self) -> Algorithm:
        """Return what learns."""
        make: Any = ALGORITHMS[self.algorithm]
        return make(**self.hyperparameters)


class Status(NamedTuple):
    """How far a cell is."""

    state: State
    steps: int = 0
    reason: str = ""
    """Why it failed."""
    seconds: float = 0.0
    """Time that was spent on it, as far as it was written down."""


class Store:
    """The runs of cells, below one folder that machines may share."""

    def __init__(self, root: str | Path = HOME) -> None:
        self.root = Path(root)

    def path(self, cell: Cell) -> Path:
        """Return the directory of a cell's run, whether it exists or not.

        A run that an older version made lies under another name as soon as an algorithm has a new hyperparameter: so a
        cell whose own directory does not exist is looked for by what the manifests say.
        """
        path = self.root / cell.name
        return path if path.exists() else self._known.get(cell.key, path)

    def first_step(self, cell: Cell) -> int:
        """Return the step that it goes on from: its end, or its newest checkpoint, which a killed run is ahead of."""
        with suppress(InputError):
            if is_run(self.path(cell)):
                manifest = RunDirectory.open(self.path(cell)).manifest
                return manifest.steps_done if manifest.state == "finished" else manifest.last_checkpoint
        return 0

    @functools.cached_property
    def _known(self) -> dict[str, Path]:
        known = {}
        for manifest in self.root.glob(f"*/*/seed-*/{MANIFEST}"):
            with suppress(InputError):
                known[Cell.of_run(RunDirectory.open(manifest.parent).manifest).key] = manifest.parent
        return known

    def status(self, cell: Cell) -> Status:
        """Return how far a cell is. A run that cannot be read has failed."""
        path = self.path(cell)
        history = read_history(path)
        seconds, reason = float(history.get("seconds", 0.0)), str(history.get("failure", ""))
        if not is_run(path):
            return Status("failed" if reason else "waiting", 0, reason, seconds)
        try:
            manifest = RunDirectory.open(path).manifest
        except InputError as error:
            return Status("failed", 0, str(error), seconds)
        steps = manifest.steps_done
        if manifest.state == "finished" and not reason:
            return Status("complete", steps, "", seconds)
        if is_in_use(path):
            return Status("running", steps, "", seconds)
        if manifest.state == "failed":
            return Status("failed", steps, "; ".join(map(str, manifest.failures.values())), seconds)
        return Status("failed" if reason else "partial", steps, reason, seconds)


def is_final(path: Path) -> bool:
    """Whether a run has been trained to its end, or to where its seed failed: it diverged, or its environment raised.

    What failed for another reason, such as a package that is missing or a machine that died, is tried again.
    """
    with suppress(InputError):
        return is_run(path) and RunDirectory.open(path).manifest.state in ("finished", "failed")
    return False


def restarting_seeds(path: Path) -> tuple[int, ...]:
    """Return the seeds that restart their episode where this run goes on: its checkpoint could not hold it."""
    with suppress(InputError):
        if is_run(path) and (manifest := RunDirectory.open(path).manifest).last_checkpoint:
            return manifest.inexact_seeds
    return ()


def complete(algorithm: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return every hyperparameter of an algorithm: those given, and the defaults of the others.

    Raises:
        InputError: no such algorithm or hyperparameter, or a value that it cannot have.
    """
    if algorithm not in ALGORITHMS:
        raise InputError(f"no algorithm is called {algorithm!r}{similar(algorithm, ALGORITHMS)}")
    make: Any = ALGORITHMS[algorithm]
    hints = get_type_hints(make)
    names = [field.name for field in dataclasses.fields(make)]
    for name in given:
        if name not in names:
            raise InputError(f"{algorithm} has no hyperparameter {name!r}{similar(name, names)}")
    values = {name: _in_its_type(value, hints[name]) for name, value in given.items()}
    return {name: _in_its_type(value, hints[name]) for name, value in dataclasses.asdict(make(**values)).items()}


def similar(word: str, known: Iterable[str]) -> str:
    """Return what resembles `word` most, or else all there is, as the end of a sentence."""
    known = list(known)
    hint = did_you_mean(word, known)
    return f"; {hint}" if hint else f": there is {', '.join(repr(one) if ',' in one else one for one in known)}"


def is_in_use(path: Path) -> bool:
    """Whether a process holds the lock of this run."""
    return is_locked(path / LOCK)


def read_history(path: Path) -> dict[str, Any]:
    """Return what was written beside a cell's run: the seconds spent on it, and why it failed."""
    with suppress(OSError, ValueError):
        return json.loads(_history(path).read_bytes())
    return {}


def write_history(path: Path, history: Mapping[str, Any]) -> None:
    """Write what `read_history` reads, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(_history(path), (json.dumps(history, indent=2) + "\n").encode())


def _history(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")


def _hash(configuration: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()


def _told(algorithm: str, hyperparameters: Mapping[str, Any]) -> list[str]:
    """Return what is not as the algorithm has it by default: words as they are, numbers with their names."""
    default = complete(algorithm, {})
    changed = {name: value for name, value in hyperparameters.items() if value != default[name]}
    return [value if isinstance(value, str) else f"{name}={_plain(value)}" for name, value in changed.items()]


def _plain(value: Any) -> str:
    return "x".join(map(str, value)) if isinstance(value, tuple) else f"{value:g}" if _is_float(value) else str(value)


def _is_float(value: Any) -> bool:
    return isinstance(value, float)


def _in_its_type(value: Any, hint: Any) -> Any:
    """Return 5 as 5.0 and a list as a tuple where the field is of that type: equal values have equal names."""
    if isinstance(value, list):
        return tuple(value)
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    return float(value) if is_whole and float in (hint, *get_args(hint)) else value
