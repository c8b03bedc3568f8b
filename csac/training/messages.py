"""What the parts of a run tell each other: what to train, what has happened, what to do next. No JAX."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from csac.deploy.policy import Policy

if TYPE_CHECKING:
    from pathlib import Path

    from csac.record.run import Table
    from csac.training.plan import Plan
    from csac.training.seed_files import Files
    from csac.types import InputError


TURN_STEPS = 250  # environment steps that a group makes before another may have its cores


class Settings(NamedTuple):
    """What a group is told: the plan, and where it begins. Picklable, so that a group can be another process."""

    plan: Plan
    checkpoints: Path | None = None
    """The folder of the run's checkpoints, to read and, where the plan has an interval, to write; None for neither."""
    begin: int = 0
    """The step of the checkpoint to go on from; 0 begins anew."""
    has_other_task: bool = False
    """Whether that checkpoint is of another task, so that its episodes in progress are no use."""

    def ends_turn(self, step: int) -> bool:
        """Whether a group says how far it is at this step, so that it can be saved and give way to another."""
        interval = self.plan.checkpoint_interval
        return step % TURN_STEPS == 0 or step == self.plan.steps or bool(interval and step % interval == 0)

    @property
    def saves(self) -> bool:
        """Whether the group is saved from time to time."""
        return self.checkpoints is not None and self.plan.checkpoint_interval > 0


class Rows(NamedTuple):
    """Rows for one of the run's tables, "episodes" or "metrics"."""

    table: Table
    rows: list[dict[str, Any]]


class Evaluated(NamedTuple):
    """Every living seed of the group was evaluated at this step; `policies` are those evaluated.

    `info_names` are the names of numbers that the episodes held in their last `info`.
    """

    step: int
    rows: list[dict[str, Any]]
    policies: dict[int, Policy]
    info_names: frozenset[str] = frozenset()


class Failed(NamedTuple):
    """A seed stopped for a reason of its own; the others go on. `policy` is what it had learnt, where that is sound."""

    seed: int
    step: int
    reason: str
    details: str
    policy: Policy | None


class Progress(NamedTuple):
    """Everything up to this step has been yielded."""

    step: int


class Boundary(NamedTuple):
    """So many steps are made: here the group can be saved, once `settle` has told what still waits."""

    step: int


class Noted(NamedTuple):
    """Something that the user should know, and that stops nobody."""

    text: str


class BegunAnew(NamedTuple):
    """A seed began its episode anew, since its environment did not take back what the checkpoint has of it."""

    seed: int
    reason: str


class Saved(NamedTuple):
    """What a checkpoint at this step needs of the group is on disk, in these files.

    `inexact` are the seeds whose environment cannot be saved in the middle of an episode, and what went wrong: nothing
    ("") where it does not offer to be.
    """

    step: int
    files: Files
    inexact: dict[int, str]


class Ended(NamedTuple):
    """The group is over: all its steps, no seed left alive, or it was asked to stop. The newest policies."""

    step: int
    policies: dict[int, Policy]


GroupMessage = Rows | Evaluated | Failed | Progress | Boundary | Noted | BegunAnew | Saved | Ended

Order = Literal["save", "stop"] | list[int]  # to a worker: what to do, or the cores to take its next turn on


class GroupCrashed(NamedTuple):
    """A group's process ended without a word, or with an error of ours."""

    reason: str
    details: str


class GroupRestarted(NamedTuple):
    """A group's process died; another goes on from the newest checkpoint, at this step."""

    reason: str
    step: int


class NotSaved(NamedTuple):
    """A group could not write its files of a checkpoint."""

    error: OSError


class Refused(NamedTuple):
    """A group cannot do what was asked for: a user's mistake, and so no failure of its seeds."""

    error: InputError


Message = GroupMessage | GroupCrashed | GroupRestarted | NotSaved | Refused
