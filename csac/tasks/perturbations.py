"""Changes of a task in the middle of training: friction and other physics of MuJoCo tasks, and noise on any task.

What a perturbation with step S changes is every environment step after the first S: the step that makes S + 1 is the
first that differs, and an evaluation at step S still shows the task as it was.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from csac.checks import did_you_mean
from csac.record.config import STEPS_LIMIT
from csac.tasks.physics import NOISES, PHYSICS
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

KINDS = (*PHYSICS, *NOISES)

_EXAMPLE = "friction=1.5@300000"


@dataclass(frozen=True)
class Perturbation:
    """One change of a task after `step` environment steps, written `KIND=VALUE@STEP`; without `@STEP` from the start.

    `value` is a factor on the task's own physics (`friction`, `gravity`, `mass`, `gain`), never on an earlier
    perturbation's, or a standard deviation: of `observation_noise` in units of the observation, of `action_noise` in
    those of an action in [-1, 1].

    Raises:
        InputError: no such kind, or a value or step that it cannot have.
    """

    kind: str
    value: float
    step: int = 0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            hint = " ".join(filter(None, [did_you_mean(str(self.kind), KINDS), f"there are {', '.join(KINDS)}"]))
            raise InputError(f"no perturbation is called {self.kind!r}: {hint}")
        is_number = isinstance(self.value, int | float | np.number) and not isinstance(self.value, bool)
        value = _as_float(self.value) if is_number else math.nan
        shown = str(value) if math.isinf(value) else repr(self.value)
        what = "factor" if self.kind in PHYSICS else "standard deviation"
        if self.kind == "mass" and not 0 < value < math.inf:
            raise InputError(f"mass takes a finite factor above 0, not {shown}")
        if not 0 <= value < math.inf:
            raise InputError(f"{self.kind} takes a finite {what} of 0 or more, not {shown}")
        if isinstance(self.step, bool) or not isinstance(self.step, int | np.integer) or self.step < 0:
            raise InputError(f"the step of {self.kind} must be a whole number of 0 or more, not {self.step!r:.40}")
        if self.step > STEPS_LIMIT:
            raise InputError(f"the step of {self.kind} must be at most {STEPS_LIMIT:,}")
        object.__setattr__(self, "value", value)
        object.__setattr__(self, "step", int(self.step))

    @classmethod
    def parse(cls, text: str) -> Perturbation:
        """Return the perturbation that `KIND=VALUE@STEP` or `KIND=VALUE` describes. Raises InputError."""
        kind, equals, rest = text.strip().partition("=")
        value, at, step = rest.partition("@")
        if not equals or not value or (at and not step):
            raise InputError(f"a perturbation is written KIND=VALUE or KIND=VALUE@STEP, as {_EXAMPLE}, not {text!r}")
        return cls(kind.strip().replace("-", "_"), _number(value, text), _step(step, text) if at else 0)

    def __str__(self) -> str:
        return f"{self.kind}={_plain(self.value)}" + (f"@{self.step}" if self.step else "")

    @property
    def label(self) -> str:
        """What it does, in few words: `friction x 1.5`, `observation noise 0.1`."""
        return (
            f"{self.kind} x {self.value:g}" if self.kind in PHYSICS else f"{self.kind.replace('_', ' ')} {self.value:g}"
        )


def unlike_training(trained: Iterable[str | Perturbation]) -> list[str]:
    """Return the line that says of an unperturbed test that the training was perturbed; none where it was not."""
    told = ", ".join(map(str, perturbations_of(trained)))
    return [f"not perturbed, unlike its training ({told})"] if told else []


def perturbations_of(given: str | Perturbation | Iterable[str | Perturbation]) -> tuple[Perturbation, ...]:
    """Return perturbations, written out or not, in the order of their steps.

    Raises:
        InputError: one is not what it should be, or two of one kind have the same step.
    """
    several = (given,) if isinstance(given, str | Perturbation) else given
    if not isinstance(several, Iterable):
        raise InputError(f"perturbations are a list such as [{_EXAMPLE!r}], not {given!r:.40}")
    parsed = [Perturbation.parse(item) if isinstance(item, str) else item for item in several]
    for item in parsed:
        if not isinstance(item, Perturbation):
            raise InputError(f"{item!r} is no perturbation: write it as {_EXAMPLE!r}, or make a Perturbation")
    parsed.sort(key=lambda item: (item.step, KINDS.index(item.kind)))
    for first, second in itertools.pairwise(parsed):
        if (first.kind, first.step) == (second.kind, second.step):
            raise InputError(f"{first} and {second} are of the same kind and step: give one of them")
    return tuple(parsed)


def constant_perturbations(given: str | Perturbation | Iterable[str | Perturbation]) -> tuple[Perturbation, ...]:
    """As `perturbations_of`, where nothing is learnt and so there is no step to wait for. Raises InputError."""
    perturbations = perturbations_of(given)
    for item in perturbations:
        if item.step:
            raise InputError(f"{item}: nothing is learnt here, so it holds from the beginning: leave out @{item.step}")
    return perturbations


def values_at(perturbations: Iterable[Perturbation], step: int) -> dict[str, float]:
    """Return the value of each kind that the environment step after the first `step` ones has."""
    ordered = sorted(perturbations, key=lambda item: item.step)
    return {item.kind: item.value for item in ordered if item.step <= step}


def continued(before: Sequence[Perturbation], given: Sequence[Perturbation], begin: int) -> tuple[Perturbation, ...]:
    """Return the perturbations of a run that goes on at step `begin` from one that had those of `before`.

    What happened before that step stays; what comes from it on is as `given`.

    Raises:
        InputError: a given one lies before `begin` and was not there.
    """
    past = [item for item in before if item.step < begin]
    for item in given:
        if item.step < begin and item not in past:
            later = Perturbation(item.kind, item.value, begin)
            raise InputError(f"{item} lies before step {begin}, where this run begins: write {later}, or a later step")
    return perturbations_of([*past, *(item for item in given if item.step >= begin)])


def refuse_late(perturbations: Iterable[Perturbation], steps: int, planned: bool = False) -> None:
    """Raise InputError for what would only change steps that a run of `steps` does not make.

    Those that were `planned` in the run that this one begins with have nobody who asked for them now.
    """
    for item in perturbations:
        if item.step >= steps:
            hint = "was planned in the run that this one begins with: --perturb none leaves that out" if planned else ""
            raise InputError(
                f"{item} would change nothing: the run ends at step {steps}; {hint or 'give an earlier step'}"
            )


def by_step(perturbations: Iterable[Perturbation]) -> list[tuple[int, str]]:
    """Return (step, what changes there in few words) for each step at which something does, in order."""
    labels: dict[int, list[str]] = {}
    for item in perturbations_of(perturbations):
        labels.setdefault(item.step, []).append(item.label)
    return [(step, ", ".join(texts)) for step, texts in labels.items()]


def _number(text: str, whole: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{whole}: {text!r} is not a number; write it as {_EXAMPLE}") from None


def _as_float(value: float | np.number) -> float:
    try:
        return float(value)
    except OverflowError:  # a whole number beyond every float
        return math.inf if value > 0 else -math.inf


def _step(text: str, whole: str) -> int:
    """Return a step, which may be written 3e5 too."""
    try:
        value = int(text) if text.strip("+-_ 0123456789") == "" else float(text)
    except ValueError:
        value = math.nan
    if isinstance(value, float) and not value.is_integer():
        raise InputError(f"{whole}: {text!r} is not a whole number of steps; write it as {_EXAMPLE}")
    return int(value)


def _plain(value: float) -> str:
    """Return the shortest text that gives the number back."""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
