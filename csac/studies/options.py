"""The options of `csac study`'s sub-commands, and which studies they mean."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from csac.studies.cells import HOME, similar
from csac.studies.named import find
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from csac.studies.study import Study


def _split(text: str, known: Collection[str]) -> list[str]:
    """Return the names in a text with commas between them; a name that is known may have commas itself.

    Blanks around a name are none of its own.
    """
    words, names = text.split(","), []
    while words:
        count = next((n for n in range(len(words), 0, -1) if ",".join(words[:n]).strip() in known), 1)
        names.append(",".join(words[:count]).strip())
        del words[:count]
    return names


@dataclass(frozen=True)
class Chosen:
    """Which study, and what of it."""

    name: Annotated[Positional[str], arg(metavar="NAME")]
    """One of csac study list, or a TOML file."""
    scale: float = 1.0
    """Shorten every run to this share of its steps; all output says so."""
    tasks: Annotated[str | None, arg(metavar="ID,...", help_behavior_hint="(default: all)")] = None
    """Only these tasks."""
    algorithms: Annotated[str | None, arg(metavar="NAME,...", help_behavior_hint="(default: all)")] = None
    """Only these algorithms or methods."""
    seeds: Annotated[int | None, arg(help_behavior_hint="(default: as in the study)")] = None
    """Number of seeds; asking for more later reuses what is there."""
    directory: Path = HOME
    """Directory of the runs of all cells."""

    def studies(self) -> list[Study]:
        """Return the studies that are meant. Raises InputError for what there is not."""
        if self.seeds is not None and self.seeds < 1:
            raise InputError(f"--seeds must be at least 1, not {self.seeds}")
        studies = [study.shortened(self.scale) for study in find(self.name)]
        names = {name for study in studies for name in study.names}
        tasks = None if self.tasks is None else [word.strip() for word in self.tasks.split(",")]
        algorithms = None if self.algorithms is None else _split(self.algorithms, names)
        return narrowed(studies, tasks, algorithms, self.seeds)

    def words(self) -> list[str]:
        """Return what to type for the same choice, wherever the runs are."""
        words = [self.name]
        words += ["--scale", f"{self.scale:g}"] * (self.scale != 1)
        for name, value in (("--tasks", self.tasks), ("--algorithms", self.algorithms), ("--seeds", self.seeds)):
            words += [] if value is None else [name, str(value)]
        return words


@dataclass(frozen=True)
class List:
    """List the studies."""


@dataclass(frozen=True)
class Show(Chosen):
    """Show the cells of a study, their progress, and how long the rest will take on this machine.

    A kind of cell that this machine has not run yet is timed first, a few seconds each, and the result is remembered.
    """

    no_measure: FlagCreatePairsOff[bool] = False
    """Do not time anything; use only what was measured before."""
    results: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: none)")] = None
    """Count cells that csac study run --results has collected here as over."""


@dataclass(frozen=True)
class Run(Chosen):
    """Run every incomplete cell of a study: partial ones resume; failed ones are listed and do not stop the others.

    Exit codes: 0 done, 2 wrong arguments, 3 a cell failed, 130 or 143 stopped by a signal (every cell is saved).
    """

    engine: Annotated[
        Literal["local", "processes", "ray"] | None,
        arg(
            help="local: one cell after another, in this process. processes: one cell per worker at a time. ray: as "
            "many as a Ray cluster has room for (docs/cluster.md).",
            help_behavior_hint="(default: processes, if there are cores)",
        ),
    ] = None
    workers: Annotated[int | None, arg(help_behavior_hint="(default: one per core)")] = None
    """Number of worker processes, each with its own share of the cores."""
    cell: Annotated[int | None, arg(help_behavior_hint="(default: all)")] = None
    """Run only the cell with this number in csac study show, for example as one job of an array."""
    address: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="(default: a new one, here)")] = None
    """Address of the Ray cluster, with --engine ray; auto is the one this machine belongs to."""
    cell_cores: int = 1
    """Cores that each cell requests from Ray."""
    cell_gpus: float = 0.0
    """GPUs, or a share of one, that each cell requests from Ray."""
    cell_memory: float = 0.0
    """GiB of memory that each cell requests from Ray; 0 requests none in particular."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Device that the networks are trained on."""
    results: Annotated[
        Path | None,
        arg(
            metavar="DIR",
            help="Copy the evaluations and a small manifest of each finished cell to this directory: all that a report "
            "needs. Cells copied there before, on any machine, are not run again, nor are beginnings of longer ones.",
            help_behavior_hint="(default: none)",
        ),
    ] = None
    wandb: FlagCreatePairsOff[bool] = False
    """Also log to Weights & Biases: one run per cell, in the project WANDB_PROJECT or else csac (docs/python.md)."""
    keep_checkpoints: FlagCreatePairsOff[bool] = False
    """Keep the checkpoints of finished cells too; they contain the replay and take most of the space."""


@dataclass(frozen=True)
class Report(Chosen):
    """Write a report of a study: the paper's claims, its numbers next to those measured, figures, commands."""

    results: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: the runs themselves)")] = None
    """Use only the files that csac study run --results has collected here."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: below runs/studies/reports)")] = None
    """Directory for report.html, report.md and the figures; with --results, by default in that directory."""


def narrowed(
    studies: Sequence[Study], tasks: Sequence[str] | None, algorithms: Sequence[str] | None, seeds: int | None
) -> list[Study]:
    """Narrow each of the studies to what it has of these tasks and algorithms; one that has nothing is left out.

    Raises:
        InputError: none of them has one that is asked for, or these together.
    """
    known_tasks = dict.fromkeys(task for study in studies for task in study.tasks)
    known_algorithms = dict.fromkeys(name for study in studies for name in study.names)
    for wanted, known, what in ((tasks, known_tasks, "task"), (algorithms, known_algorithms, "algorithm or method")):
        for name in wanted or ():
            if name not in known:
                raise InputError(
                    f"{' and '.join(study.name for study in studies)}: no {what} {name!r}{similar(name, known)}"
                )
    chosen = []
    for study in studies:
        own_tasks = [task for task in study.tasks if tasks is None or task in tasks]
        own_names = [name for name in study.names if algorithms is None or name in algorithms]
        if own_tasks and own_names:
            chosen.append(study.narrowed(own_tasks, own_names, seeds))
    if not chosen:
        raise InputError(f"{' and '.join(study.name for study in studies)}: none has such a method on such a task")
    return chosen
