"""Changes of a task in the middle of training: friction and other physics of MuJoCo tasks, and noise on any task.

What a perturbation with step S changes is every environment step after the first S: the step that makes S + 1 is the
first that differs, and an evaluation at step S still shows the task as it was.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from csac.checks import check_whole
from csac.tasks.physics import NOISES, PHYSICS
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

KINDS = (*PHYSICS, *NOISES)

_EXAMPLE = "friction=1.5@300000"
_WRITTEN = re.compile(r"(?P<kind>[^=@]+?)\s*=(?P<value>[^=@]+)(?:@(?P<step>[^=@]+))?")
_LAST_STEP = 2**31 - 1  # learners count their steps in 32 bits


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
            raise InputError(f"no perturbation is called {self.kind!r}: there are {', '.join(KINDS)}")
        check_whole(f"the step of {self.kind}", self.step, 0, _LAST_STEP)
        object.__setattr__(self, "value", _checked(self.kind, self.value))
        object.__setattr__(self, "step", int(self.step))

    @classmethod
    def parse(cls, text: str) -> Perturbation:
        """Return the perturbation that `KIND=VALUE@STEP` or `KIND=VALUE` describes. Raises InputError."""
        match = _WRITTEN.fullmatch(text.strip())
        value, step = (_number(match[name] or "0") if match else math.nan for name in ("value", "step"))
        if match is None or math.isnan(value) or not step.is_integer():  # a step may be written 3e5 too
            raise InputError(
                f"a perturbation is written KIND=VALUE or KIND=VALUE@STEP, as {_EXAMPLE}, not {text!r:.60}"
            )
        return cls(match["kind"].replace("-", "_"), value, int(step))

    def __str__(self) -> str:
        return f"{self.kind}={_plain(self.value)}" + (f"@{self.step}" if self.step else "")

    @property
    def label(self) -> str:
        """What it does, in few words: `friction x 1.5`, `observation noise 0.1`."""
        times = "x " if self.kind in PHYSICS else ""
        return f"{self.kind.replace('_', ' ')} {times}{self.value:g}"


def unlike_training(trained: Iterable[str | Perturbation]) -> list[str]:
    """Return the line that says of an unperturbed test that the training was perturbed; none where it was not."""
    told = ", ".join(map(str, perturbations_of(trained)))
    return [f"not perturbed, unlike its training ({told})"] if told else []


def perturbations_of(given: str | Perturbation | Iterable[str | Perturbation]) -> tuple[Perturbation, ...]:
    """Return perturbations, written out or not, in the order of their steps.

    Raises:
        InputError: one is not what it should be, or two of one kind have the same step.
    """
    several = [given] if isinstance(given, str | Perturbation) or not isinstance(given, Iterable) else given
    parsed = [Perturbation.parse(item) if isinstance(item, str) else item for item in several]
    if not all(isinstance(item, Perturbation) for item in parsed):
        raise InputError(f"perturbations are a list such as [{_EXAMPLE!r}], not {given!r:.40}")
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
            raise InputError(f"{item} lies before step {begin}, where this run begins: give that step, or a later one")
    return perturbations_of([*past, *(item for item in given if item.step >= begin)])


def refuse_late(perturbations: Iterable[Perturbation], steps: int, planned: bool = False) -> None:
    """Raise InputError for what would only change steps that a run of `steps` does not make.

    Those that were `planned` in the run that this one begins with have nobody who asked for them now.
    """
    hint = "the source run planned it: --perturb none leaves it out" if planned else "give an earlier step"
    for item in perturbations:
        if item.step >= steps:
            raise InputError(f"{item} would change nothing: the run ends at step {steps}; {hint}")


def by_step(perturbations: Iterable[Perturbation]) -> list[tuple[int, str]]:
    """Return (step, what changes there in few words) for each step at which something does, in order."""
    labels: dict[int, list[str]] = {}
    for item in perturbations_of(perturbations):
        labels.setdefault(item.step, []).append(item.label)
    return [(step, ", ".join(texts)) for step, texts in labels.items()]


def _checked(kind: str, value: object) -> float:
    """Return the value of a perturbation. Raises InputError for one that its kind cannot have."""
    number = math.nan if isinstance(value, str | bool) else _number(value)
    if not 0 <= number < math.inf or (kind == "mass" and not number):
        what = "factor" if kind in PHYSICS else "standard deviation"
        raise InputError(
            f"{kind} takes a finite {what} {'above 0' if kind == 'mass' else 'of 0 or more'}, not {number}"
        )
    return number


def _number(value: object) -> float:
    """Return a float, or nan for what is none."""
    try:
        return float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _plain(value: float) -> str:
    """Return the shortest text that gives the number back."""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
